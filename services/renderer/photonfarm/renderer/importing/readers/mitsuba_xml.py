"""Mitsuba's XML, of versions 0.6 to 3: one file, in the terms of Mitsuba 3, without what photonfarm cannot render."""

from __future__ import annotations

import re
from bisect import bisect
from itertools import accumulate
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from photonfarm.renderer.importing import elements
from photonfarm.renderer.importing.changes import Changes, listed
from photonfarm.renderer.importing.imported import Ids, ImportedScene, Vector
from photonfarm.renderer.importing.readers import (
    mitsuba_files,
    mitsuba_instances,
    mitsuba_old,
    mitsuba_parts,
    mitsuba_ply,
)
from photonfarm.shared.core.errors import SpecError
from photonfarm.shared.core.waiting import Log
from photonfarm.shared.scene.located_xml import Located, line_of

_TAGS = {"PhaseFunction": "phase", "ReconstructionFilter": "rfilter"}
"""The elements of Mitsuba's kinds of objects that are not called like them."""

_OF_FILES = ("bitmap", "envmap", "obj", "ply", "serialized")
"""The plugins that are nothing without a file; Mitsuba crashes on a bitmap that names none."""

_AROUND = ("constant", "envmap", "sunsky", "timed_sunsky")
"""The emitters that light a scene from all around."""

_FULL = ("path", "bdpt", "ptracer", "volpath", "volpathmis", "volpath_simple", "mlt", "pssmlt", "erpt", "photonmapper",
         "ppm", "sppm", "vpl", "adaptive", "irrcache", "prb", "prb_basic", "prb_projective")  # fmt: skip
"""The integrators that compute all light, as photonfarm does."""

_GENERATED = re.compile(r"^(_unnamed_\d+|_arg_\d+|)$")


def read(path: Path, scratch: Path, log: Log) -> ImportedScene:
    """Read a scene; raises SpecError for what is no scene, and for files that are not there."""
    log(f"reading {path.name}")
    scene = ImportedScene()
    files = mitsuba_files.Files(mitsuba_old.Upgrade(scene.changes, scene.names, scratch), scratch)
    scene.root = _Tree(files.parsed(path), files).element(0)
    if scene.root.tag != "scene":
        raise SpecError(f"{path}: begins with <{scene.root.tag}>; a Mitsuba scene begins with <scene>")
    scene.root.set("version", "3.0.0")
    scene.camera, scene.up = _camera(scene.root)
    _drop_settings(scene.root, scene.changes)
    mitsuba_parts.mend(scene.root, scene.changes)
    _want_one_environment(scene.root)
    _find_files(scene.root, files)
    mitsuba_instances.expand(scene.root, scene.changes, scratch)
    _name_shapes(scene)
    if scene.root.find("shape") is None:
        raise SpecError(f"{path}: has no shape that photonfarm can render")
    return scene


class _Tree:
    """Elements of Mitsuba's nodes."""

    def __init__(self, state: Any, files: mitsuba_files.Files) -> None:
        self._nodes, self._ids = list(state.nodes), state.id_to_index
        self._files = [files.originals.get(str(file), file) for file in state.files]
        texts = [Path(str(file)).read_bytes().split(b"\n") for file in state.files]
        self._ends = [list(accumulate(len(line) + 1 for line in text)) for text in texts]

    def element(self, number: int, name: str = "") -> Located:
        """The element of a node, with all in it."""
        node = self._nodes[number]
        tag = _TAGS.get(node.type.name, node.type.name.lower())
        given = {"type": node.props.plugin_name(), "id": node.props.id(), "name": name}
        made = Located(tag, {key: text for key, text in given.items() if text and tag != "scene"})
        made.file = str(self._files[node.file_index])
        made.line = bisect(self._ends[node.file_index], node.offset) + 1
        for key in node.props:
            part = self._part("" if key.startswith("_arg_") else key, node.props[key], node.props.type(key).name)
            part.file, part.line = part.file or made.file, part.line or made.line
            made.append(part)
        return made

    def _part(self, name: str, value: Any, kind: str) -> Located:
        if kind == "ResolvedReference":
            return self.element(value.index(), name)
        given = {"name": name} if name else {}
        if kind == "Reference":
            referred = self._ids[value.id()]  # by its own name or by an alias
            return Located("ref", given, id=self._nodes[referred].props.id())
        if kind == "Transform":
            part = Located("transform", given)
            part.append(Element("matrix", value=_numbers(value.matrix)))
            return part
        if kind == "Vector":
            return Located("vector", given, **dict(zip("xyz", _numbers(value).split(), strict=True)))
        if kind == "Spectrum":
            pairs = [f"{at!r}:{of!r}" for at, of in zip(value.wavelengths, value.values, strict=False)]
            return Located("spectrum", given, value=" ".join(pairs) or _numbers(value.values))
        text = value if kind == "String" else str(value).lower() if kind == "Bool" else _numbers(value)
        return Located({"Bool": "boolean", "Color": "rgb"}.get(kind, kind.lower()), given, value=text)


