"""Verbs of `photonfarm` as processes of their own, whichever distribution they are from."""

from __future__ import annotations

import sys
from importlib.metadata import entry_points
from pathlib import Path

GROUP = "photonfarm.commands"
"""The group of entry points that holds all verbs."""


def is_installed(name: str) -> bool:
    """Whether a verb such as "buffers" or "scene.cost" is there, of whichever service."""
    return bool(entry_points(group=GROUP, name=name))


def command(*arguments: str | Path) -> list[str]:
    """A verb with its arguments, to be run as a process of its own: by this Python, whatever is on PATH."""
    return [sys.executable, "-m", "photonfarm.shared.cli", *map(str, arguments)]
