"""Benchmarks and studies, whose pages lie in docs/results; each is run as a module from the repository's root."""
