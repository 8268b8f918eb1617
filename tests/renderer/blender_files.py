"""What tests of Blender's files have in common."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from photonfarm.renderer.tools.importing.imported import ImportedScene
from photonfarm.renderer.tools.importing.readers import blender

Loaded = Callable[[Path], tuple[ImportedScene, Any]]


needs_blender = pytest.mark.skipif(not os.environ.get(blender.VARIABLE), reason=f"{blender.VARIABLE} names no Blender")


def run(script: str, folder: Path, *arguments: str) -> None:
    """Let Blender's Python run a script."""
    (folder / "script.py").write_text(script)
    command = blender.blender_command(folder / "it.blend")
    place = next(number for number, word in enumerate(command) if word.endswith("blender_export.py"))
    made = subprocess.run([*command[:place], str(folder / "script.py"), *arguments], capture_output=True, check=False)
    assert made.returncode == 0, made.stderr.decode()[-1000:]
