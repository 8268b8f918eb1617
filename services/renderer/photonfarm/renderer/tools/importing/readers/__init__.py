"""Readers, one for each kind of file; each makes an `ImportedScene`."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from photonfarm.core.errors import SpecError
from photonfarm.core.waiting import Log
from photonfarm.renderer.tools.importing.changes import name_some
from photonfarm.renderer.tools.importing.imported import ImportedScene

BLENDER = (".blend", ".usd", ".usda", ".usdc", ".usdz", ".fbx")
"""What Blender reads for us."""

_READERS = {".xml": "mitsuba_xml", ".obj": "obj", ".gltf": "gltf", ".glb": "gltf", **dict.fromkeys(BLENDER, "blender")}

Reader = Callable[[Path, Path, Log], ImportedScene]
"""Reads a file; what it makes of it lies in the folder that is given, and it says what takes long."""


def reader_of(path: Path) -> Reader:
    """The reader of a file, by its ending; raises SpecError for an unknown one, and for no file or an empty one."""
    if path.is_dir():
        there = sorted(each.name for each in path.iterdir() if each.suffix.lower() in _READERS)
        remedy = f"; name the scene's file in it: {name_some(there)}" if there else ", and holds no scene"
        raise SpecError(f"{path}: is a folder{remedy}")
    suffix = path.suffix.lower()
    if suffix not in _READERS:
        raise SpecError(
            f"{path}: {suffix or 'a name without an ending'} is no kind of scene that is read; known are .xml "
            f"(Mitsuba), .gltf, .glb, .obj, and through Blender {', '.join(BLENDER)}; export it as .glb or .obj"
        )
    if not path.is_file():
        raise SpecError(f"{path}: is not there")
    if not path.stat().st_size:
        raise SpecError(f"{path}: is empty")
    read: Reader = import_module(f"{__name__}.{_READERS[suffix]}").read
    return read
