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

from photonfarm.renderer.importing.imported import ImportedScene
from photonfarm.renderer.importing.readers import gltf
from photonfarm.renderer.importing.readers.blender_lamps import Lamps
from photonfarm.shared.core.errors import BackendError, SpecError
from photonfarm.shared.core.waiting import Log

VARIABLE = "PHOTONFARM_BLENDER"
"""The variable that names Blender, or a Python that has `bpy`."""

DULLEST = 1.0101
"""The index of refraction of what the reader of glTF has no reflections for."""

_SCRIPT = Path(__file__).with_name("blender_export.py")


def read(path: Path, scratch: Path, log: Log) -> ImportedScene:
    """Read a file. Raises BackendError without Blender, SpecError if Blender cannot read the file."""
    command = blender_command(path)
    out = scratch / "exported.glb"
    log(f"{path.name}: Blender writes it as glTF")
    _run([*command, str(path.resolve()), str(out)], path, out)
    try:
        scene = gltf.read(out, scratch, log)
    except SpecError as error:
        raise SpecError(str(error).replace(str(out), str(path))) from error
    beside: dict[str, Any] = json.loads(out.with_suffix(".json").read_text(encoding="utf-8"))
    scene.objects = {made: beside["owners"].get(owner, owner) for made, owner in scene.objects.items()}
    for effect, name, meaning, place in beside["said"]:
        if effect is None:
            scene.changes.note(meaning, place, name=name)
        else:
            scene.changes.lose(effect, name, meaning, place)
    if beside["camera"] is not None:
        x, y, z = beside["camera"]
        scene.camera = (x, z, -y)
    _make_dull_diffuse(scene)
    lamps = Lamps(scene, scratch)
    for lamp in beside["lamps"]:
        lamps.put(lamp)
    lamps.put_sky(beside["sky"])
    return scene


def _make_dull_diffuse(scene: ImportedScene) -> None:
    """Let what reflects by its colour alone be `diffuse`, as in Cycles; `principled` brightens it at grazing angles."""
    for material in scene.root.iter("bsdf"):
        found = {part.get("name"): float(part.get("value", 0)) for part in material if part.tag == "float"}
        if found.pop("eta", 2.0) > DULLEST or found.get("metallic", 1.0) > 0 or len(found) > 2:
            continue
        material.set("type", "diffuse")
        material[:] = [part for part in material if part.get("name") == "base_color"]
        material[0].set("name", "reflectance")


def _run(command: list[str], path: Path, out: Path) -> None:
    output = out.with_suffix(".log")
    with output.open("wb") as stream:
        process = subprocess.Popen(command, stdout=stream, stderr=stream)
        try:
            process.wait()
        finally:
            process.kill()
    lines = [line.strip() for line in output.read_text(errors="replace").splitlines() if line.strip()]
    if process.returncode == 0 and out.with_suffix(".json").is_file():
        return
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
