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
from numpy.typing import NDArray

from photonfarm.core.errors import SpecError
from photonfarm.renderer.tools.importing import elements, images
from photonfarm.renderer.tools.importing.changes import Changes, Effect

Colour = NDArray[np.float64]
"""Linear sRGB, (3,)."""

_HUMP = re.compile(r"(?<=[a-z0-9])(?=[A-Z])")  # where words meet in camelCase, which is snake_case in Mitsuba 3

_NEAREST = {"roughdiffuse": "diffuse", "sky": "sunsky", "sun": "sunsky"}
"""The usual counterparts of what Mitsuba 3 has not."""

_UNSEEN = ("cache", "max_anisotropy", "collapse", "resolution", "use_fast_approx")
"""Properties that no picture shows."""


@dataclass(slots=True)
class Upgrade:
    """Brings files to the terms of Mitsuba 3, and says what changes."""

    changes: Changes
    names: dict[str, str]  # of properties, as the files have them
    root: Element = field(default_factory=elements.scene)  # of the file at hand

    def run(self, root: Element) -> None:
        """Upgrade a file's elements in place; raises SpecError for a value that is none."""
        self.root = root
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
                    made = _NEAREST[kind]
                    self.changes.note(f"became {made!r}, the nearest in Mitsuba 3", elements.place(node), name=kind)
                    node.set("type", made)
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
                self.names[new] = old  # of other parts, names are the author's own
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
        elif (colour := read_colour(part)) is not None:
            part.tag, part[:] = "rgb", []
            part.attrib = {"name": name, "value": elements.numbers(colour.tolist())}

    def lose(self, effect: Effect, name: str, meaning: str, node: Element) -> None:
        """Say what is lost of an element."""
        self.changes.lose(effect, self.names.get(name, name), meaning, elements.place(node))


def read_colour(node: Element) -> Colour | None:
    """The colour of an element, None for what is none; raises ValueError for numbers that are none.

    `rgb` is linear also in hexadecimal digits, and `srgb` is not. Spectra and black bodies are integrated against the
    CIE's curves without a white point, as 0.6's RGB mode does.
    """
    text = node.get("value", "").strip()
    if node.tag == "blackbody":  # Planck's radiance in W / (m² sr nm)
        kelvin = float(node.get("temperature", "").strip().rstrip("Kk"))
        wavelengths = np.linspace(360.0, 830.0, 95)
        metres = wavelengths * 1e-9
        radiance = 1.191042972e-25 / metres**5 / np.expm1(0.01438776877 / (metres * kelvin))
        scale = float(node.get("scale") or node.get("multiplier") or 1)
        return _integrate(wavelengths.tolist(), radiance.tolist()) * scale
    if node.tag == "spectrum" and node.get("filename"):
        import mitsuba as mi

        return _integrate(*mi.spectrum_from_file(node.get("filename", "")))
    if node.tag == "spectrum" and ":" in text:
        samples = read_numbers(text.replace(":", " "))
        return _integrate(samples[::2], samples[1::2])
    if node.tag not in ("rgb", "srgb", "xyz", "spectrum"):
        return None
    digits = re.fullmatch("#([0-9a-fA-F]{6})", text)
    numbers = [byte / 255 for byte in bytes.fromhex(digits[1])] if digits else read_numbers(text)
    if len(numbers) not in (1, 3):
        raise ValueError(f"{text!r} has {len(numbers)} numbers, and a colour has one or three")
    values = np.broadcast_to(np.array(numbers), 3)
    if node.tag == "xyz":
        return images.RGB_OF_XYZ @ values
    return images.linear(values.astype(np.float32)).astype(np.float64) if node.tag == "srgb" else values


def read_numbers(text: str) -> list[float]:
    """Numbers with spaces or commas between; raises ValueError for what is none, or is not finite."""
    numbers = [float(each) for each in re.findall(r"[^\s,]+", text)]
    if not np.isfinite(numbers).all():
        raise ValueError(f"{text!r} is no number")
    return numbers


def _integrate(wavelengths: list[float], values: list[float]) -> Colour:
    import mitsuba as mi

    return np.array(mi.spectrum_list_to_srgb(wavelengths, values, False, False), np.float64).clip(0)


def value_of(node: Element, name: str) -> str:
    """The value of a property; empty for one that is not there."""
    property_ = elements.child(node, name)
    return "" if property_ is None else property_.get("value", "")


