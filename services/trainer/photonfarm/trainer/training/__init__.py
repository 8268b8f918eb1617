"""Training: a step, the loop around it, validation, and recovery."""
