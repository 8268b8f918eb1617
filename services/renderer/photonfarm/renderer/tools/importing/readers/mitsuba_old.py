"""What changed since Mitsuba 0.6: names, and what has another meaning or default under the same name.

Source: Mitsuba 0.6's documentation and code.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from photonfarm.core.errors import SpecError
from photonfarm.renderer.tools.importing import elements, images
from photonfarm.renderer.tools.importing.changes import Changes, Effect
from photonfarm.renderer.tools.importing.readers.mitsuba_parts import numbers_of, put_colour, read_old

_HUMP = re.compile(r"(?<=[a-z0-9])(?=[A-Z])")

_NEAREST = {"roughdiffuse": "diffuse", "sky": "sunsky", "sun": "sunsky", "phong": "blendbsdf", "ward": "blendbsdf"}
"""The usual counterparts of what Mitsuba 3 has not."""

_UNSEEN = ("cache", "max_anisotropy", "collapse", "resolution", "use_fast_approx")
"""Properties that no picture shows."""


@dataclass(slots=True)
class Upgrade:
    """Brings files to the terms of Mitsuba 3, and says what changes."""

    changes: Changes
    names: dict[str, str]  # of properties, as the files have them
    scratch: Path
    root: Element = field(default_factory=elements.scene)  # of the file at hand
    find: Callable[[str], Path | None] = Path  # the file of a name in it

    def run(self, root: Element, find: Callable[[str], Path | None]) -> None:
        """Upgrade a file's elements in place; raises SpecError for a value that is none."""
        self.root, self.find = root, find
        root.set("version", "3.0.0")
        for node in root.iter():
            self._rename(node)
        try:
            for node in list(root.iter()):
                for part in list(node):
                    self._upgrade_property(node, part)
            for node in reversed(list(root.iter())):  # what is in others first
                kind = node.get("type", "")
                if kind in _UPGRADES:
                    _UPGRADES[kind](self, node)
                if kind in _NEAREST:
                    made = node.get("type") if node.get("type") != kind else _NEAREST[kind]
                    self.changes.note(f"became {made!r}, the nearest in Mitsuba 3", elements.place(node), name=kind)
                    node.set("type", str(made))
        except ValueError as error:
            raise SpecError(f"{elements.place(node)}: cannot be read: {error}") from error

    def _rename(self, node: Element) -> None:
        kind = node.get("type", "").lower()
        node.attrib = {key: text for key, text in node.attrib.items() if key != "intent"}
        node.attrib |= {"type": kind} if kind else {}
        node.tag = "lookat" if node.tag == "lookAt" else node.tag
        for part in [part for part in node if part.get("name")]:
            old = part.get("name", "")
            new = _HUMP.sub("_", old).lower()
            if new in _UNSEEN or (kind, new) == ("roughdiffuse", "alpha"):
                node.remove(part)
            elif part.tag not in ("default", "bsdf") and (part.tag, node.tag) != ("ref", "shape"):
                self.names[new] = old
                is_base = kind in ("diffuse", "roughdiffuse") and new == "diffuse_reflectance"
                part.set("name", "reflectance" if is_base else new)

    def _upgrade_property(self, node: Element, part: Element) -> None:
        name = part.get("name", "")
        if part.tag == "subsurface":
            node.remove(part)
            self.lose("colour", "subsurface", "is left out: Mitsuba 3 has none", node)
        elif name == "distribution" and part.get("value", "").lower() in ("as", "phong"):
            part.set("value", "beckmann")  # Walter et al. 2007: of the same α, they are about as wide
            self.changes.note("became 'beckmann', of the same width", elements.place(node), name="distribution")
        elif part.tag == "lookat" and not part.get("up"):
            part.set("up", _any_up(*(numbers_of(part.get(key, "")) for key in ("origin", "target"))))
        elif name == "ext_eta" and part.get("value") in ("air", "vacuum", "1", "1.0"):
            node.remove(part)
        elif (colour := read_old(part)) is not None:
            if node.tag == "bsdf" and re.search("reflectance|transmittance", name):
                colour = colour / max(1.0, float(colour.max()))  # as 0.6 does, to conserve energy
            put_colour(part, colour)

    def lose(self, effect: Effect, name: str, meaning: str, node: Element) -> None:
        """Say what is lost of an element."""
        self.changes.lose(effect, self.names.get(name, name), meaning, elements.place(node))


