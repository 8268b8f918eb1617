"""What changed since Mitsuba 0.6: names, and what has another meaning or default under the same name.

Sources: Mitsuba 0.6's documentation and code; for 0.3 to 0.5, its `data/schema/upgrade_0.4.0.xsl`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from photonfarm.renderer.importing import elements
from photonfarm.renderer.importing.changes import Changes, Effect
from photonfarm.renderer.importing.readers import images
from photonfarm.renderer.importing.readers.mitsuba_spectra import numbers_of, of_old, put
from photonfarm.shared.core.errors import SpecError

_HUMP = re.compile(r"(?<=[a-z0-9])(?=[A-Z])")

_TAGS = {"luminaire": "emitter", "camera": "sensor", "lookAt": "lookat"}

_NEAREST = {"roughdiffuse": "diffuse", "ward": "roughplastic", "phong": "roughplastic", "ldrtexture": "bitmap",
            "sky": "sunsky", "sun": "sunsky"}  # fmt: skip
"""The usual counterparts of what Mitsuba 3 has not."""

_PROPERTIES: dict[tuple[str, str], str | None] = {
    ("area", "intensity"): "radiance",
    ("constant", "intensity"): "radiance",
    ("directional", "intensity"): "irradiance",
    ("envmap", "intensity_scale"): "scale",
    ("diffuse", "diffuse_reflectance"): "reflectance",
    **dict.fromkeys(
        [("ward", "variant"), ("roughdiffuse", "alpha"), ("roughdiffuse", "use_fast_approx"),
         ("bitmap", "cache"), ("bitmap", "max_anisotropy"), ("envmap", "cache"), ("obj", "collapse"),
         ("sky", "resolution"), ("sun", "resolution"), ("sunsky", "resolution")]
    ),
}  # fmt: skip
"""Properties by the type that has them: the name of today, or none for what no picture shows, or no counterpart has."""


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
                self._upgrade_object(node)
        except ValueError as error:
            raise SpecError(f"{elements.place(node)}: cannot be read: {error}") from error

    def _upgrade_object(self, node: Element) -> None:
        kind = node.get("type", "")
        if kind in _UPGRADES:
            _UPGRADES[kind](self, node)
        if kind in _NEAREST:
            node.set("type", _NEAREST[kind])
            self.changes.note(f"became {_NEAREST[kind]!r}, the nearest in Mitsuba 3", elements.place(node), name=kind)

    def _rename(self, node: Element) -> None:
        node.tag = _TAGS.get(node.tag, node.tag)
        node.attrib.pop("intent", None)
        node.attrib.update({key: text.lower() for key, text in node.attrib.items() if key == "type"})
        for part in [part for part in node if part.tag != "default" and part.get("name")]:
            old = part.get("name", "")
            new = _HUMP.sub("_", old).lower()
            self.names[new] = old
            today = _PROPERTIES.get((node.get("type", ""), new), new)
            if today is None:
                node.remove(part)
            else:
                part.set("name", today)

    def _upgrade_property(self, node: Element, part: Element) -> None:
        name = part.get("name", "")
        if part.tag == "animation":
            node[list(node).index(part)] = first = min(part, key=lambda step: abs(float(step.get("time", "0"))))
            first.attrib = {"name": name}
            self.changes.note("stands still, as it is at time 0", elements.place(node), name="animation")
        elif part.tag == "subsurface":
            node.remove(part)
            self.lose("colour", "subsurface", "is left out: Mitsuba 3 has none", node)
        elif name == "distribution" and part.get("value", "").lower() in ("as", "phong"):
            part.set("value", "beckmann")  # Walter et al. 2007: of the same α, they are about as wide
            self.changes.note("became 'beckmann', of the same width", elements.place(node), name="distribution")
        elif part.tag == "lookat":
            _look(part)
        elif name == "ext_eta" and part.get("value") in ("air", "vacuum", "1", "1.0"):
            node.remove(part)
        elif (colour := of_old(part)) is not None:
            if node.tag == "bsdf" and re.search("reflectance|transmittance", name):
                colour = colour / max(1.0, float(colour.max()))  # as 0.6 does, to conserve energy
            put(part, colour)

    def bake(self, texture: Element, gamma: float, channels: str) -> None:
        """Let a bitmap name an image of some of its channels, with sRGB in place of another gamma."""
        named = elements.child(texture, "filename")
        file = self.find(_value(texture, "filename"))
        if named is None or file is None:
            return
        texels = images.decoded(file.read_bytes(), str(file), raw=True)
        if gamma not in (1, -1):
            texels[..., :3] = images.encoded(texels[..., :3] ** gamma)
        texels = texels[..., ["rgba".index(channel) for channel in channels]]
        name = f"{len(list(self.scratch.iterdir()))}-{file.stem}.png"
        named.set("value", str(images.save(texels, self.scratch / name)))

    def lose(self, effect: Effect, name: str, meaning: str, node: Element) -> None:
        """Say what is lost of an element."""
        self.changes.lose(effect, self.names.get(name, name), meaning, elements.place(node))


def _look(step: Element) -> None:
    """Its three vectors, which were nine numbers before 0.4; raises ValueError for one that is not of three numbers."""
    for key in ("origin", "target", "up"):
        if f"{key[0]}x" in step.attrib:
            step.set(key, " ".join(step.attrib.pop(f"{key[0]}{axis}", "") for axis in "xyz"))
        count = len(numbers_of(step.get(key, "")))
        if count != 3 and (key != "up" or count):
            raise ValueError(f"{key!r} of <lookat> has {count} numbers, and needs three: x, y and z")
    if not step.get("up"):
        step.set("up", _any_up(step))


def _any_up(step: Element) -> str:
    """The `up` that 0.6 takes where none is given; Mitsuba 3 takes another."""
    x, y, z = (np.array(numbers_of(step.get("target", ""))) - numbers_of(step.get("origin", ""))).tolist()
    across = (z, 0, -x) if abs(x) > abs(y) else (0, z, -y)
    return elements.numbers(np.cross(across, (x, y, z)).tolist())


def _taken(node: Element, name: str, otherwise: str) -> str:
    """The value of a property, which is taken out."""
    found = elements.child(node, name)
    if found is None:
        return otherwise
    node.remove(found)
    return found.get("value", otherwise).lower()


def _value(node: Element, name: str) -> str:
    found = elements.child(node, name)
    return "" if found is None else found.get("value", "")


def _texture(_: Upgrade, texture: Element) -> None:
    """Scale and offset of texture coordinates, which were numbers of their own: uv · scale + offset."""
    both = _taken(texture, "uvscale", "1")
    scale = {axis: _taken(texture, f"{uv}scale", both) for axis, uv in zip("xy", "uv", strict=True)}
    offset = {axis: _taken(texture, f"{uv}offset", "0") for axis, uv in zip("xy", "uv", strict=True)}
    if {*scale.values()} != {"1"} or {*offset.values()} != {"0"}:
        SubElement(texture, "transform", name="to_uv").extend([Element("scale", scale), Element("translate", offset)])


def _bitmap(upgrade: Upgrade, texture: Element) -> None:
    """Gamma 1 is `raw`; filters but `nearest` are `bilinear`, the default; one way to wrap for both axes."""
    _texture(upgrade, texture)
    is_float = Path(_value(texture, "filename")).suffix.lower() in (".exr", ".hdr", ".rgbe", ".pfm")
    gamma, channel = float(_taken(texture, "gamma", "1" if is_float else "-1")), _value(texture, "channel")
    if gamma == 1 or channel == "a":
        elements.put_value(texture, "raw", True)
    if not is_float and (channel in tuple("rgba") or gamma not in (1, -1)):
        upgrade.bake(texture, gamma, _taken(texture, "channel", "rgb"))
    elif is_float and gamma != 1:
        upgrade.lose("colour", "gamma", f"{gamma:g} is left out: texels are read as their file says", texture)
    if _taken(texture, "filter_type", "ewa") == "nearest":
        elements.put_value(texture, "filter_type", "nearest")
    both = _taken(texture, "wrap_mode", "repeat")
    u, v = (_taken(texture, f"wrap_mode_{axis}", both) for axis in "uv")
    mode = {"zero": "clamp", "one": "clamp", "black": "clamp", "white": "clamp"}.get(v, v)
    if u != mode or v != mode:
        said = f"{u} and {v} became {mode}: Mitsuba 3 repeats, mirrors or clamps, both axes alike"
        upgrade.lose("colour", "wrapMode", said, texture)
    elements.put_value(texture, "wrap_mode", mode)


def _scaled_texture(upgrade: Upgrade, texture: Element) -> None:
    """The texture or the colour that was scaled; a height's factor becomes that of its bump map."""
    factor = np.array(numbers_of(_taken(texture, "scale", "1")))
    if not len(texture):
        raise ValueError("it has no texture to scale; put one in")
    inner, above = texture[0], elements.parents(upgrade.root)
    users = [ref for ref in upgrade.root.iter("ref") if ref.get("id") == texture.get("id", "")]
    around = [above[user] for user in users] + [above[texture]] * (above[texture] is not upgrade.root)
    for bump in [user for user in around if user.get("type") == "bumpmap"]:
        elements.put_value(bump, "scale", float(factor.mean()))
        around.remove(bump)
    if inner.tag == "rgb":
        inner.set("value", elements.numbers((factor * numbers_of(inner.get("value", ""))).tolist()))
    elif (factor != 1).any() and around:
        upgrade.lose("colour", "scale", "a factor of a texture is left out: Mitsuba 3 has none", texture)
    inner.attrib.pop("name", None)
    if users and inner.tag != "rgb":
        inner.attrib.setdefault("id", texture.get("id", ""))
    for user in users:
        made = Element("ref", id=inner.get("id", "")) if inner.tag != "rgb" else elements.copied(inner)
        made.attrib.update({key: text for key, text in user.attrib.items() if key == "name"})
        above[user][list(above[user]).index(user)] = made
    inner.attrib.update({key: text for key, text in texture.attrib.items() if key == "name"})
    parent = above[texture]
    parent[list(parent).index(texture)] = inner
    if parent is upgrade.root and inner.tag != "texture":
        parent.remove(inner)


