"""Materials of MTL as the Mitsuba material that is nearest."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from photonfarm.renderer.tools.importing import elements, images
from photonfarm.renderer.tools.importing.changes import Effect
from photonfarm.renderer.tools.importing.readers.mtl import RELIEFS, WHITE, Material, Meaning
from photonfarm.renderer.tools.importing.surfaces import Map, Writer, constant

_PRINCIPLED = {
    "pr": ("roughness", 0.5),
    "pm": ("metallic", 0.0),
    "ps": ("sheen", 0.0),
    "pc": ("clearcoat", 0.0),
    "aniso": ("anisotropic", 0.0),
}
"""Parameters of `principled`, each a number or an image, and what they are without a line."""

_PBR = {*_PRINCIPLED, *(f"map_{key}" for key in _PRINCIPLED)}

_CARRIED = {
    *_PBR,
    *RELIEFS,
    "ka",
    "kd",
    "ks",
    "ke",
    "ns",
    "ni",
    "d",
    "tr",
    "tf",
    "illum",
    "sharpness",
    "map_aat",
    "map_kd",
    "map_ke",
    "map_d",
    "map_tr",
    "pcr",
    "anisor",
}
"""What has its meaning here, or none where light and reflections are those of the scene."""

_LOST: dict[str, Meaning] = {
    "disp": ("geometry", "surfaces are not displaced"),
    "map_ka": (None, "ambient light is that of the scene, and has no image"),
    **dict.fromkeys(("map_ks", "map_ns"), ("colour", "its gloss is the same everywhere")),
    **dict.fromkeys(("decal", "refl"), ("colour", "images beside those of its colour are left out")),
}
_UNKNOWN: Meaning = ("colour", "is no known statement of MTL, and is left out")

_GLASS, _MIRRORS, _LIT = (4, 6, 7, 9), (3, 5, 8), range(1, 10)
"""The models of illumination that are glass, those that reflect the scene, and those of what light and shadows meet."""

_GREY = (0.7, 0.7, 0.7)  # the reflectance of what has no colour
_SMOOTH = 0.2  # gloss up to this α is Mitsuba's `roughplastic`, which loses light above; `principled` gains some
_SHINES = 0.02  # gloss is modelled from this specular reflectance on


@dataclass(frozen=True, slots=True)
class Surface:
    """A material on its way into the scene."""

    material: Material
    coloured: bool  # whether its colour is that of vertices, their attribute `vertex_color`
    mirrored: bool  # whether images lie mirrored, and normal maps with them
    stem: Path = Path()  # what the names of images begin with that are changed

    def put(self, top: Element) -> Element | None:
        """Make a material of an empty element; the emitter of what shines with it."""
        material, writer = self.material, Writer(self.stem, self.material.changes, f"material {self.material.name!r}")
        for key, (_, word, _) in material.lines.items():
            if key not in _CARRIED:
                material.say(_LOST.get(key, _UNKNOWN), word)
        illum = material.number("illum", 2)
        if illum not in _LIT:  # 10 is seen by its shadows alone
            lit: Effect | None = "colour" if illum == 10 else None
            material.say((lit, f"is lit as by model {1 if illum == 0 else 2} here"), f"illum {illum:g}")
        opacity, glow = self._opacity(illum), self._glow()
        tint = material.cut("tf", WHITE) if opacity else WHITE
        if illum in _GLASS and opacity and not self._has_image:
            glass = {"int_ior": self._eta(1.01), "specular_transmittance": constant(*tint)}
            writer.put_surface(top, "thindielectric", glass)
            material.say((None, "becomes clear glass without a thickness, of Ni and Tf; Ke shines in full"), "illum")
            return writer.light(glow, None, "map_Ke")
        if illum in _GLASS:
            effect: Effect | None = None if {"d", "tr"} & set(material.lines) else "colour"  # many state d 1
            material.say((effect, "is of glass, and is not here, by its d, Tr or images"), f"illum {illum:g}")
        if min(tint) < 1:
            material.say(("colour", "does not tint the light that passes through"), "Tf")
        self._put_gloss(writer.put_layers(top, opacity, self._normals(writer)), illum, writer)
        return writer.light(glow, opacity, "map_Ke")

    def _glow(self) -> Map:
        """What it emits, by `Ke` and an image."""
        image = self.material.image("map_ke")
        ke = self.material.cut("ke", WHITE if image else (0.0, 0.0, 0.0), math.inf, "light")
        if image is None:
            return constant(*ke)
        return Map(images.linear(image.values()[..., :3]) * np.array(ke, np.float32), image.lie)

    @property
    def _has_image(self) -> bool:
        return self.coloured or any(self.material.image(key) for key in ("map_kd", "map_d", "map_tr"))

    def _opacity(self, illum: float) -> Map | None:
        """Its opacity; None is opaque. An image's own opacity where it has some, or else its brightness."""
        opacity, map_d = self._dissolve(illum), self.material.image("map_d")
        stencil = map_d or self.material.image("map_tr")
        if stencil is None:
            return constant(opacity) if opacity < 1 else None
        values = stencil.values(raw=True)
        grey = values[..., 3:] if values[..., 3].min() < 1 else values[..., :3].mean(axis=2, keepdims=True)
        return Map(np.float32(opacity) * abs((map_d is None) - grey.clip(0, 1)), stencil.lie)

    def _dissolve(self, illum: float) -> float:
        """Its `d`, or 1 − `Tr`, unless that hides what is there to be seen."""
        material = self.material
        d, tr = material.lines.get("d"), material.cut("tr", (0.0,))[0]
        opacity = material.cut("d", (1 - tr,))[0]
        if d and d[2].lower().startswith("-halo") and opacity < 1:
            material.say(("colour", "is as opaque at its edges as in its middle"), "d -halo")
        if d and "tr" in material.lines and abs(opacity + tr - 1) > 0.01:
            material.say((None, f"is left out, as d says how opaque it is: {opacity:g}"), f"Tr {tr:g}")
        if opacity > 0 or (illum in _GLASS and not self._has_image):
            return opacity
        if not d or self._has_image or max(material.colour("ke")) > 0 or "map_ke" in material.lines:
            material.say((None, "would be unseen by this, and is opaque"), "d 0" if d else "Tr 1")
            return 1
        material.say((None, "is not seen, as the file says"), "d 0")
        return opacity

    def _normals(self, writer: Writer) -> Map | None:
        """Its normal map."""
        material, key, lines = self.material, self.material.relief, self.material.lines
        image = material.image(key)
        if image is None:
            return None
        for other in RELIEFS:
            if other in lines and lines[other][2] != lines[key][2]:
                material.say(("colour", f"is left out beside {lines[key][1]}"), lines[other][1])
        normals = Map(image.values(raw=True)[..., :3], image.lie, image.file if image.is_plain else None)
        if key != "norm" and not _are_normals(normals.values):
            material.say(("colour", "raises no bumps, as heights are left out; export a normal map"), lines[key][1])
            return None
        if key != "norm":
            material.say((None, "has the colours of a normal map, and is taken for one"), lines[key][1])
        return writer.normals(normals, image.triple("bm", 1.0)[0], f"{key} -s", mirrored=self.mirrored, of_all=True)

    def _put_gloss(self, place: Element, illum: float, writer: Writer) -> None:
        material, ks, colour = self.material, self.material.colour("ks"), self._colour()
        alpha = max(math.sqrt(2 / (max(material.number("ns", 30.0), 0.0) + 2)), 0.02)
        is_glossy, is_pbr = max(ks) > _SHINES, bool(_PBR & set(material.lines))
        if is_pbr or (is_glossy and illum not in (0, 1, *_MIRRORS)):
            is_plastic = alpha <= _SMOOTH and not (self.coloured or is_pbr)
            if is_glossy:
                is_tinted = max(ks) - min(ks) > 0.1 * max(ks) and not (is_plastic or is_pbr)
                said = "becomes the gloss of plastic, by Ns" + ", without its colour" * is_tinted
                material.say(("colour" if is_tinted else None, said), "Ks")
            if is_plastic:
                tint = constant(*(max(part, 0) / max(ks) for part in ks))
                parts = {"diffuse_reflectance": colour, "alpha": constant(alpha), "specular_reflectance": tint}
                writer.put_surface(place, "roughplastic", parts)
            else:
                writer.put_surface(place, "principled", self._parts(colour, math.sqrt(alpha)), painted=self.coloured)
            return
        below = place
        if max(ks) > _SHINES and illum in _MIRRORS:
            place.set("type", "blendbsdf")
            elements.put_value(place, "weight", max(material.cut("ks", ks)))
            below, mirror = SubElement(place, "bsdf"), SubElement(place, "bsdf")
            tint = constant(*(max(part, 0) / max(ks) for part in ks))
            writer.put_surface(mirror, "roughconductor", {"specular_reflectance": tint, "alpha": constant(alpha)})
            elements.put_value(mirror, "material", "none")
            material.say((None, "reflects as a metal does, and leaves the rest to Kd"), "Ks")
        writer.put_surface(below, "diffuse", {"reflectance": colour}, painted=self.coloured)

    def _parts(self, colour: Map, roughness: float) -> dict[str, Map]:
        """The properties of `principled`."""
        material, parts = self.material, {"base_color": colour}
        for key, (name, least) in {**_PRINCIPLED, "pr": ("roughness", roughness)}.items():
            image = material.image(f"map_{key}")
            parts[name] = image.map(raw=True) if image else constant(material.cut(key, (least,))[0])
            if image and key in material.lines and material.number(key, 1) != 1:
                material.say((None, "is left out beside its image"), material.lines[key][1])
        if material.number("aniso", 0) and material.number("anisor", 0):
            material.say(("colour", "its gloss is not turned"), "anisor")
        return parts | {"clearcoat_gloss": constant(1 - material.cut("pcr", (0.0,))[0]), "eta": self._eta(1.5)}

    def _eta(self, otherwise: float) -> Map:
        """Its index of refraction."""
        eta = self.material.number("ni", 1.5)
        if eta < 1.01:
            self.material.say((None, f"is no index of what refracts, and is taken for {otherwise:g}"), f"Ni {eta:g}")
        return constant(eta if eta >= 1.01 else otherwise)

    def _colour(self) -> Map:
        material, image = self.material, self.material.image("map_kd")
        kd = material.cut("kd", WHITE if self.coloured or image else _GREY)
        if image is None:
            if "kd" not in material.lines and material.lines and not self.coloured:
                material.say((None, "is not there; the surface is grey"), "Kd")
            return constant(*kd)
        colour = image.map(kd)
        if colour.values.max(initial=0) > 1.001:
            material.say(("colour", "goes beyond 1, which no surface reflects, and is cut"), "map_Kd")
        return replace(colour, values=colour.values.clip(0, 1))


def _are_normals(values: images.Image) -> bool:
    """Whether an image holds directions of length 1, most of them upwards."""
    normals = 2 * values - 1
    long = np.abs(np.linalg.norm(normals, axis=2) - 1) < 0.1
    return bool(long.mean() > 0.9 and (normals[..., 2] - np.abs(normals[..., 0])).mean() > 0.3)
