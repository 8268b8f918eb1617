"""glTF's materials and textures as Mitsuba's: metallic-roughness becomes `principled`, clear glass a dielectric.

Roughness is the green channel and metallic the blue one, both raw numbers; colours are sRGB. glTF's v is downwards, as
Mitsuba's.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from photonfarm.renderer.tools.importing import images
from photonfarm.renderer.tools.importing.imported import Floats, ImportedScene
from photonfarm.renderer.tools.importing.readers.gltf_file import GltfFile, Node, extension, numbers
from photonfarm.renderer.tools.importing.surfaces import Map, UvTransform, Writer, constant

_OLD = "KHR_materials_pbrSpecularGlossiness"
_PASSES, _COAT, _SPECULAR = "KHR_materials_transmission", "KHR_materials_clearcoat", "KHR_materials_specular"
_FORMATS = ("EXT_texture_webp", "EXT_texture_avif", "MSFT_texture_dds")
_TRANSFORM = "KHR_texture_transform"

_WRAPS = {33071: "clamp", 33648: "mirror", 10497: "repeat"}
_NEAREST = 9728
_WHITE = (1.0, 1.0, 1.0, 1.0)
_RGB, _RGBA, _ALPHA = slice(0, 3), slice(0, 4), slice(3, 4)

_PARTS = {
    "roughness": ("pbrMetallicRoughness", "roughnessFactor", 1.0, "metallicRoughnessTexture", 1),
    "metallic": ("pbrMetallicRoughness", "metallicFactor", 1.0, "metallicRoughnessTexture", 2),
    "spec_trans": (_PASSES, "transmissionFactor", 0.0, "transmissionTexture", 0),
    "clearcoat": (_COAT, "clearcoatFactor", 0.0, "clearcoatTexture", 0),
    "clearcoat_gloss": (_COAT, "clearcoatRoughnessFactor", 0.0, "clearcoatRoughnessTexture", 1),
}
"""Properties of `principled`: where glTF has them, their factor and its default, their image and its channel."""

_UNNAMED: Node = {"pbrMetallicRoughness": {"metallicFactor": 0.0}}  # the material of what has none
_DULLEST = 1.01  # the least index of refraction of `principled`; what has it reflects by its colour alone
_F0 = 0.04  # the reflectance of a dielectric in specular-glossiness, seen along the normal


class Look(NamedTuple):
    """A material as a mesh has it."""

    number: int | None
    mirrored: bool = False  # its images are on the mesh, and so its normal map is
    tint: tuple[float, ...] = _WHITE  # by which all vertices multiply its colour and alpha
    painted: bool = False  # its colour is the mesh's attribute `vertex_color`


@dataclass(slots=True)
class Materials:
    """The materials of a file, made when they are first used; what is made of images is written into a folder."""

    file: GltfFile
    scene: ImportedScene  # gets the materials
    scratch: Path
    _made: dict[Look, tuple[str, Element | None]] = field(default_factory=dict)
    _reach: dict[int | None, Floats] = field(default_factory=dict)
    _last: dict[tuple[int, bool], images.Image] = field(default_factory=dict)  # used twice in a row, mostly

    def entry(self, number: int | None) -> Node:
        """A material of the file, with its extensions among its properties; None is that of what has none."""
        material = _UNNAMED if number is None else self.file.entry("materials", number)
        entry = {**material, **material.get("extensions", {})}
        if (old := entry.get(_OLD)) is not None:
            image, factor = old.get("diffuseTexture"), old.get("diffuseFactor", _WHITE)
            entry["pbrMetallicRoughness"] = {"baseColorTexture": image, "baseColorFactor": factor}
        return entry

    def name(self, look: Look) -> str:
        """The name of a material, or its number."""
        return str(self.entry(look.number).get("name") or f"material_{'none' if look.number is None else look.number}")

    def is_unseen(self, look: Look) -> bool:
        """Whether a material is wholly transparent by its factors."""
        entry = self.entry(look.number)
        alpha = look.tint[3] * numbers(entry.get("pbrMetallicRoughness", {}), "baseColorFactor", _WHITE)[3]
        mode = entry.get("alphaMode", "OPAQUE")
        return bool(alpha < entry.get("alphaCutoff", 0.5)) if mode == "MASK" else bool(mode == "BLEND" and alpha <= 0)

    def find_uv_sets(self, number: int | None) -> list[int]:
        """The sets of texture coordinates that a material's images use, that of its colour first."""
        entry = self.entry(number)
        colour = {"first": entry.get("pbrMetallicRoughness", {}).get("baseColorTexture")}
        return list(dict.fromkeys(_uv_sets({**colour, **entry})))

    def extend(self, number: int | None, uv: Floats) -> None:
        """Learn how far the texture coordinates of a mesh of a material reach."""
        points = np.nan_to_num(np.concatenate([uv, self._reach.get(number, uv[:1])]))
        self._reach[number] = np.stack([points.min(axis=0), points.max(axis=0)])

    def make(self, look: Look) -> tuple[str, Element | None]:
        """A material's id in the Mitsuba scene, and the emitter of what shines with it."""
        if look in self._made:
            return self._made[look]
        entry = self.entry(look.number)
        surface = entry.get("pbrMetallicRoughness", {})
        made = self.scene.ids.make(self.name(look) + "_mirrored" * look.mirrored, "material")
        reach = self._reach.get(look.number, np.array([[0.0, 0.0], [1.0, 1.0]]))
        place = f"material {self.name(look)!r}"
        writer = Writer(self.scratch / made, self.scene.changes, place, reach.T.tolist())
        if "occlusionTexture" in entry:
            writer.note("light is computed here", "occlusionTexture")
        top = Element("bsdf", id=made)
        self.scene.root.insert(len(self.scene.root.findall("bsdf")), top)
        factor = (np.array(look.tint) * numbers(surface, "baseColorFactor", _WHITE)).tolist()
        colour = self._map(surface.get("baseColorTexture"), factor, _RGBA, colour=True)
        opacity, normals = _opacity(entry, colour), self._normals(entry, look, writer)
        plugin, parts = self._surface(entry, colour, look.painted, writer)
        below = writer.put_layers(top, opacity, normals, passes="spec_trans" in parts or "dielectric" in plugin)
        writer.put_surface(below, plugin, parts, painted=look.painted)
        strength = entry.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
        glow = (strength * numbers(entry, "emissiveFactor", (0, 0, 0))).tolist()
        light = self._map(entry.get("emissiveTexture"), glow, _RGB, colour=True)
        self._made[look] = made, writer.light(light, opacity, "emissiveTexture")
        return self._made[look]

    def _map(self, node: Node | None, factor: Sequence[float], channels: slice, *, colour: bool = False) -> Map:
        """Some channels of an image, times their factors; the factors alone without an image that is read."""
        image = self._image(node, colour) if node is not None and any(factor) else None
        if image is None or node is None:
            return constant(*factor)
        if colour:
            image = np.dstack([images.linear(image[..., :3]), image[..., 3:]])
        return Map(image[..., channels] * np.array(factor, np.float32), self._read_uv_transform(node))

    def _image(self, node: Node, colour: bool) -> images.Image | None:
        """The pixels of a texture: of the image that all programs read, or else of a format that is read here."""
        texture, place = self.file.entry("textures", node["index"]), f"texture {node['index']}"
        entries = [("", texture), *((name, extension(texture, name)) for name in _FORMATS)]
        sources = [(name, int(entry["source"])) for name, entry in entries if "source" in entry]
        for name, _ in sources[1:]:
            self.scene.changes.note("is left out beside the texture's other image", place, name=name)
        if not sources:
            name = ", ".join(texture.get("extensions", ())) or "source"
            meaning = "a texture has no image that is read, so that its factor stands alone"
            self.scene.changes.lose("colour", name, meaning, place)
            return None
        source = sources[0][1]
        if (source, colour) not in self._last:
            data = self.file.image(source)
            if data is None:
                return None
            self._last = {(source, colour): images.decode(data, f"{self.file.path}: image {source}", raw=not colour)}
        return self._last[source, colour]

    def _read_uv_transform(self, node: Node) -> UvTransform:
        number, moved = self.file.entry("textures", node["index"]).get("sampler"), extension(node, _TRANSFORM)
        sampler = {} if number is None else self.file.entry("samplers", number)
        (u, v), (su, sv) = moved.get("offset", (0, 0)), moved.get("scale", (1, 1))
        c, s = math.cos(moved.get("rotation", 0.0)), math.sin(moved.get("rotation", 0.0))
        wraps = [_WRAPS[sampler.get(key, 10497)] for key in ("wrapS", "wrapT")]
        rows = ((c * su, s * sv, u), (-s * su, c * sv, v))
        return UvTransform(rows, (wraps[0], wraps[1]), sampler.get("magFilter") == _NEAREST)

    def _normals(self, entry: Node, look: Look, writer: Writer) -> Map | None:
        """A normal map of its strength."""
        node = entry.get("normalTexture")
        strength = node.get("scale", 1.0) if node else 1.0
        part = self._map(node, [strength and 1.0] * 3, _RGB)  # of strength 0, no image is read
        return writer.normals(part, strength, _TRANSFORM, mirrored=look.mirrored) if part.transform else None

    def _surface(self, entry: Node, colour: Map, painted: bool, writer: Writer) -> tuple[str, dict[str, Map]]:
        """The plugin that is nearest to a material, and its properties."""
        parts = self._parts(entry, colour, writer)
        metal, coated = parts["metallic"].values, bool(parts["clearcoat"].values.any())
        passes = bool(parts["spec_trans"].values.max() > 0 and metal.min() < 1)  # no light passes through metal
        parts["eta"] = _eta(entry, passes, writer)
        volume = entry.get("KHR_materials_volume", {})
        thick = volume.get("thicknessFactor", 0.0) > 0
        if passes and thick and "attenuationDistance" in volume and np.min(volume.get("attenuationColor", 1)) < 1:
            writer.lose("KHR_materials_volume", "light is not absorbed inside")
        if passes and not thick and metal.max() > 0:
            writer.lose(_PASSES, "what is thin, and metal in part, refracts as what is solid")
        elif passes:
            whole = parts["spec_trans"].values.min() >= 1 and parts["roughness"].values.max() + metal.max() <= 0
            clear = whole and not painted and all(part.transform is None for part in parts.values())
            if coated and (clear or not thick):
                writer.lose(_COAT, "glass has no coat of its own")
            if clear:
                # A solid's colour is met twice: where light enters and where it leaves
                tint = constant(*parts["base_color"].values.ravel() ** (0.5 if thick else 1))
                glass = {"int_ior": parts["eta"], "specular_transmittance": tint}
                return "dielectric" if thick else "thindielectric", glass
            if not thick:
                return "principledthin", {key: parts[key] for key in ("base_color", "roughness", "spec_trans", "eta")}
        if coated:
            writer.note("is that of `principled`, which is similar", _COAT)
        if parts["eta"].values.max() <= _DULLEST and metal.max() <= 0 and not (coated or passes):
            return "diffuse", {"reflectance": parts["base_color"]}  # which `principled` brightens at grazing angles
        if metal.min() < 1:
            writer.note(
                "samples and references are brighter than the file's program renders: Mitsuba's `principled` reflects "
                "up to a tenth more at grazing angles; a cube under a sky is 1.16, a white room 1.47 times as bright"
            )
        without = (() if passes else ("spec_trans",)) + (() if coated else ("clearcoat", "clearcoat_gloss"))
        return "principled", {name: part for name, part in parts.items() if name not in without}

    def _parts(self, entry: Node, colour: Map, writer: Writer) -> dict[str, Map]:
        """The properties of `principled`."""
        parts = {"base_color": replace(colour, values=colour.values[..., _RGB])}
        for name, (where, factor, default, image, channel) in _PARTS.items():
            node = entry.get(where, {})
            parts[name] = self._map(node.get(image), [node.get(factor, default)], slice(channel, channel + 1))
        if parts["clearcoat"].values.any() and "clearcoatNormalTexture" in entry[_COAT]:
            writer.lose("clearcoatNormalTexture", "the coat has the normals of what is under it")
        gloss = parts["clearcoat_gloss"]  # whose α is 0.1 without gloss, and 0.001 with all
        parts["clearcoat_gloss"] = replace(gloss, values=((0.1 - gloss.values**2) / 0.099).clip(0, 1))
        return parts | (self._convert(colour, entry[_OLD], writer) if _OLD in entry else {})

    def _convert(self, colour: Map, old: Node, writer: Writer) -> dict[str, Map]:
        """The properties of `principled` for specular-glossiness, texel by texel."""
        factor = (*numbers(old, "specularFactor", _WHITE[:3]), old.get("glossinessFactor", 1.0))
        specular = self._map(old.get("specularGlossinessTexture"), factor, _RGBA, colour=True)
        diffuse, gloss, transform = writer.join(colour, specular, "colour", _OLD)
        base, metal = convert_specular_glossiness(diffuse[..., _RGB], gloss[..., _RGB])
        writer.note("becomes metal and roughness by Khronos' formulas", _OLD)
        rough = replace(specular, values=1 - specular.values[..., _ALPHA])
        return {"base_color": Map(base, transform), "roughness": rough, "metallic": Map(metal, transform)}


