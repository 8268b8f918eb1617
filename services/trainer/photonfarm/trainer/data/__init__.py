"""Samples on their way from the store to the network."""