def _obj(upgrade: Upgrade, shape: Element) -> None:
    """Where a shape has no material, 0.6 takes those of the OBJ file."""
    file = upgrade.find(_value(shape, "filename"))
    if shape.find("bsdf") is None and shape.find("ref") is None and file and b"mtllib" in file.read_bytes():
        upgrade.lose("colour", "mtllib", "is not read: Mitsuba 3 wants a material for the shape", shape)


def _conductor(_: Upgrade, bsdf: Element) -> None:
    """Copper was what a conductor is made of by default; Mitsuba 3's reflects all."""
    if not {part.get("name") for part in bsdf} & {"material", "eta", "k"}:
        elements.put_value(bsdf, "material", "Cu")


def _width(upgrade: Upgrade, bsdf: Element, name: str, otherwise: str) -> float:
    """A number that says how wide a lobe is, taken out; a texture of them is lost, as one width is all a lobe has."""
    found = elements.child(bsdf, name)
    if found is not None and found.tag in ("texture", "ref"):
        upgrade.lose("colour", name, f"its texture became {otherwise}, the default: Mitsuba 3 has a number here", bsdf)
        bsdf.remove(found)
    return float(_taken(bsdf, name, otherwise))


def _phong(upgrade: Upgrade, bsdf: Element) -> None:
    """Walter et al. 2007: a Phong lobe of exponent n is about as wide as a Beckmann lobe of α = √(2 / (n + 2))."""
    elements.put_value(bsdf, "alpha", math.sqrt(2 / (_width(upgrade, bsdf, "exponent", "30") + 2)))


