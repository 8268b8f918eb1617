"""glTF's materials as Mitsuba's: metallic-roughness becomes `principled`, clear glass a dielectric.

Roughness is the green channel and metallic the blue one, both raw numbers; colours are sRGB.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from photonfarm.renderer.importing import elements
from photonfarm.renderer.importing.imported import Ids
from photonfarm.renderer.importing.meshes import Floats
from photonfarm.renderer.importing.readers import images
from photonfarm.renderer.importing.readers.gltf_file import GltfFile, Node, extension, numbers
from photonfarm.renderer.importing.readers.gltf_textures import TRANSFORM, Kind, Map, Reach, Textures, uv_set

_OLD = "KHR_materials_pbrSpecularGlossiness"
_CLEARCOAT, _SPECULAR = "KHR_materials_clearcoat", "KHR_materials_specular"

_RED, _GREEN, _BLUE, _ALPHA = (slice(i, i + 1) for i in range(4))
_RGB, _RGBA = slice(0, 3), slice(0, 4)
_WHITE = (1.0, 1.0, 1.0, 1.0)

_NOTHING = Map(np.zeros((1, 1, 1), np.float32))

CUTOFF = 0.5
"""glTF's default of `alphaCutoff`."""

_UNNAMED: Node = {"pbrMetallicRoughness": {"metallicFactor": 0.0}}
"""The material of what has none."""

F0 = 0.04
"""The reflectance of a dielectric in specular-glossiness, seen along the normal."""


class Look(NamedTuple):
    """A material as a mesh has it."""

    number: int | None
    mirrored: bool = False  # its images are on the mesh, and so its normal map is
    tint: tuple[float, ...] = _WHITE  # by which all vertices multiply its colour and alpha
    painted: bool = False  # its colour is the mesh's attribute `vertex_color`


