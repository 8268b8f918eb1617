"""The lights of a scene as data: where light paths start, which light is chosen, and with which densities."""
