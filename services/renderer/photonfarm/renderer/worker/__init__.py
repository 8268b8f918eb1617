"""The render worker: a supervisor, and the child process that renders."""
