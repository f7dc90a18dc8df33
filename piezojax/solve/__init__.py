"""Solvers of bounded problems; they know nothing of studies."""
