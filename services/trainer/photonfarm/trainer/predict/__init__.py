"""Predictors: trained runs and ready denoisers, their images, and their held-out error."""
