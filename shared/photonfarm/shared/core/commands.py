"""Verbs of `photonfarm` as child processes, whichever distribution provides them."""

from __future__ import annotations

import sys
from importlib.metadata import entry_points
from pathlib import Path

GROUP = "photonfarm.commands"
"""The group of entry points that holds all verbs."""


def is_installed(name: str) -> bool:
    """Whether a verb such as "buffers" or "scene.cost" is installed, by any service."""
    return bool(entry_points(group=GROUP, name=name))


def command(*arguments: str | Path) -> list[str]:
    """The command line of a verb with its arguments, for a child process: this Python runs it, whatever is on PATH."""
    return [sys.executable, "-m", "photonfarm.shared.cli", *map(str, arguments)]
