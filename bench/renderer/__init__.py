"""How efficient, how right and how fast the integrator is."""
