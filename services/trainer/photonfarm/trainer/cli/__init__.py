"""The trainer on the command line: its verbs, and the service around the training loop."""
