"""The command line: the `photonfarm` command, the verbs of the store and the farm, and what they print."""
