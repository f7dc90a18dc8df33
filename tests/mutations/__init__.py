"""Changes of the package that its tests must detect."""
