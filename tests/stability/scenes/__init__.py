"""The hard scenes, each with its truth."""
