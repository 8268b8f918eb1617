"""The sampling plan as people read it, and as a spec holds it."""
