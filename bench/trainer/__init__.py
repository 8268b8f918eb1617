"""What networks cost, and what they learn."""
