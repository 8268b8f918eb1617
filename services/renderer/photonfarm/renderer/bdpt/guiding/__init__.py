"""Guided starts of light paths: which light, from where and in which direction, by what reaches the image."""
