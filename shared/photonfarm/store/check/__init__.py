"""Checking: every stored byte against its checksum, its plan and its statistics."""
