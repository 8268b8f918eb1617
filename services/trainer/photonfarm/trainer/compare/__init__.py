"""Several predictors on the same held-out samples."""
