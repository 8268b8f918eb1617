"""Named bytes, in a folder or in a bucket."""
