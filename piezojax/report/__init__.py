"""Pictures, tables and result files of the commands."""
