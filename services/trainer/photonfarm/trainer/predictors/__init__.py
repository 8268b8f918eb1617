"""Predictors: trained runs and ready denoisers, and their held-out error."""
