"""Analysis of the residual of a fit: what the model does not explain."""