def _numbers(values: Any) -> str:
    """Numbers as they are in double precision."""
    return " ".join(repr(value).removesuffix(".0") for value in np.array(values).ravel().tolist())


def _camera(root: Element) -> tuple[Vector | None, Vector]:
    """The position of the camera, and the world axis that is nearest to its up direction."""
    sensor = root.find("sensor")
    placed = None if sensor is None else elements.child(sensor, "to_world")
    if placed is None:
        return None, (0.0, 1.0, 0.0)
    matrix = np.array(placed[0].get("value", "").split(), np.float64).reshape(4, 4)
    axis = int(np.abs(matrix[:3, 1]).argmax())
    x, y, z = np.where(np.arange(3) == axis, np.sign(matrix[axis, 1]), 0.0)
    right, up, back = matrix[:3, 3]
    return (float(right), float(up), float(back)), (float(x), float(y), float(z))


def _drop_settings(root: Element, changes: Changes) -> None:
    """Take out what photonfarm has settings of its own for, and say what that changes."""
    for node in [part for part in root if part.tag in ("integrator", "sensor", "film", "sampler")]:
        root.remove(node)
        kind = node.get("type", "")
        hides = (elements.child(part, "hide_emitters") for part in node.iter("integrator"))
        if any(found is not None and found.get("value") == "true" for found in hides):
            changes.note("lights are visible here", elements.place(node), name="hide_emitters")
        if node.tag == "integrator" and kind not in _FULL:
            changes.note("all light is computed here", elements.place(node), name=kind)
        if node.tag == "sensor" and kind != "perspective":
            changes.note("cameras are perspective here", elements.place(node), name=kind)


def _want_one_environment(root: Element) -> None:
    """Raise SpecError for two lights all around, which Mitsuba 3 does not add."""
    found = [elements.place(node) for node in root.findall("emitter") if node.get("type") in _AROUND]
    if len(found) > 1:
        raise SpecError(
            f"{' and '.join(found)} light the scene from all around, which in Mitsuba 3 one light can; keep one "
            '(a sun and a sky are one as <emitter type="sunsky"/>)'
        )


def _find_files(root: Element, files: mitsuba_files.Files) -> None:
    """Make the names of files absolute; raises SpecError for one that is not there, or not named where it must be."""
    for node in root.iter():
        if node.get("type") in _OF_FILES and elements.child(node, "filename") is None:
            raise SpecError(f"{elements.place(node)} of type {node.get('type')!r} has no filename; add one")
    for node, key in elements.file_names(root):
        name = node.get(key, "")
        beside = getattr(node, "file", "")
        file = files.find(name, Path(beside))
        if file is None:
            raise SpecError(
                f"{beside}: line {line_of(node)}: file {name!r} is not there; put it there, or take its place out"
            )
        node.set(key, str(file))
    for node in root.iter("shape"):
        named = elements.child(node, "filename")
        file = Path("" if named is None else named.get("value", ""))
        if node.get("type") == "ply" and (fault := mitsuba_ply.fault(file)):
            raise SpecError(f"{elements.place(node)}: {file}: {fault}; write the mesh anew")


def _name_shapes(scene: ImportedScene) -> None:
    """Give ids to shapes without one, by material and order, and say so."""
    ids = Ids()
    shapes = scene.root.findall("shape")
    for node in scene.root.iter():
        if node.tag not in ("shape", "ref") and node.get("id"):
            ids.keep(node.get("id", ""))
    unnamed = [shape for shape in shapes if _GENERATED.match(shape.get("id", "")) or not ids.keep(shape.get("id", ""))]
    for shape in unnamed:
        shape.set("id", ids.make(_material(shape), "shape"))
    if unnamed:
        made = listed([shape.get("id", "") for shape in unnamed])
        count = f"{len(unnamed)} of {len(shapes)} shapes"
        scene.changes.note(f"{count} had no id of their own, and got one by material and order: {made}")


def _material(shape: Element) -> str:
    """The name of a shape's material, or else of its file."""
    for node in shape:
        if node.tag in ("ref", "bsdf") and node.get("id") and not _GENERATED.match(node.get("id", "")):
            name = node.get("id", "")
            return re.sub(r"[_-]?(bsdf|material|mat)$", "", name, flags=re.IGNORECASE) or name
    file = elements.child(shape, "filename")
    return Path(file.get("value", "")).stem if file is not None else shape.get("type", "")
