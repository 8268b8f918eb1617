"""Shapes that hold several things, split so that each part belongs to one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.importing import elements
from photonfarm.renderer.importing.changes import listed
from photonfarm.renderer.importing.imported import Ids, ImportedScene
from photonfarm.renderer.importing.meshes import of_shape, write_ply

REST = -1
"""The number of all that belongs to no thing."""


def shapes_of_things(
    scene: ImportedScene, loaded: Any, shape_of: NDArray[np.int32], thing_of: NDArray[np.int64], scratch: Path
) -> list[list[str]]:  # fmt: skip
    """The ids of the shapes of each thing; shapes of several things, or of one and the room, are split in `scene`.

    `shape_of` and `thing_of` (F,) are the numbers of each face's shape and thing, or REST.
    """
    ids = Ids()
    for node in scene.root.iter():
        ids.keep(node.get("id", ""))
    found: list[list[str]] = [[] for _ in range(int(thing_of.max(initial=REST)) + 1)]
    split = []
    for number, shape in enumerate(loaded.shapes()):
        faces = thing_of[shape_of == number]
        parts = [(shape.id(), int(thing)) for thing in np.unique(faces)]
        if len(parts) > 1:
            parts = list(_split(scene, shape, faces, ids, scratch))
            split.append(shape.id())
        for name, thing in parts:
            if thing != REST:
                found[thing].append(name)
    if split:
        scene.changes.note(f"{listed(split)}: held separate things in one mesh, and became a shape for each")
    return found


def _split(
    scene: ImportedScene, shape: Any, faces: NDArray[np.int64], ids: Ids, scratch: Path
) -> Iterator[tuple[str, int]]:  # fmt: skip
    """Replace a shape by a shape for each of its things; their ids, and the numbers of the things."""
    element = next(node for node in scene.root.findall("shape") if node.get("id") == shape.id())
    mesh, place = of_shape(shape), list(scene.root).index(element)
    for thing in np.unique(faces):
        made = ids.make(f"{shape.id()}_part")
        part = mesh.part(faces == thing)
        if element.find("emitter") is not None:
            part = replace(part, normals=None)
        file = write_ply(part, scratch / "meshes" / f"{made}.ply")
        new = elements.mesh_shape(elements.scene(), made, file, faceted=part.normals is None)
        new.extend(elements.copied(node) for node in element if node.tag in ("ref", "bsdf", "emitter"))
        scene.root.insert(place, new)
        yield made, int(thing)
    scene.root.remove(element)