def _any_up(origin: list[float], target: list[float]) -> str:
    """The `up` that 0.6 takes where none is given; Mitsuba 3 takes another."""
    if len(origin) != 3 or len(target) != 3:
        return ""  # Mitsuba says what is wrong
    x, y, z = np.subtract(target, origin).tolist()
    return elements.numbers(np.cross((z, 0, -x) if abs(x) > abs(y) else (0, z, -y), (x, y, z)).tolist())


def _take(node: Element, name: str, otherwise: str) -> str:
    """The value of a property, which is taken out."""
    property_ = elements.child(node, name)
    if property_ is None:
        return otherwise
    node.remove(property_)
    return property_.get("value", otherwise).lower()


def value_of(node: Element, name: str) -> str:
    """The value of a property; empty for one that is not there."""
    property_ = elements.child(node, name)
    return "" if property_ is None else property_.get("value", "")


def _texture(_: Upgrade, texture: Element) -> None:
    """Scale and offset of texture coordinates, which were numbers of their own: uv · scale + offset."""
    both = _take(texture, "uvscale", "1")
    scale = {axis: _take(texture, f"{uv}scale", both) for axis, uv in zip("xy", "uv", strict=True)}
    offset = {axis: _take(texture, f"{uv}offset", "0") for axis, uv in zip("xy", "uv", strict=True)}
    if {*scale.values()} != {"1"} or {*offset.values()} != {"0"}:
        SubElement(texture, "transform", name="to_uv").extend([Element("scale", scale), Element("translate", offset)])


def _bitmap(upgrade: Upgrade, texture: Element) -> None:
    """Gamma 1 is `raw`; filters but `nearest` are `bilinear`, the default; one way to wrap for both axes."""
    _texture(upgrade, texture)
    name = value_of(texture, "filename")
    is_float = Path(name).suffix.lower() in (".exr", ".hdr", ".rgbe", ".pfm")
    gamma = float(_take(texture, "gamma", "1" if is_float else "-1"))
    channels = _take(texture, "channel", "rgb") if not is_float else "rgb"
    if channels not in (*"rgba", "rgb", "rgba"):
        upgrade.lose("colour", "channel", f"{channels!r} is left out", texture)
    if gamma == 1 or channels == "a":
        elements.put_value(texture, "raw", True)
    if is_float and gamma != 1:
        upgrade.lose("colour", "gamma", f"{gamma:g} is left out: texels are read as their file says", texture)
    elif (channels in tuple("rgba") or gamma not in (1, -1)) and (file := upgrade.find(name)):
        to = upgrade.scratch / f"{len(list(upgrade.scratch.iterdir()))}-{file.stem}.png"
        _take(texture, "filename", "")
        elements.put_value(texture, "filename", str(_bake(file, gamma, channels, to)))
    if _take(texture, "filter_type", "ewa") == "nearest":
        elements.put_value(texture, "filter_type", "nearest")
    both = _take(texture, "wrap_mode", "repeat")
    u, v = (_take(texture, f"wrap_mode_{axis}", both) for axis in "uv")
    mode = v if v in ("repeat", "mirror") else "clamp"
    if u != mode or v != mode:
        said = f"{u} and {v} became {mode}: Mitsuba 3 repeats, mirrors or clamps, both axes alike"
        upgrade.lose("colour", "wrapMode", said, texture)
    elements.put_value(texture, "wrap_mode", mode)