@dataclass(slots=True)
class Materials:
    """The materials of a file, made when they are first used."""

    file: GltfFile
    root: Element  # gets the materials
    textures: Textures
    ids: Ids
    _made: dict[Look, tuple[str, Element | None] | None] = field(default_factory=dict)
    _reach: dict[int | None, Reach] = field(default_factory=dict)

    def made(self, look: Look) -> tuple[str, Element | None] | None:
        """A material's id in the Mitsuba scene, and the emitter of what shines with it; None if it cannot be seen."""
        if look not in self._made:
            self._made[look] = self._make(look)
        return self._made[look]

    def entry(self, number: int | None) -> Node:
        """A material of the file; None is that of what has none."""
        return _UNNAMED if number is None else self.file.entry("materials", number)

    def uv_sets(self, number: int | None) -> list[int]:
        """The sets of texture coordinates that a material's images use, that of its colour first."""
        entry = self.entry(number)
        colour = _base(entry)[0]
        return list(dict.fromkeys(uv_set(found) for found in ([colour] if colour else []) + list(_references(entry))))

    def extend(self, number: int | None, uv: Floats) -> None:
        """Learn how far the texture coordinates of a mesh of a material reach."""
        points = np.nan_to_num(np.concatenate([uv, self._reach.get(number, uv[:1])]))
        self._reach[number] = np.stack([points.min(axis=0), points.max(axis=0)])

    def colour(self, number: int | None) -> tuple[bool, Floats]:
        """Whether a material's colour is more than a factor, and that factor (4,)."""
        found, factor = _base(self.entry(number))
        return found is not None or _OLD in self.entry(number).get("extensions", {}), np.array(factor, np.float64)

    def place(self, look: Look) -> str:
        """A material as a message names it."""
        return f"material {self._name(look)!r}"

    def _name(self, look: Look) -> str:
        return str(self.entry(look.number).get("name") or f"material_{'none' if look.number is None else look.number}")

    # ----------------------------------------------------------------------------------------------- one material

    def _put(self, place: Element, name: str, values: Map, kind: Kind, look: Look, made: str) -> None:
        reach = self._reach.get(look.number, np.array([[0.0, 0.0], [1.0, 1.0]]))
        self.textures.put(place, name, values, kind, f"{made}_{name}", reach)

    def _make(self, look: Look) -> tuple[str, Element | None] | None:
        entry = self.entry(look.number)
        opacity = self._opacity(look)
        if opacity is not None and opacity.values.max() <= 0:
            return None
        made = self.ids.make(self._name(look) + "_mirrored" * look.mirrored, "material")
        self.file.report(entry, "colour", self.place(look))
        if "occlusionTexture" in entry:
            self.file.changes.note("light is computed here", self.place(look), name="occlusionTexture")
        top = Element("bsdf", id=made)
        self.root.insert(len(self.root.findall("bsdf")), top)
        below = top
        if opacity is not None:
            top.set("type", "mask")
            self._put(top, "opacity", opacity, "raw", look, made)
            below = SubElement(top, "bsdf")
        self._put_surface(below, entry, look, made)
        return made, self._light(entry, look, opacity, made)

    def _light(self, entry: Node, look: Look, opacity: Map | None, made: str) -> Element | None:
        strength = extension(entry, "KHR_materials_emissive_strength").get("emissiveStrength", 1.0)
        factor = (strength * numbers(entry, "emissiveFactor", (0, 0, 0))).tolist()
        glow = self.textures.map(entry.get("emissiveTexture"), factor, _RGB, colour=True)
        if opacity is not None:  # Mitsuba's lights shine where their material lets light through
            opacity = self.textures.beside(glow, opacity, "light", "emissiveTexture", self.place(look))
            glow = Map(glow.values * opacity.values, glow.found or opacity.found)
        if glow.values.max() <= 0:
            return None
        emitter = Element("emitter", type="area")
        self._put(emitter, "radiance", glow, "light", look, made)
        return emitter

    def _colour(self, look: Look) -> Map:
        """Colour and alpha."""
        found, factor = _base(self.entry(look.number))
        return self.textures.map(found, np.multiply(factor, look.tint).tolist(), _RGBA, colour=True)

    def _opacity(self, look: Look) -> Map | None:
        """Opacity, from the alpha of the colour; None is opaque."""
        entry = self.entry(look.number)
        mode = entry.get("alphaMode", "OPAQUE")
        if mode == "OPAQUE":
            return None
        colour = self._colour(look)
        alpha = colour.values[..., _ALPHA]
        if mode == "MASK":
            alpha = (alpha >= entry.get("alphaCutoff", CUTOFF)).astype(np.float32)
        return None if alpha.min() >= 1 else replace(colour, values=alpha)

    def _put_surface(self, place: Element, entry: Node, look: Look, made: str) -> None:
        parts = self._parts(entry, look)
        if parts["metallic"].values.min() >= 1:
            parts["spec_trans"] = _NOTHING  # light does not pass through metal
        passes = parts["spec_trans"].values.max() > 0
        volume = extension(entry, "KHR_materials_volume")
        thick = volume.get("thicknessFactor", 0.0) > 0
        if passes and thick and "attenuationDistance" in volume and np.min(volume.get("attenuationColor", 1)) < 1:
            self._lose("KHR_materials_volume", "light is not absorbed inside", look)
        plain = all(parts[name].found is None for name in ("base_color", "roughness", "metallic", "spec_trans"))
        clear = passes and plain and parts["roughness"].values.max() == 0 and not look.painted
        eta = self._eta(entry, bool(passes), look)
        if passes and not thick and not clear:
            meaning = "what is thin and rough, or has images, refracts as what is solid"
            self.file.changes.note(meaning, self.place(look), name="KHR_materials_transmission")
        if not passes:
            place.set("type", "twosided")
            place = SubElement(place, "bsdf")
        place = self._put_normal_map(place, entry, look, made)
        if clear:
            if "clearcoat" in parts:
                self._lose(_CLEARCOAT, "clear glass has no coat of its own", look)
            parts, place = _put_glass(place, parts, thick, eta)
        if parts:
            self._put_principled(place, parts, eta, look, made)

    def _put_principled(self, place: Element, parts: dict[str, Map], eta: float, look: Look, made: str) -> None:
        if "clearcoat" in parts:
            self.file.changes.note("is that of `principled`, which is similar", self.place(look), name=_CLEARCOAT)
        if parts["metallic"].values.min() < 1:
            meaning = "reflects up to a tenth more than glTF says, as Mitsuba's `principled` does at grazing angles"
            self.file.changes.note(meaning, self.place(look))
        place.set("type", "principled")
        elements.put_value(place, "eta", eta)
        colour = parts.pop("base_color")
        if look.painted:
            painted = SubElement(place, "texture", name="base_color", type="mesh_attribute")
            elements.put_value(painted, "name", "vertex_color")
        else:
            self._put(place, "base_color", replace(colour, values=colour.values[..., _RGB]), "colour", look, made)
        for name, values in parts.items():
            if name in ("roughness", "metallic") or values.values.any():
                self._put(place, name, values, "raw", look, made)

    def _parts(self, entry: Node, look: Look) -> dict[str, Map]:
        """The parameters of `principled`."""
        colour = self._colour(look)
        if _OLD in entry.get("extensions", {}):
            parts = self._converted(colour, extension(entry, _OLD), look)
        else:
            surface = entry.get("pbrMetallicRoughness", {})
            found = surface.get("metallicRoughnessTexture")
            parts = {"base_color": colour}
            for name, channel in (("roughness", _GREEN), ("metallic", _BLUE)):
                parts[name] = self.textures.map(found, [surface.get(f"{name}Factor", 1.0)], channel)
        passes = extension(entry, "KHR_materials_transmission")
        factor = [passes.get("transmissionFactor", 0.0)]
        parts["spec_trans"] = self.textures.map(passes.get("transmissionTexture"), factor, _RED)
        return parts | self._coat(extension(entry, _CLEARCOAT), look)

    def _converted(self, colour: Map, gloss: Node, look: Look) -> dict[str, Map]:
        """The parameters of `principled` for specular-glossiness, texel by texel."""
        factor = (*numbers(gloss, "specularFactor", _WHITE[:3]), gloss.get("glossinessFactor", 1.0))
        specular = self.textures.map(gloss.get("specularGlossinessTexture"), factor, _RGBA, colour=True)
        beside = self.textures.beside(colour, specular, "colour", _OLD, self.place(look))
        base, metal = from_specular_glossiness(colour.values[..., _RGB], beside.values[..., _RGB])
        found = colour.found or beside.found
        self.file.changes.note("becomes metal and roughness by Khronos' formulas", self.place(look), name=_OLD)
        rough = replace(specular, values=1 - specular.values[..., _ALPHA])
        return {"base_color": Map(base, found), "roughness": rough, "metallic": Map(metal, found)}

    def _coat(self, coat: Node, look: Look) -> dict[str, Map]:
        """The clear coat: `principled` has one of the same strength, whose α is 0.1 at most, and 0.001 at least."""
        strength = self.textures.map(coat.get("clearcoatTexture"), [coat.get("clearcoatFactor", 0.0)], _RED)
        if not strength.values.any():
            return {}
        factor = [coat.get("clearcoatRoughnessFactor", 0.0)]
        rough = self.textures.map(coat.get("clearcoatRoughnessTexture"), factor, _GREEN)
        if "clearcoatNormalTexture" in coat:
            self._lose("clearcoatNormalTexture", "the coat has the normals of what is under it", look)
        gloss = replace(rough, values=((0.1 - rough.values**2) / 0.099).clip(0, 1))
        return {"clearcoat": strength, "clearcoat_gloss": gloss}

    def _eta(self, entry: Node, passes: bool, look: Look) -> float:
        """The index of refraction; `KHR_materials_specular` changes it where no light passes through."""
        ior, gloss = extension(entry, "KHR_materials_ior").get("ior", 1.5), extension(entry, _SPECULAR)
        colour = numbers(gloss, "specularColorFactor", (1, 1, 1))
        reflectance = min(((ior - 1) / (ior + 1)) ** 2 * colour.mean(), 1.0) * gloss.get("specularFactor", 1.0)
        root = math.sqrt(min(reflectance, 0.99))
        tinted = np.ptp(colour) > 0 or any(name.endswith("Texture") for name in gloss)
        eta = (1 + root) / (1 - root)
        if (reflectance > 0 and tinted) or (passes and abs(ior - eta) > 1e-6):
            self._lose(_SPECULAR, "its reflection has no colour, no image and, on glass, no strength of its own", look)
        return max(float(ior) if passes else eta, 1.01)

    def _put_normal_map(self, place: Element, entry: Node, look: Look, made: str) -> Element:
        """The place of the material under its normal map. Mitsuba's frame is right-handed on mirrored images too."""
        found = entry.get("normalTexture", {})
        normals = self.textures.map(found or None, _WHITE[:3], _RGB)
        scale = found.get("scale", 1.0)
        if normals.found is None or scale == 0:
            return place
        moved = extension(normals.found, TRANSFORM)
        if moved.get("rotation", 0) or min(moved.get("scale", (1, 1))) < 0:
            meaning = "a normal map that is turned or mirrored by it keeps the directions of its texture coordinates"
            self.file.changes.note(meaning, self.place(look), name=TRANSFORM)
        values = normals.values
        if scale != 1:
            vectors = (2 * values - 1) * np.array([scale, scale, 1], np.float32)
            values = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True) / 2 + 0.5
        if look.mirrored:
            values = np.dstack([values[..., 0], 1 - values[..., 1], values[..., 2]])
        place.set("type", "normalmap")
        self._put(place, "normalmap", Map(values, normals.found), "raw", look, made)
        return SubElement(place, "bsdf")

    def _lose(self, name: str, meaning: str, look: Look) -> None:
        self.file.changes.lose("colour", name, meaning, self.place(look))


