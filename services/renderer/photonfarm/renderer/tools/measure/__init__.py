"""Measurements: what frames and samples cost, how noisy they are, and how a scene should be exposed."""
