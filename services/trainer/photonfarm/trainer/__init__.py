"""The trainer service: neural light transport learned from a store that grows."""