def _ward(upgrade: Upgrade, bsdf: Element) -> None:
    """One width of the lobe in place of one along u and one along v."""
    along_u, along_v = (_width(upgrade, bsdf, f"alpha_{axis}", "0.1") for axis in "uv")
    if along_u != along_v:
        said = f"{along_u:g} along u and {along_v:g} along v became one width: the nearest in Mitsuba 3 has no other"
        upgrade.lose("colour", "alphaV", said, bsdf)
    elements.put_value(bsdf, "alpha", math.sqrt(along_u * along_v))


def _mask(upgrade: Upgrade, bsdf: Element) -> None:
    """An opacity by colour is lost: Mitsuba 3 has one for all."""
    opacity = elements.child(bsdf, "opacity")
    if opacity is not None and opacity.tag == "rgb" and len({*numbers_of(opacity.get("value", ""))}) > 1:
        upgrade.lose("colour", "opacity", "became grey: Mitsuba 3 has one opacity for all colours", bsdf)


def _coating(upgrade: Upgrade, bsdf: Element) -> None:
    """A coat on a diffuse material is plastic; of others, what lies under the coat stays."""
    inside = (node for node in bsdf if node.tag == "bsdf" or (node.tag == "ref" and not node.get("name")))
    if (under := next(inside, None)) is None:
        raise ValueError("it has no material under its coat; put one in")
    bsdf.remove(under)
    same = (node for node in upgrade.root.iter("bsdf") if under.tag == "ref" and node.get("id") == under.get("id"))
    found, kind = next(same, under), bsdf.get("type", "")
    if found.get("type") == "diffuse":
        for part in map(elements.copied, found):
            part.set("name", part.get("name", "").replace("reflectance", "diffuse_reflectance"))
            bsdf.append(part)
        bsdf.set("type", kind.replace("coating", "plastic"))
        upgrade.changes.note("on a diffuse material became plastic", elements.place(bsdf), name=kind)
    else:
        upgrade.lose("colour", kind, "is left out: Mitsuba 3 has it on diffuse materials alone", bsdf)
        _blend(bsdf, [(0.5, under), (0.5, elements.copied(under))])


