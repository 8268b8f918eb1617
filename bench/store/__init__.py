"""The store against the bare disk."""
