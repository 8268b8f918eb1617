"""Geometry that breaks renderers, mended: scenes far from the origin, and normals that are none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from photonfarm.renderer.importing import elements
from photonfarm.renderer.importing.imported import ImportedScene
from photonfarm.renderer.importing.meshes import Floats, of_shape

FAR = 10.0
"""A scene whose middle is farther from the origin than so many of its diagonals is moved there. Coordinates are single
precision in renderers, and the offsets of rays grow with them."""

ROUGH = 1e-5
"""Vertices that Mitsuba reads from files are rounded; more than this share of the scene's diagonal is a change."""

_NOWHERE = ("constant", "envmap", "sunsky", "timed_sunsky", "directional", "area")
"""Lights that have no place of their own."""


def move_to_origin(scene: ImportedScene, loaded: Any) -> bool:
    """Move a scene that is far from the origin so that its lower corner is near it; whether it moved.

    What readers made is in double precision and is moved so.
    """
    box = loaded.bbox()
    low, high = np.array(box.min, np.float64), np.array(box.max, np.float64)
    if scene.meshes:
        vertices = [mesh.vertices for mesh in scene.meshes.values()]
        low = np.minimum.reduce([each.min(axis=0) for each in vertices])
        high = np.maximum.reduce([each.max(axis=0) for each in vertices])
    diagonal = float(np.linalg.norm(high - low))
    if not np.isfinite(diagonal) or not np.linalg.norm(low + high) / 2 > FAR * diagonal:
        return False
    step = 10.0 ** np.floor(np.log10(diagonal))
    by = -np.floor(low / step) * step
    rounding = float(np.spacing(np.float32(np.abs(high).max())))
    for shape in scene.root.findall("shape"):
        if shape.get("id") in scene.meshes:
            mesh = scene.meshes[shape.get("id", "")]
            scene.meshes[shape.get("id", "")] = replace(mesh, vertices=mesh.vertices + by)
            continue
        if elements.child(shape, "filename") is not None and rounding > ROUGH * diagonal:
            meaning = f"vertices are rounded by up to {rounding:.2g}, as Mitsuba reads files in single precision"
            scene.changes.lose("geometry", "coordinates", meaning, f"shape {shape.get('id')!r}")
        _move(shape, by)
    for emitter in scene.root.findall("emitter"):
        if emitter.get("type") not in _NOWHERE:
            _move(emitter, by)
    if scene.camera is not None:
        x, y, z = np.array(scene.camera) + by
        scene.camera = (float(x), float(y), float(z))
    offset = ", ".join(f"{part:.10g}" for part in by)
    scene.changes.note(f"the scene is far from the origin, where coordinates are rough, and is moved by ({offset})")
    return True


def _move(node: Element, by: Floats) -> None:
    """Move a shape or a light, after all that moves it already."""
    place = elements.child(node, "position")
    if place is not None:
        for axis, part in zip("xyz", by, strict=True):
            place.set(axis, f"{float(place.get(axis, '0')) + part:.10g}")
        return
    transform = elements.child(node, "to_world")
    if transform is None:
        transform = SubElement(node, "transform", name="to_world")
    SubElement(transform, "translate", {axis: f"{part:.10g}" for axis, part in zip("xyz", by, strict=True)})


def make_normals_usable(scene: ImportedScene, loaded: Any) -> bool:
    """Give meshes of Mitsuba's files the normals of their faces where theirs are zero or no numbers; whether any."""
    shapes = {shape.get("id"): shape for shape in scene.root.findall("shape")}
    mended = False
    for each in loaded.shapes():
        if each.id() in scene.meshes or not each.is_mesh() or not each.has_vertex_normals():
            continue
        normals = np.array(each.vertex_normals_buffer(), np.float32).reshape(-1, 3)
        if (np.abs(normals).max(axis=1, initial=0) > 0).all():  # false for NaN
            continue
        element = shapes[each.id()]
        scene.meshes[each.id()] = of_shape(each).usable(each.id(), scene.changes)
        element[:] = [part for part in element if part.tag in ("ref", "bsdf", "emitter")]
        element.set("type", "ply")
        elements.put_value(element, "filename", "")
        mended = True
    return mended
