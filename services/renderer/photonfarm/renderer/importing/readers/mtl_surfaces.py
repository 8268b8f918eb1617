"""Materials of MTL as the Mitsuba material that is nearest."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from photonfarm.renderer.importing import elements
from photonfarm.renderer.importing.readers import images
from photonfarm.renderer.importing.readers.mtl import RELIEFS, Image, Material, Meaning

_PRINCIPLED = {"pr": ("roughness", 0.5), "pm": ("metallic", 0.0), "ps": ("sheen", 0.0), "pc": ("clearcoat", 0.0),
               "aniso": ("anisotropic", 0.0)}  # fmt: skip
"""Parameters of `principled`, each a number or an image, and what they are without a line."""

_PBR = {*_PRINCIPLED, *(f"map_{key}" for key in _PRINCIPLED)}

_CARRIED = {*_PBR, *RELIEFS, "ka", "kd", "ks", "ke", "ns", "ni", "d", "tr", "tf", "illum", "sharpness", "map_aat",
            "map_kd", "map_ke", "map_d", "map_tr", "pcr", "anisor"}  # fmt: skip
"""What has its meaning here, or none where light and reflections are those of the scene."""

_LOST: dict[str, Meaning] = {
    "disp": ("geometry", "surfaces are not displaced"),
    "map_ka": (None, "ambient light is that of the scene, and has no image"),
    "map_ks": ("colour", "its gloss is the same everywhere"),
    "map_ns": ("colour", "its gloss is the same everywhere"),
    "decal": ("colour", "the image on top of its colour is left out"),
    "refl": ("colour", "what it reflects is the scene"),
}

_UNKNOWN: Meaning = ("colour", "is no known statement of MTL, and is left out")

GLASS, MIRRORS = (4, 6, 7, 9), (3, 5, 8)
"""The models of illumination that are glass, and those that reflect the scene."""

_UNUSUAL: dict[float, Meaning] = {
    0: (None, "has its colour without light in some programs, and is lit here"),
    10: ("colour", "is seen here, and not its shadows alone"),
}

GREY = (0.7, 0.7, 0.7)
"""The reflectance of what has no colour."""

SHINES = 0.02
"""Gloss is modelled from this specular reflectance on."""

_WHITE = (1.0, 1.0, 1.0)

Change = Callable[[images.Image], images.Image]


@dataclass(frozen=True, slots=True)
class Surface:
    """A material on its way into the scene."""

    material: Material
    coloured: bool  # whether its colour is that of vertices, their attribute `vertex_color`
    mirrored: bool  # whether images lie mirrored, and normal maps with them
    stem: Path = Path()  # what the names of images begin with that are changed

    def put(self, top: Element) -> None:
        """Make a material of an empty element."""
        material = self.material
        for key, (_, word, _) in material.lines.items():
            if key not in _CARRIED:
                material.say(_LOST.get(key, _UNKNOWN), word)
        illum = material.number("illum", 2)
        if illum in _UNUSUAL:
            material.say(_UNUSUAL[illum], f"illum {illum:g}")
        opacity, stencil = self._opacity(illum), material.image("map_d") or material.image("map_tr")
        if illum in GLASS and opacity == 1:
            material.say((None, "is of glass, and opaque here by its d or Tr"), f"illum {illum:g}")
        elif illum in GLASS and not self._has_image:
            top.set("type", "thindielectric")
            elements.put_value(top, "int_ior", max(material.number("ni", 1.5), 1.01))
            tint = material.colour("tf", _WHITE)
            elements.put_value(top, "specular_transmittance", tint if max(tint) > 0 else _WHITE)
            material.say((None, "becomes clear glass without a thickness, of its Ni and Tf"), "illum")
            return
        if stencil is not None or opacity < 1:
            top.set("type", "mask")
            if stencil is None:
                elements.put_value(top, "opacity", float(opacity))
            else:
                hides = "map_d" not in material.lines
                self._put_image(top, "opacity", stencil, lambda values: opacity * abs(hides - _grey(values)), raw=True)
            top = SubElement(top, "bsdf")
        top.set("type", "twosided")
        self._put_gloss(self._put_relief(SubElement(top, "bsdf")), illum)

    @property
    def _has_image(self) -> bool:
        return self.coloured or any(self.material.image(key) for key in ("map_kd", "map_d", "map_tr"))

    def _opacity(self, illum: float) -> float:
        """Its `d`, or 1 − `Tr`, unless that hides what is there to be seen."""
        material = self.material
        d, tr = material.lines.get("d"), material.number("tr", 0)
        opacity = min(max(material.number("d", 1 - tr), 0.0), 1.0)
        if d and d[2].lower().startswith("-halo") and opacity < 1:
            material.say(("colour", "is as opaque at its edges as in its middle"), "d -halo")
        if d and "tr" in material.lines and abs(opacity + tr - 1) > 0.01:
            material.say((None, f"is left out, as d says how opaque it is: {opacity:g}"), f"Tr {tr:g}")
        if opacity > 0 or (illum in GLASS and not self._has_image):
            return opacity
        if not d or self._has_image or max(material.colour("ke")) > 0:
            material.say((None, "would be unseen by this, and is opaque"), "d 0" if d else "Tr 1")
            return 1
        material.say((None, "is not seen, as the file says"), "d 0")
        return opacity

    def _put_relief(self, place: Element) -> Element:
        """The place of the surface under its normal map or bump map."""
        material, key, lines = self.material, self.material.relief, self.material.lines
        image = material.image(key)
        if image is None:
            return place
        for other in RELIEFS:
            if other in lines and lines[other][2] != lines[key][2]:
                material.say(("colour", f"is left out beside {lines[key][1]}"), lines[other][1])
        if key == "norm" or _are_normals(image.values(raw=True)):
            if key != "norm":
                material.say((None, "has the colours of a normal map, and is taken for one"), lines[key][1])
            return self._put_normals(place, image)
        if "bm" not in image.options:
            material.say(("colour", "is left out without a height, which -bm gives in the file's units"), lines[key][1])
            return place
        place.set("type", "bumpmap")
        self._put_image(place, "arbitrary", image, lambda values: values[..., :3].mean(axis=2), raw=True)
        elements.put_value(place, "scale", image.triple("bm")[0])
        material.say((None, "raises white by its -bm, in units of the file"), lines[key][1])
        return SubElement(place, "bsdf")

    def _put_normals(self, place: Element, image: Image) -> Element:
        """Make it a normal map. Mitsuba's frame is right-handed where images lie mirrored, too."""
        strength = image.triple("bm", 1.0)[0]
        factor = np.array([strength, -strength if self.mirrored else strength, strength], np.float32)
        up = np.array([0, 0, 1], np.float32)

        def change(values: images.Image) -> images.Image:
            normals = up + factor * (2 * values[..., :3] - 1 - up)
            return normals / np.linalg.norm(normals, axis=2, keepdims=True) / 2 + np.float32(0.5)

        place.set("type", "normalmap")
        self._put_image(place, "normalmap", image, change if strength != 1 or self.mirrored else None, raw=True)
        return SubElement(place, "bsdf")

    def _put_gloss(self, place: Element, illum: float) -> None:
        material, ks = self.material, self.material.colour("ks")
        alpha = max(math.sqrt(2 / (max(material.number("ns", 30.0), 0.0) + 2)), 0.02)
        if _PBR & set(material.lines):
            self._put_principled(place)
        elif max(ks) <= SHINES or illum < 2:
            place.set("type", "diffuse")
            self._put_colour(place, "reflectance")
        elif illum in MIRRORS:
            place.set("type", "blendbsdf")
            elements.put_value(place, "weight", float(min(max(ks), 1)))
            self._put_colour(SubElement(place, "bsdf", type="diffuse"), "reflectance")
            mirror = SubElement(place, "bsdf", type="roughconductor")
            elements.put_value(mirror, "material", "none")
            elements.put_value(mirror, "specular_reflectance", (np.clip(ks, 0, None) / max(ks)).tolist())
            elements.put_value(mirror, "alpha", alpha)
            material.say((None, "reflects as a metal does, and leaves the rest to Kd"), "Ks")
        elif self.coloured:  # Mitsuba's plastic needs a mean of its colour, and cannot take that of vertices
            self._put_principled(place, math.sqrt(alpha))
        else:
            place.set("type", "roughplastic")
            elements.put_value(place, "alpha", alpha)
            if min(ks) < max(ks):
                elements.put_value(place, "specular_reflectance", (np.clip(ks, 0, None) / max(ks)).tolist())
            self._put_colour(place, "diffuse_reflectance")
            material.say((None, "becomes the gloss of plastic, as Phong's has no exact counterpart"), "Ks")

    def _put_principled(self, place: Element, roughness: float = 0.5) -> None:
        material = self.material
        place.set("type", "principled")
        self._put_colour(place, "base_color")
        for key, (name, least) in {**_PRINCIPLED, "pr": ("roughness", roughness)}.items():
            image = material.image(f"map_{key}")
            if image is not None:
                self._put_image(place, name, image, raw=True)
            else:
                elements.put_value(place, name, float(np.clip(material.number(key, least), 0, 1)))
        elements.put_value(place, "clearcoat_gloss", 1 - float(np.clip(material.number("pcr", 0), 0, 1)))
        elements.put_value(place, "eta", float(material.number("ni", 1.5)) if material.number("ni", 1) > 1 else 1.5)
        if material.number("aniso", 0) and material.number("anisor", 0):
            material.say(("colour", "its gloss is not turned"), "anisor")
        if max(material.colour("ks")) > SHINES:
            material.say((None, "becomes the gloss of `principled`"), "Ks")

    def _kd(self) -> Sequence[float]:
        """Its colour; black stands for white beside an image, as some programs write it."""
        beside = self.coloured or self.material.image("map_kd") is not None
        kd = self.material.colour("kd", _WHITE if beside else GREY)
        return _WHITE if beside and max(kd) <= 0 else kd

    def _put_colour(self, place: Element, name: str) -> None:
        kd, image = self._kd(), self.material.image("map_kd")
        if max(kd) > 1:
            self.material.say(("colour", "goes beyond 1, which no surface reflects, and is cut"), "Kd")
        if image is not None:
            tint = None if min(kd) >= 1 else lambda values: images.tinted(values, kd)
            self._put_image(place, name, image, tint)
        elif self.coloured:
            texture = SubElement(place, "texture", name=name, type="mesh_attribute")
            elements.put_value(texture, "name", "vertex_color")
        else:
            elements.put_value(place, name, np.clip(kd, 0, 1).tolist())
            if "kd" not in self.material.lines and self.material.lines:
                self.material.say((None, "is not there; the surface is grey"), "Kd")

    def _put_image(
        self, place: Element, name: str, image: Image, change: Change | None = None, *, raw: bool = False
    ) -> None:  # fmt: skip
        file = image.file
        if change is not None or not image.is_plain:
            values = image.values(raw=raw)
            values = change(values) if change is not None else values[..., :3]
            file = images.save(values.clip(0, 1), self.stem.with_name(f"{self.stem.name}_{name}.png"))
        image.put_place(elements.put_bitmap(place, name, file, raw=raw))


def _grey(values: images.Image) -> images.Image:
    """The one channel that a scalar image means: its opacity where it has that, or its brightness."""
    return values[..., 3] if values[..., 3].min() < 1 else values[..., :3].mean(axis=2)


def _are_normals(values: images.Image) -> bool:
    """Whether an image holds directions of length 1, most of them upwards."""
    normals = 2 * values[..., :3] - 1
    long = np.abs(np.linalg.norm(normals, axis=2) - 1) < 0.1
    return bool(long.mean() > 0.9 and (normals[..., 2] - np.abs(normals[..., 0])).mean() > 0.3)