def _put_glass(place: Element, parts: dict[str, Map], thick: bool, eta: float) -> tuple[dict[str, Map], Element]:
    """Put clear glass; what is left of the surface beside it, which may be nothing, and its place.

    glTF mixes a metal and a dielectric, and the latter's inside of what passes light and of what is diffuse.
    """
    passes, metal, colour = (parts[name].values.ravel() for name in ("spec_trans", "metallic", "base_color"))
    share, rest, beside = float(passes[0] * (1 - metal[0])), dict[str, Map](), place
    if share < 1:
        place.set("type", "blendbsdf")
        elements.put_value(place, "weight", share)
        beside = SubElement(SubElement(place, "bsdf", type="twosided"), "bsdf")
        place = SubElement(place, "bsdf")
        rest = parts | {"spec_trans": _NOTHING, "metallic": Map(parts["metallic"].values / (1 - share))}
    place.set("type", "dielectric" if thick else "thindielectric")
    elements.put_value(place, "int_ior", eta)
    elements.put_value(place, "specular_transmittance", [math.sqrt(x) if thick else float(x) for x in colour[_RGB]])
    return rest, beside


def from_specular_glossiness(diffuse: images.Image, specular: images.Image) -> tuple[images.Image, images.Image]:
    """Base colour (H, W, 3) and metal (H, W, 1), by the formulas in the appendix of the extension."""
    bright_diffuse, bright = (np.sqrt(c**2 @ np.array([[0.299], [0.587], [0.114]])) for c in (diffuse, specular))
    left = (1 - specular.max(axis=-1, keepdims=True)) / (1 - F0)
    b = bright_diffuse * left + bright - 2 * F0
    root = np.sqrt((b * b - 4 * F0 * (F0 - bright)).clip(0))
    metal = np.where(bright < F0, 0, ((root - b) / (2 * F0)).clip(0, 1))
    of_diffuse = diffuse * left / (1 - metal).clip(1e-6)
    of_specular = (specular - F0 * (1 - metal)) / metal.clip(1e-6)
    base = (of_diffuse + (of_specular - of_diffuse) * metal**2).clip(0, 1)
    return base.astype(np.float32), metal.astype(np.float32)


def _base(entry: Node) -> tuple[Node | None, tuple[float, ...]]:
    """The image of a material's colour, and its factor."""
    if _OLD in entry.get("extensions", {}):
        gloss = extension(entry, _OLD)
        return gloss.get("diffuseTexture"), tuple(numbers(gloss, "diffuseFactor", _WHITE))
    surface = entry.get("pbrMetallicRoughness", {})
    return surface.get("baseColorTexture"), tuple(numbers(surface, "baseColorFactor", _WHITE))


def _references(entry: Node) -> Iterator[Node]:
    """All references to images in a material but those to what is left out."""
    for key, value in entry.items():
        if isinstance(value, dict) and key not in ("extras", "occlusionTexture"):
            if "index" in value:
                yield value
            yield from _references(value)
