"""glTF's materials as Mitsuba's: metallic-roughness becomes `principled`, clear glass a dielectric.

Roughness is the green channel and metallic the blue one, both raw numbers; colours are sRGB. Factors are multiplied
into the images, as Mitsuba's textures have none. glTF's texture coordinates have v downwards, as Mitsuba's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from photonfarm.renderer.importing import elements
from photonfarm.renderer.importing.changes import Changes
from photonfarm.renderer.importing.imported import Ids
from photonfarm.renderer.importing.readers import images
from photonfarm.renderer.importing.readers.gltf_file import GltfFile, Node

_CARRIED = frozenset(
    {"KHR_materials_emissive_strength", "KHR_materials_ior", "KHR_materials_transmission", "KHR_materials_volume"}
)

_WRAPS = {33071: "clamp", 33648: "mirror", 10497: "repeat"}

_PARTS = {
    "KHR_materials_clearcoat": "clearcoat",
    "KHR_materials_sheen": "sheen",
    "KHR_materials_specular": "specular tint",
    "KHR_materials_anisotropy": "anisotropy",
    "KHR_materials_iridescence": "iridescence",
    "KHR_materials_unlit": "being unlit",
    "KHR_materials_dispersion": "dispersion",
    "KHR_materials_pbrSpecularGlossiness": "specular-glossiness",
}

CUTOFF = 0.5
"""glTF's default of `alphaCutoff`."""