def _take(node: Element, name: str, otherwise: str) -> str:
    """The value of a property in small letters, which is taken out."""
    property_ = elements.child(node, name)
    if property_ is None:
        return otherwise
    node.remove(property_)
    return property_.get("value", otherwise).lower()


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
    is_float = Path(value_of(texture, "filename")).suffix.lower() in (".exr", ".hdr", ".rgbe", ".pfm")
    gamma = float(_take(texture, "gamma", "1" if is_float else "-1"))
    if gamma == 1:
        elements.put_value(texture, "raw", True)
    if gamma not in ((1,) if is_float else (1, -1)):
        upgrade.lose("colour", "gamma", f"{gamma:g} is left out: texels are read as their file says", texture)
    if (channel := _take(texture, "channel", "rgb")) != "rgb":
        upgrade.lose("colour", "channel", f"{channel!r} is left out; make it an image of its own", texture)
    if _take(texture, "filter_type", "ewa") == "nearest":
        elements.put_value(texture, "filter_type", "nearest")
    both = _take(texture, "wrap_mode", "repeat")
    u, v = (_take(texture, f"wrap_mode_{axis}", both) for axis in "uv")
    mode = v if v in ("repeat", "mirror") else "clamp"
    if u != mode or v != mode:
        said = f"{u} and {v} became {mode}: Mitsuba 3 repeats, mirrors or clamps, both axes alike"
        upgrade.lose("colour", "wrapMode", said, texture)
    elements.put_value(texture, "wrap_mode", mode)


def _scale_texture(upgrade: Upgrade, texture: Element) -> None:
    """The texture that was scaled takes its place; a height's factor becomes that of its bump map."""
    factor = np.array(read_numbers(_take(texture, "scale", "1")))
    inner = next((part for part in texture if part.tag in ("texture", "ref")), None)
    if inner is None:
        raise ValueError("it has no texture to scale; put one in, or a colour in its place")
    if inner.tag == "ref":
        inner = next(node for node in upgrade.root.iter("texture") if node.get("id") == inner.get("id"))
    above, name = elements.parents(upgrade.root), texture.get("id")
    for user in [above[texture], *(above[ref] for ref in upgrade.root.iter("ref") if ref.get("id") == name)]:
        if user.get("type") == "bumpmap":
            elements.put_value(user, "scale", float(factor.mean()))
        elif user is not upgrade.root and (factor != 1).any():
            upgrade.lose("colour", "scale", "a factor of a texture is left out: Mitsuba 3 has none", texture)
    texture.set("type", inner.get("type", ""))
    texture[:] = [elements.copy_element(part) for part in inner]


def _obj(upgrade: Upgrade, shape: Element) -> None:
    """The materials of the MTL file, where the shape has none of its own, are lost."""
    if not any(part.tag in ("bsdf", "ref") for part in shape):
        upgrade.lose("colour", "mtllib", "is not read: Mitsuba 3 wants a material for the shape", shape)


def _conductor(_: Upgrade, bsdf: Element) -> None:
    """Copper was what a conductor is made of by default; Mitsuba 3's reflects all."""
    if not {part.get("name") for part in bsdf} & {"material", "eta", "k"}:
        elements.put_value(bsdf, "material", "Cu")


def _glossy(upgrade: Upgrade, bsdf: Element) -> None:
    """A rough plastic of the same base and width.

    A Phong lobe of exponent n, around the mirrored direction, is as high as a Beckmann lobe of α = 1 / √(2 (n + 2)).
    """
    kind = bsdf.get("type", "")
    stated = [part for part in bsdf if part.get("name") == "diffuse_reflectance"]
    exponent, alpha = value_of(bsdf, "exponent"), float(value_of(bsdf, "alpha_u") or 0.1)
    bsdf[:] = stated
    elements.put_value(bsdf, "alpha", math.sqrt(0.5 / (float(exponent or 30) + 2)) if kind == "phong" else alpha)
    bsdf.set("type", "roughplastic")
    upgrade.lose("colour", kind, "became 'roughplastic', which reflects as its index of refraction says", bsdf)


def _mask(upgrade: Upgrade, bsdf: Element) -> None:
    """An opacity by colour is lost: Mitsuba 3 has one for all."""
    opacity = elements.child(bsdf, "opacity")
    if opacity is not None and opacity.tag == "rgb" and len({*read_numbers(opacity.get("value", ""))}) > 1:
        upgrade.lose("colour", "opacity", "became grey: Mitsuba 3 has one opacity for all colours", bsdf)


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
    "normalmap": _normalmap,
    "sky": _sky,
    "sun": _sky,
    "sunsky": _sky,
}
"""What means something else in Mitsuba 3, or is no longer there, by type."""
