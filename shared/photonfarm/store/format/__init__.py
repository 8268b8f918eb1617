"""The format: every array, the shards that hold it, and the markers of what is complete."""
