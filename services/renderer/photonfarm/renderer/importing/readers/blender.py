"""Blender's .blend files, USD and FBX: Blender, in a process of its own, writes a GLB, which is read as any.

Blender is GPL and large, so it is no part of photonfarm. It is the program `blender`, or a Python that has its wheel
`bpy`: one of its own, as `bpy` needs an older numpy than the store.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

from photonfarm.renderer.importing.imported import ImportedScene
from photonfarm.renderer.importing.readers import gltf
from photonfarm.shared.core.errors import BackendError, SpecError
from photonfarm.shared.core.waiting import Log

VARIABLE = "PHOTONFARM_BLENDER"
"""The variable that names Blender, or a Python that has `bpy`."""

_SCRIPT = Path(__file__).with_name("blender_export.py")


def read(path: Path, scratch: Path, log: Log) -> ImportedScene:
    """Read a file. Raises BackendError without Blender, SpecError if Blender cannot read the file."""
    command = blender_command(path)
    out = scratch / "exported.glb"
    log(f"{path.name}: Blender writes it as glTF")
    output = scratch / "blender.log"
    with output.open("wb") as stream:
        process = subprocess.Popen([*command, str(path.resolve()), str(out)], stdout=stream, stderr=stream)
        try:
            process.wait()
        finally:
            process.kill()
    text = output.read_text(errors="replace")
    if process.returncode or not out.is_file():
        raise SpecError(f"{path}: Blender cannot read it: {_last_words(text)}")
    scene = gltf.read(out, scratch, log)
    for line in text.splitlines():
        if line.startswith("note: "):
            scene.changes.note(line.removeprefix("note: "))
    return scene


def blender_command(path: Path) -> list[str]:
    """The beginning of the command that exports a file; raises BackendError where there is no Blender."""
    named = os.environ.get(VARIABLE)
    program = shutil.which(named or "blender")
    if program is None and named:
        raise BackendError(f"{VARIABLE} = {named!r} is no program; name a Python that has bpy, or Blender itself")
    if program is None:
        raise BackendError(
            f"{path}: {path.suffix} files are read by Blender, which is not here: make it by `python3.11 -m venv bpy; "
            f"bpy/bin/pip install bpy; export {VARIABLE}=$PWD/bpy/bin/python` (370 MB), or export the scene as .glb"
        )
    if Path(program).name.startswith("python"):
        return [program, str(_SCRIPT)]
    return [program, "--background", "--factory-startup", "--python", str(_SCRIPT), "--"]


def _last_words(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    errors = [line for line in lines if "rror" in line]
    return (errors or lines or ["it said nothing"])[-1][:300]
