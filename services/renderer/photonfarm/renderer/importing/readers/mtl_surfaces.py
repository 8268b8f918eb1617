"""Materials of MTL as the Mitsuba material that is nearest."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from photonfarm.renderer.importing import elements
from photonfarm.renderer.importing.readers import images
from photonfarm.renderer.importing.readers.mtl import RELIEFS, WHITE, Image, Material, Meaning

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

_UNUSUAL: dict[float, Meaning | None] = {
    0: (None, "has its colour without light in some programs, and is lit here"),
    **dict.fromkeys(map(float, range(1, 10))),
    10: ("colour", "is seen here, and not its shadows alone"),
}

GREY = (0.7, 0.7, 0.7)
"""The reflectance of what has no colour."""

SHINES = 0.02
"""Gloss is modelled from this specular reflectance on."""

Change = Callable[[images.Image], images.Image] | None


@dataclass(frozen=True, slots=True)
class Surface:
    """A material on its way into the scene."""

    material: Material
    coloured: bool  # whether its colour is that of vertices, their attribute `vertex_color`
    mirrored: bool  # whether images lie mirrored, and normal maps with them
    stem: Path = Path()  # what the names of images begin with that are changed

    def put(self, top: Element) -> Element | None:
        """Make a material of an empty element; the emitter of what shines with it."""
        material = self.material
        for key, (_, word, _) in material.lines.items():
            if key not in _CARRIED:
                material.say(_LOST.get(key, _UNKNOWN), word)
        illum = material.number("illum", 2)
        if meaning := _UNUSUAL.get(illum, (None, "is no known model of illumination, and is taken for 2")):
            material.say(meaning, f"illum {illum:g}")
        opacity, stencil = self._opacity(illum), material.image("map_d") or material.image("map_tr")
        passes = stencil is not None or opacity < 1
        tint = material.cut("tf", WHITE) if passes else WHITE
        if illum in GLASS and opacity == 1:
            material.say((None, "is of glass, and opaque here by its d or Tr"), f"illum {illum:g}")
        elif illum in GLASS and not self._has_image:
            top.set("type", "thindielectric")
            elements.put_value(top, "int_ior", max(material.number("ni", 1.5), 1.01))
            elements.put_value(top, "specular_transmittance", tint)
            material.say((None, "becomes clear glass without a thickness, of Ni and Tf; Ke shines in full"), "illum")
            return self._light(1, None)
        if passes:
            top.set("type", "mask")
            if min(tint) < 1:
                material.say(("colour", "does not tint the light that passes through"), "Tf")
            if stencil is None:
                elements.put_value(top, "opacity", float(opacity))
            else:
                self._put_image(top, "opacity", stencil, lambda values: self._alpha(values, opacity), raw=True)
            top = SubElement(top, "bsdf")
        top.set("type", "twosided")
        self._put_gloss(self._put_relief(SubElement(top, "bsdf")), illum)
        return self._light(opacity, stencil)

    def _light(self, opacity: float, stencil: Image | None) -> Element | None:
        """What it emits, by `Ke` and an image: Mitsuba's lights shine where their material lets light through."""
        material, image = self.material, self.material.image("map_ke")
        ke = np.array(material.cut("ke", WHITE if image else (0.0, 0.0, 0.0), math.inf, "light"), np.float32)
        values = ke[None, None] if image is None else images.linear(image.values()[..., :3]) * ke
        alpha = np.full((1, 1), opacity, np.float32)
        if stencil is not None and values.any():
            alpha = self._alpha(stencil.values(raw=True), opacity)
        if image and stencil and any(image.options.get(o) != stencil.options.get(o) for o in ("s", "o", "clamp")):
            material.say(("light", "lies unlike the image of opacity, whose mean is taken"), "map_Ke")
            alpha = alpha.mean(keepdims=True)
        size = np.maximum(values.shape[:2], alpha.shape)  # each is stretched to it
        a, b = (np.ix_(*(np.arange(size[i]) * each.shape[i] // size[i] for i in (0, 1))) for each in (values, alpha))
        values, image = values[a] * alpha[b][..., None], image or stencil
        if not values.any():
            return None
        if image is None:
            return elements.area_light(values.ravel().tolist())
        emitter, file = Element("emitter", type="area"), self.stem.with_name(f"{self.stem.name}_light.exr")
        image.put_place(elements.put_bitmap(emitter, "radiance", images.save_radiance(values, file), raw=True))
        return emitter

    def _alpha(self, values: images.Image, opacity: float) -> images.Image:
        """Its opacity (H, W), given the image of it: that image's own opacity where it has some, or its brightness."""
        grey = values[..., 3] if values[..., 3].min() < 1 else values[..., :3].mean(axis=2)
        return np.float32(opacity) * abs(("map_d" not in self.material.lines) - grey.clip(0, 1))

    @property
    def _has_image(self) -> bool:
        return self.coloured or any(self.material.image(key) for key in ("map_kd", "map_d", "map_tr"))

    def _opacity(self, illum: float) -> float:
        """Its `d`, or 1 − `Tr`, unless that hides what is there to be seen."""
        material = self.material
        d, tr = material.lines.get("d"), material.cut("tr", (0.0,))[0]
        opacity = material.cut("d", (1 - tr,))[0]
        if d and d[2].lower().startswith("-halo") and opacity < 1:
            material.say(("colour", "is as opaque at its edges as in its middle"), "d -halo")
        if d and "tr" in material.lines and abs(opacity + tr - 1) > 0.01:
            material.say((None, f"is left out, as d says how opaque it is: {opacity:g}"), f"Tr {tr:g}")
        if opacity > 0 or (illum in GLASS and not self._has_image):
            return opacity
        if not d or self._has_image or max(material.colour("ke")) > 0 or "map_ke" in material.lines:
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

        if min(image.triple("s", 1.0)[:2]) < 0:
            self.material.say((None, "mirrors the image, and not the directions in it"), f"{self.material.relief} -s")
        place.set("type", "normalmap")
        self._put_image(place, "normalmap", image, change if strength != 1 or self.mirrored else None, raw=True)
        return SubElement(place, "bsdf")

    def _put_gloss(self, place: Element, illum: float) -> None:
        material, ks = self.material, self.material.colour("ks")
        alpha = max(math.sqrt(2 / (max(material.number("ns", 30.0), 0.0) + 2)), 0.02)
        if _PBR & set(material.lines):
            self._put_principled(place)
        elif max(ks) <= SHINES or illum in (0, 1):
            place.set("type", "diffuse")
            self._put_colour(place, "reflectance")
        elif illum in MIRRORS:
            place.set("type", "blendbsdf")
            elements.put_value(place, "weight", max(material.cut("ks", ks)))
            self._put_colour(SubElement(place, "bsdf", type="diffuse"), "reflectance")
            mirror = SubElement(place, "bsdf", type="roughconductor")
            elements.put_value(mirror, "material", "none")
            elements.put_value(mirror, "specular_reflectance", [max(part, 0) / max(ks) for part in ks])
            elements.put_value(mirror, "alpha", alpha)
            material.say((None, "reflects as a metal does, and leaves the rest to Kd"), "Ks")
        elif self.coloured:  # Mitsuba's plastic needs a mean of its colour, and cannot take that of vertices
            self._put_principled(place, math.sqrt(alpha))
        else:
            place.set("type", "roughplastic")
            elements.put_value(place, "alpha", alpha)
            if min(ks) < max(ks):
                elements.put_value(place, "specular_reflectance", [max(part, 0) / max(ks) for part in ks])
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
                elements.put_value(place, name, material.cut(key, (least,))[0])
        elements.put_value(place, "clearcoat_gloss", 1 - material.cut("pcr", (0.0,))[0])
        elements.put_value(place, "eta", float(material.number("ni", 1.5)) if material.number("ni", 1) > 1 else 1.5)
        if material.number("aniso", 0) and material.number("anisor", 0):
            material.say(("colour", "its gloss is not turned"), "anisor")
        if max(material.colour("ks")) > SHINES:
            material.say((None, "becomes the gloss of `principled`"), "Ks")

    def _put_colour(self, place: Element, name: str) -> None:
        image = self.material.image("map_kd")
        kd = self.material.cut("kd", WHITE if self.coloured or image else GREY)
        if image is not None:
            tint = None if min(kd) >= 1 else lambda values: images.tinted(values, kd)
            self._put_image(place, name, image, tint)
        elif self.coloured:
            texture = SubElement(place, "texture", name=name, type="mesh_attribute")
            elements.put_value(texture, "name", "vertex_color")
        else:
            elements.put_value(place, name, kd)
            if "kd" not in self.material.lines and self.material.lines:
                self.material.say((None, "is not there; the surface is grey"), "Kd")

    def _put_image(self, place: Element, name: str, image: Image, change: Change = None, *, raw: bool = False) -> None:
        file = image.file
        if change is not None or not image.is_plain:
            values = image.values(raw=raw)
            values = change(values) if change is not None else values[..., :3]
            if not raw and values.max() > 1.001:
                self.material.say(("colour", "goes beyond 1, which no surface reflects, and is cut"), "map_Kd")
            file = images.save(values.clip(0, 1), self.stem.with_name(f"{self.stem.name}_{name}.png"))
        image.put_place(elements.put_bitmap(place, name, file, raw=raw))


def _are_normals(values: images.Image) -> bool:
    """Whether an image holds directions of length 1, most of them upwards."""
    normals = 2 * values[..., :3] - 1
    long = np.abs(np.linalg.norm(normals, axis=2) - 1) < 0.1
    return bool(long.mean() > 0.9 and (normals[..., 2] - np.abs(normals[..., 0])).mean() > 0.3)
