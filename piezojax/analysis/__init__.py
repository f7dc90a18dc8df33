"""Analysis of loops: stability, constraints, steps, the limit of linear control."""
