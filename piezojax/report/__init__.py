"""Pictures, tables and progress shared by the commands."""
