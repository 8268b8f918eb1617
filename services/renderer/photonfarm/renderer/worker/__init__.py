"""The render worker: a supervisor, and the child that it starts and that renders."""
