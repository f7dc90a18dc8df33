"""Estimation methods, one file each."""
