"""What a training step costs, and which optimiser is best."""
