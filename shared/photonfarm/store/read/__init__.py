"""Reading: complete samples while more arrive, the passes of a view merged, and samples found by what they hold."""