def _bake(file: Path, gamma: float, channels: str, to: Path) -> Path:
    """An image of some channels of another, with sRGB in place of another gamma."""
    texels = images.decode(file.read_bytes(), str(file), raw=True)
    if gamma not in (1, -1):
        texels[..., :3] = images.encode(texels[..., :3] ** gamma)
    return images.save(texels[..., ["rgba".index(channel) for channel in channels]], to)


def _scale_texture(upgrade: Upgrade, texture: Element) -> None:
    """The texture that was scaled; a height's factor becomes that of its bump map."""
    factor = np.array(numbers_of(_take(texture, "scale", "1")))
    inner = next((part for part in texture if part.tag in ("texture", "ref")), None)
    if inner is None:
        raise ValueError("it has no texture to scale; put one in, or a colour in its place")
    above, name = elements.parents(upgrade.root), texture.get("id")
    for user in [above[texture], *(above[ref] for ref in upgrade.root.iter("ref") if ref.get("id") == name)]:
        if user.get("type") == "bumpmap":
            elements.put_value(user, "scale", float(factor.mean()))
        elif user is not upgrade.root and (factor != 1).any():
            upgrade.lose("colour", "scale", "a factor of a texture is left out: Mitsuba 3 has none", texture)
    inner.attrib.pop("name", None)
    inner.attrib.update({key: text for key, text in texture.attrib.items() if key == "name"})
    if name and inner.tag == "texture":
        inner.attrib.setdefault("id", name)
    above[texture][list(above[texture]).index(texture)] = inner
    if name and inner.get("id") != name:
        SubElement(upgrade.root, "alias", {"id": inner.get("id", ""), "as": name})


def _obj(upgrade: Upgrade, shape: Element) -> None:
    """Materials by the names of `usemtl`, and those of the MTL file where the shape has none, are lost."""
    file, materials = upgrade.find(value_of(shape, "filename")), [part for part in shape if part.tag in ("bsdf", "ref")]
    text = file.read_bytes() if file and (len(materials) != 1 or materials[0].get("name")) else b""
    used = set(re.findall(rb"^\s*usemtl\s+(.*\S)", text, re.MULTILINE))
    if len(used) > 1 and used & {part.get("name", "").encode() for part in materials}:
        upgrade.lose("colour", "usemtl", "all faces get the first material; make a shape of those of each", shape)
        for part in materials[1:]:
            shape.remove(part)
    elif not materials and b"mtllib" in text:
        upgrade.lose("colour", "mtllib", "is not read: Mitsuba 3 wants a material for the shape", shape)


def _conductor(_: Upgrade, bsdf: Element) -> None:
    """Copper was what a conductor is made of by default; Mitsuba 3's reflects all."""
    if not {part.get("name") for part in bsdf} & {"material", "eta", "k"}:
        elements.put_value(bsdf, "material", "Cu")


def _glossy(upgrade: Upgrade, bsdf: Element) -> None:
    """A blend of what is diffuse and of rough metal, which add up to the levels that `phong` and `ward` have.

    A Phong lobe of exponent n, around the mirrored direction, is as high as a Beckmann lobe of α = 1 / √(2 (n + 2)).
    """
    for name in ("exponent", "specular_reflectance"):
        if (child := elements.child(bsdf, name)) is not None and child.tag in ("texture", "ref"):
            upgrade.lose("colour", name, "its texture became the default: a blend has numbers here", bsdf)
    shine = np.array(numbers_of(_take(bsdf, "specular_reflectance", "0.2")))
    diffuse, metal = Element("bsdf", type="diffuse"), Element("bsdf", type="roughconductor")
    if bsdf.get("type") == "phong":
        elements.put_value(metal, "alpha", math.sqrt(0.5 / (float(_take(bsdf, "exponent", "30")) + 2)))
    else:
        metal.extend(part for part in bsdf if part.get("name") in ("alpha_u", "alpha_v"))  # 0.1 by default in both
    stated = elements.child(bsdf, "diffuse_reflectance")
    matt = elements.put_value(diffuse, "reflectance", (0.5, 0.5, 0.5)) if stated is None else stated
    if matt.tag != "rgb":  # whose texels a blend would darken
        matt.set("name", "diffuse_reflectance")
        bsdf[:] = [matt, *(part for part in metal if part.get("name") == "alpha")]
        bsdf.set("type", "roughplastic")
        return
    matt.set("name", "reflectance")
    diffuse[:] = [matt]
    base = np.array(numbers_of(matt.get("value", "")))
    total = min(1.0, float(base.max() + shine.max()))  # as 0.6 does, to conserve energy
    put_colour(matt, base * total / max(float(base.max()), 1e-9))
    put_colour(elements.put_value(metal, "specular_reflectance", 0.0), np.resize(shine * total / max(*shine, 1e-9), 3))
    bsdf[:] = [diffuse, metal]
    elements.put_value(bsdf, "weight", float(shine.max() / max(1e-9, base.max() + shine.max())))


