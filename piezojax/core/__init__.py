"""The System protocol, the loop over time, and declarations that all packages use."""
