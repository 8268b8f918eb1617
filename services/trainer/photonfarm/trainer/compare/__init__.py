"""Comparisons of several predictors on the same held-out samples."""
