"""An imported scene written beside its spec: the scene file, and copies of all the files that it names."""

from __future__ import annotations

import shutil
from collections import Counter
from pathlib import Path

from photonfarm.renderer.importing import elements
from photonfarm.renderer.importing.imported import ImportedScene

_MESHES = (".ply", ".obj", ".serialized")


def write_scene(scene: ImportedScene, folder: Path) -> Path:
    """Write the scene into a folder, with its files by relative names; the scene file."""
    names: dict[str, str] = {}
    taken: Counter[str] = Counter()
    for node, key in elements.file_names(scene.root):
        source = node.get(key, "")
        if source not in names:
            names[source] = _copied(Path(source), folder, taken)
        node.set(key, names[source])
    file = folder / "scene.xml"
    elements.write(scene.root, file)
    return file


def _copied(source: Path, folder: Path, taken: Counter[str]) -> str:
    """Copy a file; its name relative to the folder, distinct among all."""
    kind = "meshes" if source.suffix.lower() in _MESHES else "textures"
    name = f"{kind}/{source.name}"
    taken[name.lower()] += 1
    if taken[name.lower()] > 1:
        name = f"{kind}/{source.stem}_{taken[name.lower()]}{source.suffix}"
    target = folder / name
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
    return name
