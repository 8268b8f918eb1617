"""Materials of MTL files, also with the keys of its extension for metal and roughness."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

from photonfarm.renderer.importing import elements
from photonfarm.renderer.importing.changes import Changes
from photonfarm.renderer.importing.readers import images
from photonfarm.shared.core.errors import SpecError

_IMAGES = ("map_kd", "map_d", "map_pr", "map_pm", "norm")
_LOST = {"map_bump": "bump map", "bump": "bump map", "map_ke": "map of its light", "map_ks": "map of its gloss",
         "disp": "displacement", "refl": "reflection map"}  # fmt: skip
_WHITE = (1.0, 1.0, 1.0)

_OPTIONS = {"-o": 3, "-s": 3, "-t": 3, "-mm": 2}
"""The options of image files that take several values; all others take one."""

GLASS = (4, 6, 7, 9)
"""The models of illumination that are glass."""

SHINES = 0.02
"""Gloss is modelled from this specular reflectance on."""


@dataclass(slots=True)
class Material:
    """One material: its lines, by their first words in small letters."""

    name: str
    file: Path
    lines: dict[str, list[str]] = field(default_factory=dict)

    def number(self, key: str, otherwise: float) -> float:
        """The first number of a line."""
        return self.colour(key, (otherwise,))[0]

    def colour(self, key: str, otherwise: Sequence[float]) -> Sequence[float]:
        """The numbers of a line; one stands for all three."""
        if key not in self.lines:
            return otherwise
        try:
            values = [float(word) for word in self.lines[key][:3]]
        except ValueError as error:
            words = " ".join(self.lines[key])
            raise SpecError(f"{self.file}: material {self.name!r}: {key} = {words!r} has no numbers") from error
        return values * 3 if len(values) == 1 and len(otherwise) > 1 else values

    def image(self, key: str) -> Path | None:
        """The image of a line; raises SpecError if it is not there."""
        if key not in self.lines:
            return None
        words = list(self.lines[key])
        while words and words[0].startswith("-"):
            words = words[1 + _OPTIONS.get(words[0], 1) :]
        name = " ".join(words).replace("\\", "/")
        file = self.file.parent / name
        if not file.is_file():
            raise SpecError(
                f"{self.file}: material {self.name!r}: image {name!r} is not there; put it there, or take its line out"
            )
        return file

    @property
    def emits(self) -> bool:
        """Whether it is a light."""
        return max(self.colour("ke", (0.0,))) > 0

    @property
    def opacity(self) -> float:
        """Its `d`, or 1 − `Tr`."""
        return self.number("d", 1 - self.number("tr", 0.0))


def read_materials(file: Path) -> dict[str, Material]:
    """The materials of a file, by name."""
    found: dict[str, Material] = {}
    material: Material | None = None
    for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
        words = line.split()
        if len(words) > 1 and words[0].lower() == "newmtl":
            material = Material(" ".join(words[1:]), file)
            found[material.name] = material
        elif len(words) > 1 and material is not None and not words[0].startswith("#"):
            material.lines[words[0].lower()] = words[1:]
    return found


def put_material(root: Element, made: str, material: Material | None, scratch: Path, changes: Changes) -> None:
    """Add a material to a scene; None is a grey one."""
    top = SubElement(root, "bsdf", id=made)
    if material is None:
        top.set("type", "twosided")
        elements.put_value(SubElement(top, "bsdf", type="diffuse"), "reflectance", (0.7, 0.7, 0.7))
        return
    if lost := sorted({_LOST[key] for key in material.lines if key in _LOST}):
        for name in lost:
            changes.lose("colour", name, "is not carried over", f"material {material.name!r}")
    if _put_glass(top, material):
        return
    top = _put_mask(top, material, made, scratch)
    top.set("type", "twosided")
    place = SubElement(top, "bsdf")
    normal_map = material.image("norm")
    if normal_map is not None:
        place.set("type", "normalmap")
        elements.put_bitmap(place, "normalmap", normal_map, raw=True)
        place = SubElement(place, "bsdf")
    _put_surface(place, material, made, scratch)


def _put_glass(place: Element, material: Material) -> bool:
    """Make it clear glass, if it is; whether it is. Its sheets have no thickness that MTL says anything of."""
    is_glass = material.number("illum", 2) in GLASS or material.opacity < 0.5
    if material.opacity >= 1 or not is_glass or "map_d" in material.lines:
        return False
    place.set("type", "thindielectric")
    elements.put_value(place, "int_ior", max(material.number("ni", 1.5), 1.01))
    tint = material.colour("tf", _WHITE)
    elements.put_value(place, "specular_transmittance", tint if max(tint) > 0 else _WHITE)
    return True


def _put_mask(top: Element, material: Material, made: str, scratch: Path) -> Element:
    """The place of the surface under its opacity."""
    stencil = material.image("map_d")
    if stencil is None and material.opacity >= 1:
        return top
    top.set("type", "mask")
    if stencil is None:
        elements.put_value(top, "opacity", float(material.opacity))
    else:
        image = _decoded(stencil)
        alpha = image[..., 3] if image[..., 3].min() < 1 else image[..., :3].mean(axis=2)
        elements.put_bitmap(top, "opacity", images.save(alpha, scratch / f"{made}_opacity.png"), raw=True)
    return SubElement(top, "bsdf")


def _put_surface(place: Element, material: Material, made: str, scratch: Path) -> None:
    specular = max(material.colour("ks", (0.0,)))
    if {"pr", "pm", "map_pr", "map_pm"} & set(material.lines):
        place.set("type", "principled")
        _put_colour(place, "base_color", material, made, scratch)
        for name, key, otherwise in (("roughness", "pr", 0.5), ("metallic", "pm", 0.0)):
            _put_number(place, name, material, key, otherwise)
    elif specular > SHINES and material.number("illum", 2) >= 2:
        place.set("type", "roughplastic")
        exponent = max(material.number("ns", 30.0), 0.0)
        elements.put_value(place, "alpha", max(math.sqrt(2 / (exponent + 2)), 0.02))
        _put_colour(place, "diffuse_reflectance", material, made, scratch)
    else:
        place.set("type", "diffuse")
        _put_colour(place, "reflectance", material, made, scratch)


def _put_number(place: Element, name: str, material: Material, key: str, otherwise: float) -> None:
    image = material.image(f"map_{key}")
    if image is not None:
        elements.put_bitmap(place, name, image, raw=True)
    else:
        elements.put_value(place, name, float(material.number(key, otherwise)))


def _put_colour(place: Element, name: str, material: Material, made: str, scratch: Path) -> None:
    """Its colour; an image is multiplied by `Kd`, unless that is black, as some programs write it beside images."""
    factor, image = material.colour("kd", _WHITE), material.image("map_kd")
    if image is None:
        elements.put_value(place, name, [min(max(part, 0.0), 1.0) for part in factor])
        return
    if max(factor) == 0 or min(factor) >= 0.999:
        elements.put_bitmap(place, name, image)
        return
    elements.put_bitmap(place, name, images.save(images.tinted(_decoded(image), factor), scratch / f"{made}_color.png"))


def _decoded(file: Path) -> images.Image:
    return images.decoded(file.read_bytes(), str(file))
