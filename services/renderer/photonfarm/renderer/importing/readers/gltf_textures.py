"""glTF's textures as Mitsuba's: factors multiplied in, samplers and transforms carried over.

glTF's v is downwards, as Mitsuba's. Letters: H W image, C channels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal
from xml.etree.ElementTree import Element

import numpy as np

from photonfarm.renderer.importing import elements
from photonfarm.renderer.importing.changes import Effect
from photonfarm.renderer.importing.meshes import Floats
from photonfarm.renderer.importing.readers import images
from photonfarm.renderer.importing.readers.gltf_file import GltfFile, Node, extension
from photonfarm.shared.core.errors import SpecError

Kind = Literal["raw", "colour", "light"]

Reach = Floats
"""The least and the greatest texture coordinates of the meshes of a material (2, 2)."""

_WRAPS = {33071: "clamp", 33648: "mirror", 10497: "repeat"}
_NEAREST = 9728
TRANSFORM = "KHR_texture_transform"
_FORMATS = ("EXT_texture_webp", "EXT_texture_avif", "MSFT_texture_dds")

KEPT = 3
"""Decoded images that are kept for the next use of the same."""

MOST_PADDING = 8192
"""Texels by which an image grows where it is clamped along one axis alone."""


@dataclass(frozen=True, slots=True)
class Map:
    """Values of a surface: linear or raw, (H, W, C), and the reference that says how they lie; None if constant."""

    values: images.Image
    found: Node | None = None


@dataclass(slots=True)
class Textures:
    """The textures of a file; what is made of them is written into a folder."""

    file: GltfFile
    scratch: Path
    _decoded: dict[tuple[int, bool], images.Image] = field(default_factory=dict)

    def map(self, found: Node | None, factor: Sequence[float], channels: slice, *, colour: bool = False) -> Map:
        """Some channels of an image, times their factors; the factors alone without an image that is read."""
        factors = np.array(factor, np.float32)
        image = self._image(found, colour) if found is not None and factors.any() else None
        if image is None:
            return Map(factors.reshape(1, 1, -1))
        if colour:
            image = np.dstack([images.linear(image[..., :3]), image[..., 3:]])
        return Map(image[..., channels] * factors, found)

    def _image(self, found: Node, colour: bool) -> images.Image | None:
        texture, place = self.file.entry("textures", found["index"]), f"texture {found['index']}"
        entries = [(name, extension(texture, name)) for name in _FORMATS] + [("", texture)]
        sources = [(name, entry["source"]) for name, entry in entries if "source" in entry]
        if not sources:
            name = ", ".join(texture.get("extensions", ())) or "source"
            meaning = "a texture has no image that is read, so that its factor stands alone"
            self.file.changes.lose("colour", name, meaning, place)
            return None
        self.file.report(texture, "colour", place)
        self.file.report(self._sampler(found), "colour", place)
        for name, source in sources[:-1]:
            try:
                return self._decode(source, colour)
            except SpecError:
                self.file.changes.note("cannot be decoded, and the texture's other image is taken", place, name=name)
        return self._decode(sources[-1][1], colour)

    def _decode(self, source: int, colour: bool) -> images.Image:
        if (source, colour) not in self._decoded:
            if len(self._decoded) == KEPT:
                self._decoded.pop(next(iter(self._decoded)))
            name, data = self.file.image(source)
            what = f"{self.file.path}: image {source} ({name})"
            self._decoded[source, colour] = images.decoded(data, what, raw=not colour)
        return self._decoded[source, colour]

    def beside(self, one: Map, other: Map, effect: Effect, name: str, place: str) -> Map:
        """`other` at the texels of `one`, to be joined with it: its mean, which is said, where they lie differently."""
        if not one.found or not other.found:
            return other
        if self._lie(one.found) != self._lie(other.found):
            self.file.changes.lose(effect, name, "images that lie differently cannot be joined", place)
            return Map(other.values.mean(axis=(0, 1), keepdims=True))
        rows, columns = (np.arange(one.values.shape[i]) * other.values.shape[i] // one.values.shape[i] for i in (0, 1))
        return Map(other.values[rows][:, columns], other.found)

    def _lie(self, found: Node) -> tuple[Node, Node, int]:
        return self._sampler(found), extension(found, TRANSFORM), uv_set(found)

    def _sampler(self, found: Node) -> Node:
        number = self.file.entry("textures", found["index"]).get("sampler")
        return {} if number is None else self.file.entry("samplers", number)

    def put(self, parent: Element, name: str, made: Map, kind: Kind, stem: str, reach: Reach) -> None:
        """Add a property of a material: a number, a colour or an image."""
        if made.found is None:
            constant = [float(value) for value in made.values.ravel()]
            elements.put_value(parent, name, constant if len(constant) > 1 else constant[0])
            return
        values, wrap, matrix = self._wrapped(made.values, made.found, reach)
        write = images.save_radiance if kind == "light" else images.save
        file = self.scratch / f"{stem}.{'exr' if kind == 'light' else 'png'}"
        file = write(images.encoded(values) if kind == "colour" else values, file)
        bitmap = elements.put_bitmap(parent, name, file, raw=kind != "colour")
        if self._sampler(made.found).get("magFilter") == _NEAREST:
            elements.put_value(bitmap, "filter_type", "nearest")
        if wrap != "repeat":
            elements.put_value(bitmap, "wrap_mode", wrap)
        if not np.array_equal(matrix, np.eye(4)):
            elements.put_matrix(bitmap, "to_uv", matrix.tolist())

    def _wrapped(self, values: images.Image, found: Node, reach: Reach) -> tuple[images.Image, str, Floats]:
        """An image with one wrap mode for both axes, that mode, and the matrix of texture coordinates.

        What is clamped along one axis gets a border as wide as its coordinates reach; what is mirrored along one
        becomes an image and its mirror image, which repeat.
        """
        matrix, sampler = _uv_matrix(extension(found, TRANSFORM)), self._sampler(found)
        modes = [_WRAPS[sampler.get(key, 10497)] for key in ("wrapS", "wrapT")]
        if modes[0] == modes[1]:
            return values, modes[0], matrix
        axis = modes.index("clamp" if "clamp" in modes else "mirror")
        size, fit = values.shape[1 - axis], np.eye(4)
        if modes[axis] == "clamp":
            corners = np.array([[u, v, 0, 1] for u in reach[:, 0] for v in reach[:, 1]]) @ matrix.T
            over = np.array([-corners[:, axis].min(), corners[:, axis].max() - 1]).clip(0)
            border = np.ceil(over * size).clip(max=MOST_PADDING).astype(int) + 1
            if (over * size > MOST_PADDING).any():
                meaning = f"an image reaches no farther than {MOST_PADDING} texels from its edge"
                self.file.changes.lose("colour", ("wrapS", "wrapT")[axis], meaning, f"texture {found['index']}")
            values = np.pad(values, [tuple(border) if 1 - axis == i else (0, 0) for i in range(3)], mode="edge")
            fit[axis, axis], fit[axis, 3] = size / (size + border.sum()), border[0] / (size + border.sum())
            return values, modes[1 - axis], fit @ matrix
        fit[axis, axis] = 0.5
        return np.concatenate([values, np.flip(values, 1 - axis)], axis=1 - axis), "repeat", fit @ matrix


def uv_set(found: Node) -> int:
    """The set of texture coordinates by which an image lies."""
    return int(extension(found, TRANSFORM).get("texCoord", found.get("texCoord", 0)))


def _uv_matrix(transform: Node) -> Floats:
    """The matrix of `KHR_texture_transform`: scaled, then turned, then moved."""
    (u, v), (su, sv) = transform.get("offset", (0, 0)), transform.get("scale", (1, 1))
    c, s = math.cos(transform.get("rotation", 0.0)), math.sin(transform.get("rotation", 0.0))
    return np.array([[c * su, s * sv, 0, u], [-s * su, c * sv, 0, v], [0, 0, 1, 0], [0, 0, 0, 1]], np.float64)