def _mixture(_: Upgrade, bsdf: Element) -> None:
    """Blends of two, one in another; what the weights leave of 1 is absorbed, as in 0.6."""
    weights = numbers_of(_taken(bsdf, "weights", ""))
    mixed = [node for node in bsdf if node.tag in ("bsdf", "ref")]
    if len(weights) != len(mixed) or not mixed:
        raise ValueError(f"it has {len(weights)} weights for {len(mixed)} materials")
    black = Element("bsdf", type="diffuse")
    elements.put_value(black, "reflectance", (0.0, 0.0, 0.0))
    _blend(bsdf, [*zip(weights, mixed, strict=True), (max(0.0, 1 - sum(weights)), black)])


def _blend(bsdf: Element, parts: list[tuple[float, Element]]) -> None:
    total, made = parts[-1]
    for weight, part in parts[-2::-1]:
        total += weight
        blend = Element("bsdf", type="blendbsdf")
        elements.put_value(blend, "weight", 1 - weight / max(total, 1e-9))
        blend.extend([part, made])
        made = blend
    bsdf[:] = list(made)
    bsdf.set("type", "blendbsdf")


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
    scale = _taken(emitter, "scale", "1")
    for part in ("sun", "sky"):
        own = _taken(emitter, f"{part}_scale", scale)
        elements.put_value(emitter, f"{part}_scale", float(own) if part in kind else 0.0)
    elements.put_value(emitter, "sun_aperture", 0.5358 * (float(_taken(emitter, "sun_radius_scale", "1")) or 0.02))
    if float(_taken(emitter, "stretch", "1")) != 1 or _taken(emitter, "extend", "false") == "true":
        upgrade.lose("light", "stretch", "is left out: nothing comes from below the horizon", emitter)
    placed = elements.child(emitter, "to_world")
    if placed is None:
        placed = SubElement(emitter, "transform", name="to_world")
    of_place = Element("matrix", value="0 -1 0 0 0 1 1 0 0")
    is_of_place = elements.child(emitter, "sun_direction") is None
    placed.insert(0, of_place if is_of_place else Element("rotate", x="1", angle="-90"))
    if "sky" in kind and elements.child(emitter, "albedo") is None:
        meaning = "the ground's albedo is Mitsuba 3's 0.3, not 0.6's 0.15"
        upgrade.changes.note(meaning, elements.place(emitter), name=kind)


_UPGRADES: dict[str, Callable[[Upgrade, Element], None]] = {
    "bitmap": _bitmap, "ldrtexture": _bitmap, "checkerboard": _texture,
    "scale": _scaled_texture, "obj": _obj, "conductor": _conductor, "roughconductor": _conductor, "phong": _phong,
    "ward": _ward, "mask": _mask,
    "coating": _coating, "roughcoating": _coating, "mixturebsdf": _mixture, "normalmap": _normalmap,
    "sky": _sky, "sun": _sky, "sunsky": _sky,
}  # fmt: skip
"""What means something else in Mitsuba 3, or is no longer there, by type."""
