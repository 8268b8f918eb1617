"""Instances of Mitsuba scenes, each made a shape of its own, as only those can be moved and sampled as lights."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from photonfarm.renderer.importing import elements
from photonfarm.renderer.importing.changes import Changes
from photonfarm.renderer.importing.meshes import Floats, Mesh, of_shape, write_ply

MOST = 5000
"""The most shapes that instances are expanded into; more are a forest, which no memory holds."""

STEPS = 128
"""The edges of a circle, where an ellipse has to be a mesh."""

_ROUND = ("sphere", "cylinder", "disk")
"""The shapes that Mitsuba keeps round under each transform of their own, and that no instance does."""


def expand(root: Element, changes: Changes, scratch: Path) -> None:
    """Put copies of its group's shapes in the place of each instance; meshes that have to be made go to `scratch`."""
    groups = {group.get("id", ""): group for group in root.findall("shape[@type='shapegroup']")}
    instances = root.findall("shape[@type='instance']")
    placer = _Placer(changes, scratch, cache(_loaded))
    made = left_out = 0
    for number, instance in enumerate(instances):
        place = list(root).index(instance)
        copies = list(_copies(instance, groups, number, placer)) if made < MOST else []
        root[place : place + 1] = copies
        left_out += not copies
        made += len(copies)
    for group in groups.values():
        root.remove(group)
    if made:
        changes.note(f"{len(instances)} instances became {made} shapes of their own")
    if left_out:
        meaning = f"{left_out} of {len(instances)} are missing, of empty groups or beyond {MOST} shapes"
        changes.lose("geometry", "instance", meaning)


def _copies(instance: Element, groups: dict[str, Element], number: int, placer: _Placer) -> Iterator[Element]:
    ref = next((part for part in instance if part.tag == "ref"), None)
    group = groups.get(ref.get("id", "") if ref is not None else "", instance.find("shape"))
    placed = elements.child(instance, "to_world")
    for shape in group.findall("shape") if group is not None else ():
        copy = elements.copied(shape)
        name = shape.get("id") or group.get("id") if group is not None else None
        copy.set("id", f"{name or 'instance'}_{number + 1}")
        if placed is not None:
            placer.place(shape, copy, placed)
        yield copy


class _Placer:
    """Moves copies of shapes as instances are moved, whose fronts stay fronts and whose circles become ellipses."""

    def __init__(self, changes: Changes, scratch: Path, load: Callable[[Element], Any]) -> None:
        self._changes, self._scratch, self._load = changes, scratch, load
        self._mirrors: dict[Element, Any] = {}

    def place(self, shape: Element, copy: Element, placed: Element) -> None:
        """Move the copy of a shape by the transform of an instance."""
        matrix = np.array(placed[0].get("value", "").split(), np.float64).reshape(4, 4)
        square = matrix[:3, :3].T @ matrix[:3, :3]
        is_similar = np.allclose(square, np.eye(3) * np.trace(square) / 3, atol=1e-5 * np.trace(square))
        if shape.get("type") in _ROUND and not is_similar and (loaded := self._load(shape)) is not None:
            self._become_mesh(shape, copy, loaded, matrix)
            return
        own = elements.child(copy, "to_world")
        if own is not None:
            own.extend(elements.copied(step) for step in placed)  # after its own
        else:
            copy.append(elements.copied(placed))
        if np.linalg.det(matrix[:3, :3]) < 0:
            self._turn(shape, copy)

    def _turn(self, shape: Element, copy: Element) -> None:
        """Turn the normals of a mirrored shape back, where Mitsuba turns them."""
        loaded = self._load(shape)
        if loaded is None:
            return
        turned = shape.get("type") == "sphere"
        if loaded.is_mesh():
            turned = not loaded.has_vertex_normals() or _follow_faces(loaded, self._mirrored(shape))
        if loaded.is_mesh() and not turned and shape.find("emitter") is not None:
            turned = True
            _set_flag(copy, "face_normals", True)  # as all lights get them
        if turned:
            flipped = elements.child(copy, "flip_normals")
            _set_flag(copy, "flip_normals", flipped is None or flipped.get("value") != "true")

    def _mirrored(self, shape: Element) -> Any:
        if shape not in self._mirrors:
            copy = elements.copied(shape)
            transform = elements.child(copy, "to_world")
            if transform is None:
                transform = SubElement(copy, "transform", name="to_world")
            SubElement(transform, "scale", x="-1")
            self._mirrors[shape] = _loaded(copy)
        return self._mirrors[shape]

    def _become_mesh(self, shape: Element, copy: Element, loaded: Any, matrix: Floats) -> None:
        import mitsuba as mi

        kind, flipped = copy.get("type", ""), elements.child(copy, "flip_normals")
        own = np.array(mi.traverse(loaded)["to_world"].matrix, np.float64).reshape(4, 4)
        mesh = _round(kind).moved(own).moved(matrix)
        file = write_ply(mesh, self._scratch / f"{len(list(self._scratch.iterdir()))}-{kind}.ply")
        self._changes.note(f"became a mesh of {len(mesh.faces)} faces", elements.place(shape), name=kind)
        copy[:] = [part for part in copy if part.tag in ("bsdf", "emitter", "ref") or part is flipped]
        copy.set("type", "ply")
        elements.put_value(copy, "filename", str(file))


