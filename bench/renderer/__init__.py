"""How efficient and how fast the integrator is, and how right on rooms."""
