"""What workers and queue cost, and what they withstand."""