@dataclass(slots=True)
class Materials:
    """The materials of a file, made when they are first used."""

    file: GltfFile
    root: Element  # gets the materials
    scratch: Path  # gets the images
    changes: Changes
    ids: Ids
    _made: dict[int | None, str] = field(default_factory=dict)
    _images: dict[int, images.Image] = field(default_factory=dict)

    def material_id(self, number: int | None) -> str:
        """The id of a material in the Mitsuba scene; None is that of what has none."""
        if number not in self._made:
            self._made[number] = self._make(number)
        return self._made[number]

    def uv_set(self, number: int | None) -> int:
        """Which set of texture coordinates a material's images use, most of all its colour."""
        used = [_uv_set(found) for found in self._textures(number)]
        return used[0] if used else 0

    def light(self, number: int | None) -> Element | None:
        """The emitter of what shines with a material; None if it does not."""
        if number is None:
            return None
        entry = self.file.all("materials")[number]
        strength = _extension(entry, "KHR_materials_emissive_strength").get("emissiveStrength", 1.0)
        radiance = [strength * part for part in entry.get("emissiveFactor", (0, 0, 0))]
        if max(radiance) <= 0:
            return None
        if "emissiveTexture" not in entry:
            return elements.area_light(radiance)
        values = images.linear(self._image(entry["emissiveTexture"])[..., :3]) * np.array(radiance, np.float32)
        if values.max() <= 0:
            return None
        emitter = Element("emitter", type="area")
        file = images.save_radiance(values, self.scratch / f"emission_{number}.exr")
        self._finish(elements.put_bitmap(emitter, "radiance", file, raw=True), entry["emissiveTexture"])
        return emitter

    # ----------------------------------------------------------------------------------------------- one material

    def _make(self, number: int | None) -> str:
        entry: Node = {} if number is None else self.file.all("materials")[number]
        made = self.ids.make(entry.get("name", f"material_{number}"), "material")
        top = _holder(self.root, made)
        if number is None:
            top.set("type", "twosided")
            elements.put_value(SubElement(top, "bsdf", type="diffuse"), "reflectance", (0.8, 0.8, 0.8))
            return made
        self._say_what_is_lost(entry, number, made)
        surface = entry.get("pbrMetallicRoughness", {})
        self._put_mask(top, entry, surface, made)
        self._put_surface(self._under_mask(top), entry, surface, made)
        return made

    def _under_mask(self, top: Element) -> Element:
        return SubElement(top, "bsdf") if top.get("type") == "mask" else top

    def _put_surface(self, place: Element, entry: Node, surface: Node, made: str) -> None:
        passes = _extension(entry, "KHR_materials_transmission").get("transmissionFactor", 0.0)
        thick = _extension(entry, "KHR_materials_volume").get("thicknessFactor", 0.0) > 0
        ior = max(_extension(entry, "KHR_materials_ior").get("ior", 1.5), 1.01)
        if passes > 0 and surface.get("roughnessFactor", 1.0) == 0 and "baseColorTexture" not in surface:
            place.set("type", "dielectric" if thick else "thindielectric")
            elements.put_value(place, "int_ior", float(ior))
            tint = surface.get("baseColorFactor", (1, 1, 1))[:3]
            elements.put_value(
                place, "specular_transmittance", [math.sqrt(passes * part) if thick else passes * part for part in tint]
            )
            return
        if not passes:
            place.set("type", "twosided")
            place = SubElement(place, "bsdf")
        place = self._put_normal_map(place, entry, made)
        place.set("type", "principled")
        elements.put_value(place, "eta", float(ior))
        self._put_colour(place, surface, made)
        self._put_metal(place, surface, made)
        if passes:
            elements.put_value(place, "spec_trans", float(passes))

    def _put_normal_map(self, place: Element, entry: Node, made: str) -> Element:
        """The place of the material under its normal map."""
        found = entry.get("normalTexture")
        if found is None:
            return place
        if found.get("scale", 1.0) != 1.0:
            self.changes.lose(
                "colour", "normalTexture.scale", "normal maps have their full strength", f"material {made!r}"
            )
        place.set("type", "normalmap")
        file = images.save(self._image(found)[..., :3], self.scratch / f"{made}_normal.png")
        self._finish(elements.put_bitmap(place, "normalmap", file, raw=True), found)
        return SubElement(place, "bsdf")

    def _put_colour(self, place: Element, surface: Node, made: str) -> None:
        factor = surface.get("baseColorFactor", (1, 1, 1, 1))
        found = surface.get("baseColorTexture")
        if found is None:
            elements.put_value(place, "base_color", _floats(factor[:3]))
            return
        file = images.save(images.tinted(self._image(found), factor), self.scratch / f"{made}_color.png")
        self._finish(elements.put_bitmap(place, "base_color", file), found)

    def _put_metal(self, place: Element, surface: Node, made: str) -> None:
        found = surface.get("metallicRoughnessTexture")
        for name, channel in (("roughness", 1), ("metallic", 2)):
            factor = float(surface.get(f"{name}Factor", 1.0))
            if found is None or factor == 0:
                elements.put_value(place, name, factor)
                continue
            file = images.save(factor * self._image(found)[..., channel], self.scratch / f"{made}_{name}.png")
            self._finish(elements.put_bitmap(place, name, file, raw=True), found)

    def _put_mask(self, top: Element, entry: Node, surface: Node, made: str) -> None:
        """Opacity, from the alpha of the colour."""
        mode = entry.get("alphaMode", "OPAQUE")
        if mode == "OPAQUE":
            return
        factor = float(surface.get("baseColorFactor", (1, 1, 1, 1))[3])
        found = surface.get("baseColorTexture")
        if found is None and mode == "BLEND" and factor < 1:
            top.set("type", "mask")
            elements.put_value(top, "opacity", factor)
        if found is None:
            return
        alpha = factor * self._image(found)[..., 3]
        if mode == "MASK":
            alpha = (alpha >= entry.get("alphaCutoff", CUTOFF)).astype(np.float32)
        if alpha.min() == 1:
            return
        top.set("type", "mask")
        file = images.save(alpha, self.scratch / f"{made}_opacity.png")
        self._finish(elements.put_bitmap(top, "opacity", file, raw=True), found)

    # -------------------------------------------------------------------------------------------------- textures

    def _image(self, found: Node) -> images.Image:
        source = self._source(found)
        if source not in self._images:
            name, data = self.file.image(source)
            self._images[source] = images.decoded(data, f"{self.file.path}: image {source} ({name})")
        return self._images[source]

    def _source(self, found: Node) -> int:
        texture = self.file.all("textures")[found["index"]]
        webp = _extension(texture, "EXT_texture_webp")
        return int(webp.get("source", texture.get("source", 0)))

    def _finish(self, bitmap: Element, found: Node) -> None:
        """Add the place of a texture: how it repeats, and its transform."""
        texture = self.file.all("textures")[found["index"]]
        if "sampler" in texture:
            sampler = self.file.all("samplers")[texture["sampler"]]
            wrap = _WRAPS.get(sampler.get("wrapS", 10497), "repeat")
            if wrap != "repeat":
                elements.put_value(bitmap, "wrap_mode", wrap)
        transform = _extension(found, "KHR_texture_transform")
        if transform:
            elements.put_matrix(bitmap, "to_uv", _uv_matrix(transform))

    def _textures(self, number: int | None) -> list[Node]:
        if number is None:
            return []
        entry = self.file.all("materials")[number]
        surface = entry.get("pbrMetallicRoughness", {})
        places = (surface.get("baseColorTexture"), surface.get("metallicRoughnessTexture"),
                  entry.get("normalTexture"), entry.get("emissiveTexture"))  # fmt: skip
        return [found for found in places if found is not None]

    def _say_what_is_lost(self, entry: Node, number: int, made: str) -> None:
        lost = [_PARTS.get(name, name) for name in entry.get("extensions", {}) if name not in _CARRIED]
        if "occlusionTexture" in entry:
            lost.append("baked occlusion, which is computed here")
        volume = _extension(entry, "KHR_materials_volume")
        if "attenuationDistance" in volume:
            lost.append("absorption inside it")
        if "transmissionTexture" in _extension(entry, "KHR_materials_transmission"):
            lost.append("the map of its transmission")
        if lost:
            for name in lost:
                self.changes.lose("colour", name, "is not carried over", f"material {made!r}")
        sets = {_uv_set(found) for found in self._textures(number)}
        if len(sets) > 1:
            self.changes.lose(
                "colour",
                "texCoord",
                "all images use one set of texture coordinates, that of the colour",
                f"material {made!r}",
            )


def _holder(root: Element, made: str) -> Element:
    """A material before the shapes, whose type is not decided yet."""
    holder = Element("bsdf", id=made)
    root.insert(len(root.findall("bsdf")), holder)
    return holder


def _extension(entry: Node, name: str) -> Node:
    found: Node = entry.get("extensions", {}).get(name, {})
    return found


def _uv_set(found: Node) -> int:
    return int(_extension(found, "KHR_texture_transform").get("texCoord", found.get("texCoord", 0)))


def _uv_matrix(transform: Node) -> list[list[float]]:
    """The matrix of `KHR_texture_transform`: scaled, then turned, then moved."""
    (u, v), (su, sv) = transform.get("offset", (0, 0)), transform.get("scale", (1, 1))
    c, s = math.cos(transform.get("rotation", 0.0)), math.sin(transform.get("rotation", 0.0))
    return [[c * su, s * sv, 0, u], [-s * su, c * sv, 0, v], [0, 0, 1, 0], [0, 0, 0, 1]]


def _floats(values: Sequence[float]) -> list[float]:
    return [float(value) for value in values]
