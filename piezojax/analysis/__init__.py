"""Stability of a loop, and the limit of linear control."""