def _mask(upgrade: Upgrade, bsdf: Element) -> None:
    """An opacity by colour is lost: Mitsuba 3 has one for all."""
    opacity = elements.child(bsdf, "opacity")
    if opacity is not None and opacity.tag == "rgb" and len({*numbers_of(opacity.get("value", ""))}) > 1:
        upgrade.lose("colour", "opacity", "became grey: Mitsuba 3 has one opacity for all colours", bsdf)


def _mixture(_: Upgrade, bsdf: Element) -> None:
    """A blend, where all of two materials is mixed; Mitsuba 3 has no other mixture."""
    weights = numbers_of(value_of(bsdf, "weights"))
    if len(weights) == 2 and math.isclose(sum(weights), 1, abs_tol=1e-3):
        _take(bsdf, "weights", "")
        bsdf.set("type", "blendbsdf")
        elements.put_value(bsdf, "weight", weights[1])


def _normalmap(upgrade: Upgrade, bsdf: Element) -> None:
    textures = {node.get("id") for node in upgrade.root.iter("texture")} - {None}
    for node in bsdf:
        if node.tag == "texture" or (node.tag == "ref" and node.get("id") in textures):
            node.set("name", "normalmap")


def _sky(upgrade: Upgrade, emitter: Element) -> None:
    """The part of `sunsky` that is meant. +Y was up, and is +Z; a sun's direction is in world coordinates in both.

    Of a place and time, 0.6 has east at +X and north at −Z, and Mitsuba 3 south at +X and west at +Y.
    """
    kind = emitter.get("type", "")
    scale = _take(emitter, "scale", "1")
    for part in ("sun", "sky"):
        own = _take(emitter, f"{part}_scale", scale)
        elements.put_value(emitter, f"{part}_scale", float(own) if part in kind else 0.0)
    elements.put_value(emitter, "sun_aperture", 0.5358 * (float(_take(emitter, "sun_radius_scale", "1")) or 0.02))
    if (placed := elements.child(emitter, "to_world")) is None:
        placed = SubElement(emitter, "transform", name="to_world")
    of_place = Element("matrix", value="0 -1 0 0 0 1 1 0 0")
    is_of_place = elements.child(emitter, "sun_direction") is None
    placed.insert(0, of_place if is_of_place else Element("rotate", x="1", angle="-90"))
    if "sky" in kind and elements.child(emitter, "albedo") is None:
        meaning = "the ground's albedo is Mitsuba 3's 0.3, not 0.6's 0.15"
        upgrade.changes.note(meaning, elements.place(emitter), name=kind)


_UPGRADES: dict[str, Callable[[Upgrade, Element], None]] = {
    "bitmap": _bitmap,
    "checkerboard": _texture,
    "scale": _scale_texture,
    "obj": _obj,
    "conductor": _conductor,
    "roughconductor": _conductor,
    "phong": _glossy,
    "ward": _glossy,
    "mask": _mask,
    "mixturebsdf": _mixture,
    "normalmap": _normalmap,
    "sky": _sky,
    "sun": _sky,
    "sunsky": _sky,
}
"""What means something else in Mitsuba 3, or is no longer there, by type."""
