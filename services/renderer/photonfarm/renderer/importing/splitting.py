"""Shapes that hold several things, split so that each part belongs to one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.importing import elements
from photonfarm.renderer.importing.changes import listed
from photonfarm.renderer.importing.imported import Ids, ImportedScene
from photonfarm.renderer.importing.meshes import of_shape, write_ply

REST = -1
"""The number of all that belongs to no thing."""


@dataclass(frozen=True, slots=True, eq=False)
class Belonging:
    """Which thing each face is of."""

    shape: NDArray[np.int32]  # (F,)
    thing: NDArray[np.int64]  # (F,): a number, or REST


def shapes_of_things(
    scene: ImportedScene, loaded: Any, belonging: Belonging, count: int, scratch: Path
) -> list[list[str]]:  # fmt: skip
    """The ids of the shapes of each thing; shapes of several things, or of one and the room, are split in `scene`."""
    ids = Ids()
    for node in scene.root.iter():
        ids.keep(node.get("id", ""))
    found: list[list[str]] = [[] for _ in range(count)]
    split = []
    for number, shape in enumerate(loaded.shapes()):
        faces = belonging.thing[belonging.shape == number]
        things = np.unique(faces)
        if len(things) == 1:
            if things[0] != REST:
                found[things[0]].append(shape.id())
            continue
        element = next(node for node in scene.root.findall("shape") if node.get("id") == shape.id())
        for part in _split(scene.root, element, shape, faces, ids, scratch):
            if part.thing != REST:
                found[part.thing].append(part.shape_id)
        split.append(shape.id())
    if split:
        scene.changes.note(f"{listed(split)}: held separate things in one mesh, and became a shape for each")
    return found


@dataclass(frozen=True, slots=True)
class _Part:
    shape_id: str
    thing: int


def _split(
    root: Element, element: Element, shape: Any, faces: NDArray[np.int64], ids: Ids, scratch: Path
) -> list[_Part]:  # fmt: skip
    """Replace a shape by a shape for each of its things."""
    mesh = of_shape(shape)
    place = list(root).index(element)
    parts = []
    for thing in np.unique(faces):
        made = ids.make(f"{shape.id()}_part")
        part = mesh.part(faces == thing)
        if element.find("emitter") is not None:
            part = replace(part, normals=None)
        file = write_ply(part, scratch / "meshes" / f"{made}.ply")
        new = elements.mesh_shape(elements.scene(), made, file, faceted=part.normals is None)
        new.extend(elements.copied(node) for node in element if node.tag in ("ref", "bsdf", "emitter"))
        root.insert(place, new)
        parts.append(_Part(made, int(thing)))
    root.remove(element)
    return parts
