"""Commands: parse the options, call the package, report the results."""
