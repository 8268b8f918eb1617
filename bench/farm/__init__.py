"""What workers, queue and plans cost, and what they withstand."""
