"""Blender's .blend files, USD and FBX: Blender, in a process of its own, writes a GLB, which is read as any.

Blender is GPL and large, so it is no part of photonfarm. It is the program `blender`, or a Python that has its wheel
`bpy`: one of its own, as `bpy` needs an older numpy than the store.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

from photonfarm.core.errors import BackendError, SpecError
from photonfarm.core.waiting import Log
from photonfarm.renderer.tools.importing.changes import Changes
from photonfarm.renderer.tools.importing.imported import ImportedScene
from photonfarm.renderer.tools.importing.readers import gltf
from photonfarm.renderer.tools.importing.readers.blender_lamps import Lamps

_NAMES = {
    "KHR_materials_anisotropy": "Anisotropic",
    "KHR_materials_clearcoat": "Coat Weight",
    "KHR_materials_sheen": "Sheen Weight",
    "KHR_materials_specular": "Specular Tint",
    "KHR_materials_transmission": "Transmission Weight",
    "clearcoatNormalTexture": "Coat Normal",
    "emissiveTexture": "Emission Color",
}
"""What Blender calls that which glTF has of its surfaces."""

VARIABLE = "PHOTONFARM_BLENDER"
"""The variable that names Blender, or a Python that has `bpy`."""

_SCRIPT = Path(__file__).with_name("blender_export.py")


def read(path: Path, scratch: Path, log: Log) -> ImportedScene:
    """Read a file. Raises BackendError without Blender, SpecError if Blender cannot read the file."""
    command = blender_command(path)
    out = scratch / "exported.glb"
    log(f"{path.name}: Blender opens it")
    _run([*command, str(path.resolve()), str(out)], path, out)
    try:
        scene = gltf.read(out, scratch, log)
    except SpecError as error:
        raise SpecError(str(error).replace(str(out), str(path))) from error
    changes, scene.changes = scene.changes, Changes()
    scene.changes.note("Blender's (x, y, z) is (x, z, −y) here")
    for change in changes:
        for place in change.places or [""]:
            scene.changes.say(change.effect, _NAMES.get(change.name, change.name), change.meaning, place)
    beside: dict[str, Any] = json.loads(out.with_suffix(".json").read_text(encoding="utf-8"))
    scene.objects = {made: beside["owners"].get(owner, owner) for made, owner in scene.objects.items()}
    for each in beside["said"]:
        scene.changes.say(*each)
    if beside["camera"] is not None:
        x, y, z = beside["camera"]
        scene.camera = (x, z, -y)
    lamps = Lamps(scene, scratch)
    for lamp in beside["lamps"]:
        lamps.put(lamp)
    lamps.put_sky(beside["sky"])
    return scene


def _run(command: list[str], path: Path, out: Path) -> None:
    made = subprocess.run(command, capture_output=True, encoding="utf-8", errors="replace", check=False)
    if made.returncode == 0 and out.with_suffix(".json").is_file():
        return
    lines = [line.strip() for line in (made.stdout + made.stderr).splitlines() if line.strip()]
    for line in lines:
        if line.startswith("fault: "):
            raise SpecError(f"{path}: {line.removeprefix('fault: ')[:300]}")
    said = ([line for line in lines if "rror" in line] or lines or ["it said nothing"])[-1][:300]
    raise SpecError(f"{path}: Blender cannot read it: {said}")


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
    return [program, "--background", "--factory-startup", "--python-exit-code", "1", "--python", str(_SCRIPT), "--"]
