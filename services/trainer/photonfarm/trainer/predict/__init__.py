"""Predictors: trained runs and untrained denoisers, their images, and their held-out error."""
