"""The verbs of the renderer on the command line."""
