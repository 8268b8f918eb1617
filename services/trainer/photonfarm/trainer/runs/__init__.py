"""A run: its settings, its folder, its log and its checkpoints."""