def _round(kind: str) -> Mesh:
    """A unit sphere, cylinder or disk, with Mitsuba's normals and texture coordinates."""
    steps = {"sphere": STEPS // 2, "cylinder": 1, "disk": 1}[kind]
    along, around = (each.ravel() for each in np.mgrid[0 : 1 : (steps + 1) * 1j, 0 : 1 : (STEPS + 1) * 1j])
    across = np.stack([np.cos(2 * np.pi * around), np.sin(2 * np.pi * around), 0 * around], axis=1)
    up, uv = np.array([0.0, 0.0, 1.0]), np.stack([around, along], axis=1)
    if kind == "sphere":
        normals = across * np.sin(np.pi * along)[:, None] + np.cos(np.pi * along)[:, None] * up
        vertices = normals
    elif kind == "cylinder":
        normals, vertices = across, across + along[:, None] * up
    else:
        normals, vertices, uv = np.tile(up, (len(along), 1)), across * along[:, None], uv[:, ::-1]
    first = (np.arange(steps)[:, None] * (STEPS + 1) + np.arange(STEPS)).ravel()
    below = first + STEPS + 1
    faces = np.concatenate([np.stack([first, below, below + 1], 1), np.stack([first, below + 1, first + 1], 1)])
    faces = faces[:, ::-1] if kind == "cylinder" else faces
    return Mesh(vertices, faces.astype(np.uint32), normals, uv)


def _follow_faces(loaded: Any, mirrored: Any) -> bool:
    """Whether normals of vertices are made of faces, which turn as a mesh is mirrored at x = 0, and not of its file."""
    normals, found = of_shape(loaded).normals, of_shape(mirrored).normals
    return bool(normals is not None and found is not None and np.nansum(normals * (-1, 1, 1) * found) < 0)


def _set_flag(shape: Element, name: str, value: bool) -> None:
    found = elements.child(shape, name)
    if found is not None:
        shape.remove(found)
    elements.put_value(shape, name, value)


def _loaded(shape: Element) -> Any:
    """The shape as it is in its group, without a material; None for one that Mitsuba refuses, which is told later."""
    import mitsuba as mi

    scene, alone = elements.scene(), elements.copied(shape)
    alone[:] = [part for part in alone if part.tag not in ("bsdf", "emitter", "ref")]
    scene.append(alone)
    config = mi.parser.ParserConfig(mi.variant())
    config.unused_properties = mi.LogLevel.Debug
    config.merge_equivalent = config.merge_meshes = False
    try:
        state = mi.parser.parse_string(config, elements.text(scene).replace("$", r"\$"))
        mi.parser.transform_all(config, state)
        return mi.parser.instantiate(config, state).shapes()[0]
    except (RuntimeError, ValueError):
        return None
