"""Predictors: trained runs and untrained denoisers, what they show, and their held-out error."""
