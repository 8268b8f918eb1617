"""Readers, one for each kind of file; each makes an `ImportedScene`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from photonfarm.renderer.importing.imported import ImportedScene
from photonfarm.shared.core.errors import SpecError
from photonfarm.shared.core.waiting import Log
from photonfarm.shared.scene.spec_loading import SCENE_SUFFIXES

BLENDER = (".blend", ".usd", ".usda", ".usdc", ".usdz", ".fbx")
"""What Blender reads for us."""

FEW = 3
"""Up to so many scenes of a folder are named."""

Reader = Callable[[Path, Path, Log], ImportedScene]
"""Reads a file; what it makes of it lies in the folder that is given, and it says what takes long."""


def reader_of(path: Path) -> Reader:
    """The reader of a file, by its ending; raises SpecError for an unknown one and for what is no file or not there."""
    if path.is_dir():
        there = sorted(each.name for each in path.iterdir() if each.suffix.lower() in SCENE_SUFFIXES)
        names = ", ".join(there[:FEW]) + (f" and {len(there) - FEW} more" if len(there) > FEW else "")
        remedy = f"name the scene's file in it: {names}" if there else "and holds no scene; name the file of one"
        raise SpecError(f"{path}: is a folder{';' if there else ','} {remedy}")
    suffix = path.suffix.lower()
    if suffix not in SCENE_SUFFIXES:
        raise SpecError(
            f"{path}: {suffix or 'a name without an ending'} is no kind of scene that is read; known are .xml "
            f"(Mitsuba), .gltf, .glb, .obj, and through Blender {', '.join(BLENDER)}"
        )
    if not path.is_file():
        raise SpecError(f"{path}: is not there")
    return _reader(suffix)


def _reader(suffix: str) -> Reader:
    if suffix == ".xml":
        from photonfarm.renderer.importing.readers import mitsuba_xml

        return mitsuba_xml.read
    if suffix == ".obj":
        from photonfarm.renderer.importing.readers import obj

        return obj.read
    if suffix in BLENDER:
        from photonfarm.renderer.importing.readers import blender

        return blender.read
    from photonfarm.renderer.importing.readers import gltf

    return gltf.read
