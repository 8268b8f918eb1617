"""Surfaces of glTF and MTL as Mitsuba's materials, layer by layer, and what they emit.

Letters: H W image, C channels. Mitsuba's v is downwards.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from photonfarm.renderer.tools.importing import elements, images
from photonfarm.renderer.tools.importing.changes import Changes, Effect

_COLOURS = ("base_color", "reflectance", "diffuse_reflectance")  # the properties that may be images of colour
_MOST_PADDING = 8192  # texels by which an image grows where it is clamped along one axis alone


@dataclass(frozen=True, slots=True)
class UvTransform:
    """Which place of an image each point of a surface shows, and how the image goes on beyond its edges."""

    rows: tuple[tuple[float, ...], ...] = ((1, 0, 0), (0, 1, 0))  # the image's coordinates by u, v and 1 of the mesh
    wraps: tuple[str, str] = ("repeat", "repeat")  # along each of its axes
    nearest: bool = False


@dataclass(frozen=True, slots=True)
class Map:
    """A property of a surface (H, W, C), linear or raw; without a transform it is the same everywhere, (1, 1, C)."""

    values: images.Image
    transform: UvTransform | None = None
    file: Path | None = None  # an image that Mitsuba reads as it is; the values are its own, or not decoded: (0, 0, C)


def constant(*values: float) -> Map:
    """A property that is the same everywhere."""
    return Map(np.array(values, np.float32).reshape(1, 1, -1))


@dataclass(frozen=True, slots=True)
class Writer:
    """What writes one material, and the images that it needs."""

    stem: Path  # with which the names of images begin
    changes: Changes
    place: str  # the material as a message names it
    reach: Sequence[Sequence[float]] = ((0.0, 1.0), (0.0, 1.0))  # the least and the greatest u and v of its meshes

    def lose(self, name: str, meaning: str) -> None:
        """Say what of the material's appearance is not carried over."""
        self.changes.lose("colour", name, meaning, self.place)

    def note(self, meaning: str, name: str = "") -> None:
        """Say what does not change the picture."""
        self.changes.note(meaning, self.place, name=name)

    def put(self, parent: Element, name: str, part: Map, kind: Literal["raw", "colour", "light"] = "raw") -> None:
        """Add a number, a colour or an image."""
        if part.transform is None:
            numbers = part.values.ravel().tolist()
            elements.put_value(parent, name, numbers if len(numbers) > 1 else numbers[0])
            return
        (values, transform), file = self._wrap(part.values, part.transform), part.file
        if file is None and kind == "light":
            file = images.save_radiance(values, self.stem.with_name(f"{self.stem.name}_{name}.exr"))
        elif file is None:
            stored = images.encode(values) if kind == "colour" else values.clip(0, 1)
            file = images.save(stored, self.stem.with_name(f"{self.stem.name}_{name}.png"))
        bitmap = elements.put_bitmap(parent, name, file, raw=kind != "colour")
        if transform.nearest:
            elements.put_value(bitmap, "filter_type", "nearest")
        if transform.wraps[0] != "repeat":
            elements.put_value(bitmap, "wrap_mode", transform.wraps[0])
        if transform.rows != UvTransform().rows:
            rows = [(a, b, 0, c) for a, b, c in transform.rows]
            elements.put_matrix(bitmap, "to_uv", [*rows, (0, 0, 1, 0), (0, 0, 0, 1)])

    def _wrap(self, values: images.Image, transform: UvTransform) -> tuple[images.Image, UvTransform]:
        """An image that goes on in one way along both axes, as Mitsuba's do.

        Clamped along one axis it gets a border as wide as its coordinates reach; mirrored, its mirror image beside it.
        """
        if transform.wraps[0] == transform.wraps[1]:
            return values, transform
        axis = transform.wraps.index("clamp" if "clamp" in transform.wraps else "mirror")
        size, left = values.shape[1 - axis], 0
        texels = np.r_[0:size, size - 1 : -1 : -1]
        a, b, c = transform.rows[axis]
        if transform.wraps[axis] == "clamp":
            ends = [size * (a * u + b * v + c) for u in self.reach[0] for v in self.reach[1]]
            over = np.array([-min(ends), max(ends) - size]).clip(0)
            if over.max() > _MOST_PADDING:
                meaning = f"an image that is clamped reaches no farther than {_MOST_PADDING} texels from its edge"
                self.lose(("wrapS", "wrapT")[axis], meaning)
            left, right = (np.ceil(over.clip(max=_MOST_PADDING)) + 1).astype(int).tolist()
            texels = np.arange(-left, size + right)
        rows, other, scale = list(transform.rows), transform.wraps[1 - axis], size / len(texels)
        rows[axis] = (scale * a, scale * b, scale * c + left / len(texels))
        values = np.take(values, texels.clip(0, size - 1), axis=1 - axis)
        return values, replace(transform, rows=tuple(rows), wraps=(other, other))

    def join(
        self, one: Map, other: Map, effect: Effect, name: str
    ) -> tuple[images.Image, images.Image, UvTransform | None]:
        """The values of two properties at the same texels, and how these lie; the mean of what lies differently."""
        if one.transform and other.transform and one.transform != other.transform:
            meaning = "lies unlike the image that it is joined with, whose mean is taken"
            self.changes.lose(effect, name, meaning, self.place)
            other = Map(other.values.mean(axis=(0, 1), keepdims=True))
        size = np.maximum(one.values.shape[:2], other.values.shape[:2])  # each is stretched to it
        texels = [np.ix_(*(np.arange(size[i]) * of.values.shape[i] // size[i] for i in (0, 1))) for of in (one, other)]
        return one.values[texels[0]], other.values[texels[1]], one.transform or other.transform

    def put_layers(self, top: Element, opacity: Map | None, normals: Map | None, *, passes: bool = False) -> Element:
        """Put what lies above a material; the place of the material, two-sided unless it `passes` light."""
        if opacity is not None:
            top.set("type", "mask")
            self.put(top, "opacity", opacity)
            top = SubElement(top, "bsdf")
        if not passes:
            top.set("type", "twosided")
            top = SubElement(top, "bsdf")
        if normals is not None:
            top.set("type", "normalmap")
            self.put(top, "normalmap", normals)
            top = SubElement(top, "bsdf")
        return top

    def normals(self, part: Map, strength: float, name: str, *, mirrored: bool, from_flat: bool = False) -> Map:
        """A normal map of a strength, which by glTF's rule is a factor on x and y.

        With `from_flat`, as Blender reads MTL, normals go so far from the flat (0, 0, 1) to those of the map. Mitsuba's
        frame is right-handed where images lie mirrored, too, so y is turned over there.
        """
        (a, b, _), (c, d, _) = (part.transform or UvTransform()).rows
        if b or c or min(a, d) < 0:
            self.note("turns or mirrors the image, and not the directions in it", name)
        if strength == 1 and not mirrored:
            return part
        vectors = (2 * part.values - 1) * np.array([strength, -strength if mirrored else strength, 1], np.float32)
        if from_flat:
            vectors[..., 2] = 1 + strength * (vectors[..., 2] - 1)
        return Map(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True) / 2 + np.float32(0.5), part.transform)

    def put_surface(self, place: Element, plugin: str, parts: Mapping[str, Map], *, painted: bool = False) -> None:
        """Put a material by its properties; that of a `painted` mesh has the colours of its vertices."""
        place.set("type", plugin)
        for name, part in parts.items():
            if painted and name in _COLOURS:
                texture = SubElement(place, "texture", name=name, type="mesh_attribute")
                elements.put_value(texture, "name", "vertex_color")
            else:
                self.put(place, name, part, "colour" if name in _COLOURS else "raw")

    def light(self, glow: Map, opacity: Map | None, name: str) -> Element | None:
        """What a surface emits, if anything: Mitsuba's lights shine where their material lets light through."""
        if opacity is not None and glow.values.any():
            values, alpha, transform = self.join(glow, opacity, "light", name)
            glow = Map(values * alpha, transform)
        if glow.values.max() <= 0:
            return None
        emitter = Element("emitter", type="area")
        self.put(emitter, "radiance", glow, "light")
        return emitter
