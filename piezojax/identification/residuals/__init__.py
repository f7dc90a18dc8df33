"""Residual analysis of a fit: error bound, correlations, peaks and coverage."""
