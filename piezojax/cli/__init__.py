"""The commands: they parse, call and report."""
