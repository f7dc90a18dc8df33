"""Analysis of loops: stability, constraints, step tests, stroke, linear limit."""
