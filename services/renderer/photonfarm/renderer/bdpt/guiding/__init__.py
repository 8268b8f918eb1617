"""Guides learned from what reaches the image: where light paths start, and which light vertices are useful."""