def _opacity(entry: Node, colour: Map) -> Map | None:
    """Opacity, from the alpha of the colour; None is opaque."""
    mode, alpha = entry.get("alphaMode", "OPAQUE"), colour.values[..., _ALPHA]
    if mode == "MASK":
        alpha = (alpha >= entry.get("alphaCutoff", 0.5)).astype(np.float32)
    return None if mode == "OPAQUE" or alpha.min() >= 1 else replace(colour, values=alpha)


def _eta(entry: Node, passes: bool, writer: Writer) -> Map:
    """The index of refraction; `KHR_materials_specular` changes it where no light passes through."""
    ior, gloss = entry.get("KHR_materials_ior", {}).get("ior", 1.5), entry.get(_SPECULAR, {})
    colour = numbers(gloss, "specularColorFactor", (1, 1, 1))
    reflectance = min(((ior - 1) / (ior + 1)) ** 2 * colour.mean(), 1.0) * gloss.get("specularFactor", 1.0)
    root = math.sqrt(min(reflectance, 0.99))
    tinted = np.ptp(colour) > 0 or any(name.endswith("Texture") for name in gloss)
    eta = (1 + root) / (1 - root)
    if ior < 1 and passes:
        writer.lose("KHR_materials_ior", f"{ior:g} is no index of what refracts")
    if _SPECULAR in entry and ((reflectance > 0 and tinted) or (passes and abs(ior - eta) > 1e-6)):
        writer.lose(_SPECULAR, "its reflection has no colour, no image and, on glass, no strength of its own")
    return constant(max(float(ior) if passes else eta, _DULLEST))


