"""Geometry that breaks renderers, mended: scenes far from the origin or tiny, and normals that are none."""

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

SMALL = 0.1
"""A scene whose diagonal is shorter becomes larger, as Mitsuba's offsets of rays are 1e-4 at least."""

ROUGH = 1e-3
"""Vertices are rounded to single precision; more than this share of a shape's diagonal is seen."""

_NOWHERE = ("constant", "envmap", "sunsky", "timed_sunsky", "directional", "area")
"""Lights that have no place of their own."""


def fit(scene: ImportedScene, loaded: Any) -> bool:
    """Move a scene that is far from the origin there, and enlarge one that is tiny; whether either was done.

    Its lower corner is near the origin then. What readers made is in double precision and is moved so.
    """
    low, high = np.array(loaded.bbox().min, np.float64), np.array(loaded.bbox().max, np.float64)
    if scene.meshes:
        vertices = [mesh.vertices for mesh in scene.meshes.values()]
        low = np.minimum.reduce([each.min(axis=0) for each in vertices])
        high = np.maximum.reduce([each.max(axis=0) for each in vertices])
    diagonal = float(np.linalg.norm(high - low))
    is_far = bool(np.linalg.norm(low + high) / 2 > FAR * diagonal)
    if not 0 < diagonal < np.inf or not (is_far or diagonal < SMALL):
        _say_roughness(scene, loaded, moved=False)
        return False
    step = 10.0 ** np.floor(np.log10(diagonal))
    factor = float(1 / step) if diagonal < SMALL else 1.0
    by = -np.floor(low / step) * step if is_far else np.zeros(3)
    if is_far:
        offset = ", ".join(f"{part:.10g}" for part in by)
        scene.changes.note(f"the scene is far from the origin, where coordinates are rough, and is moved by ({offset})")
        _say_roughness(scene, loaded, moved=True)
    if factor > 1:
        scene.changes.note(
            f"the scene is {diagonal:.2g} across, where rays are rough, and is enlarged {factor:g} times"
        )
    for shape_id, mesh in scene.meshes.items():
        scene.meshes[shape_id] = replace(mesh, vertices=(mesh.vertices + by) * factor)
    for node in [*scene.root.findall("shape"), *scene.root.findall("emitter")]:
        if node.get("id") not in scene.meshes and node.get("type") not in _NOWHERE:
            _move(scene, node, by, factor)
    if scene.camera is not None:
        x, y, z = ((np.array(scene.camera) + by) * factor).tolist()
        scene.camera = (x, y, z)
    return True


def _say_roughness(scene: ImportedScene, loaded: Any, *, moved: bool) -> None:
    """Say which shapes are rounded too much, where they are more than half of the surface."""
    rough, area, total = [], 0.0, 0.0
    for shape in loaded.shapes():
        box, own = shape.bbox(), float(np.array(shape.surface_area()).ravel()[0])
        low, high = np.array(box.min, np.float64), np.array(box.max, np.float64)
        rounding = float(np.spacing(np.float32(np.abs([low, high]).max())))
        total += own
        if rounding > ROUGH * np.linalg.norm(high - low) and not (moved and shape.id() in scene.meshes):
            area += own
            rough.append(f"shape {shape.id()!r} by up to {rounding:.2g}")
    for place in rough if area > total / 2 else ():
        meaning = "vertices are rounded, as coordinates are single precision; move all of it near the origin"
        scene.changes.lose("geometry", "coordinates", meaning, place)


def _move(scene: ImportedScene, node: Element, by: Floats, factor: float) -> None:
    """Move and enlarge a shape or a light, after all that moves it already."""
    intensity = elements.child(node, "intensity")
    if intensity is not None and factor > 1:  # which is by the square of lengths
        if intensity.tag in ("rgb", "float"):
            numbers = [float(word) for word in intensity.get("value", "").replace(",", " ").split()]
            intensity.set("value", elements.numbers([factor**2 * number for number in numbers]))
        else:
            scene.changes.lose("light", "intensity", "is too low, as the scene is enlarged", elements.place(node))
    place = elements.child(node, "position")
    if place is not None:
        for axis, part in zip("xyz", by, strict=True):
            place.set(axis, f"{(float(place.get(axis, '0')) + part) * factor:.10g}")
        return
    transform = elements.child(node, "to_world")
    if transform is None:
        transform = SubElement(node, "transform", name="to_world")
    SubElement(transform, "translate", {axis: f"{part:.10g}" for axis, part in zip("xyz", by, strict=True)})
    SubElement(transform, "scale", value=f"{factor:g}")


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
        mended, element, mesh = True, shapes[each.id()], of_shape(each).usable(each.id(), scene.changes)
        if not len(mesh.faces):
            scene.root.remove(element)
            continue
        scene.meshes[each.id()] = mesh
        element[:] = [part for part in element if part.tag in ("ref", "bsdf", "emitter")]
        element.set("type", "ply")
        elements.put_value(element, "filename", "")
        if mesh.normals is None:
            elements.put_value(element, "face_normals", True)
    return mended
