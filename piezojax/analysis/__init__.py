"""Stability of loops and the limit of linear control."""