def convert_specular_glossiness(diffuse: images.Image, specular: images.Image) -> tuple[images.Image, images.Image]:
    """Base colour (H, W, 3) and metal (H, W, 1), by the formulas in the appendix of the extension."""
    bright_diffuse, bright = (np.sqrt(c**2 @ np.array([[0.299], [0.587], [0.114]])) for c in (diffuse, specular))
    left = (1 - specular.max(axis=-1, keepdims=True)) / (1 - _F0)
    b = bright_diffuse * left + bright - 2 * _F0
    root = np.sqrt((b * b - 4 * _F0 * (_F0 - bright)).clip(0))
    metal = np.where(bright < _F0, 0, ((root - b) / (2 * _F0)).clip(0, 1))
    of_diffuse = diffuse * left / (1 - metal).clip(1e-6)
    of_specular = (specular - _F0 * (1 - metal)) / metal.clip(1e-6)
    base = (of_diffuse + (of_specular - of_diffuse) * metal**2).clip(0, 1)
    return base.astype(np.float32), metal.astype(np.float32)


def _uv_sets(entry: Node) -> Iterator[int]:
    """The sets of texture coordinates by which all images of an entry lie but those that are left out."""
    for key, value in entry.items():
        if isinstance(value, dict) and key not in ("extras", "occlusionTexture"):
            if "index" in value:
                yield int(extension(value, _TRANSFORM).get("texCoord", value.get("texCoord", 0)))
            yield from _uv_sets(value)
