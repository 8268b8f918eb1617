"""`train --dry-run`: what a training would take, from a few of its steps; nothing is written."""
