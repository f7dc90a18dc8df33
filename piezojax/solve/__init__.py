"""Solvers of bounded problems, independent of studies."""
