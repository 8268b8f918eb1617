"""Benchmarks that are run again, each a part of a page of docs/results; run as modules from the repository's root."""
