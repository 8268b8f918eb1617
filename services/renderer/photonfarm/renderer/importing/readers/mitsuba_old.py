"""Scenes of Mitsuba 0.6 and older: old names to those of Mitsuba 3, and what has no successor to what is nearest."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from photonfarm.renderer.importing import elements
from photonfarm.renderer.importing.readers import images

_HUMP = re.compile(r"(?<=[a-z0-9])(?=[A-Z])")

_TAGS = {"luminaire": "emitter", "camera": "sensor", "lookAt": "lookat", "srgb": "rgb"}


def upgrade(root: Element) -> list[str]:
    """Upgrade a scene in place; sentences about what changed more than its name."""
    notes: list[str] = []
    for node in root.iter():
        node.tag = _TAGS.get(node.tag, node.tag)
        if "name" in node.attrib and node.tag != "default":
            node.set("name", _HUMP.sub("_", node.get("name", "")).lower())
        _upgrade_colour(node)
    for node in list(root.iter()):
        _upgrade_texture(node)
        successor = _SUCCESSORS.get((node.tag, node.get("type", "")))
        if successor is not None:
            old = node.get("type", "")
            successor(node)
            notes.append(
                f"{elements.place(node)} of type {old!r} became {node.get('type')!r}, the nearest in Mitsuba 3"
            )
    return notes


def _upgrade_colour(node: Element) -> None:
    if node.tag == "blackbody":
        temperature = float(node.get("temperature", "5000").rstrip("Kk "))
        scale = float(node.get("scale", "1"))
        node.tag = "rgb"
        name = node.get("name", "")
        node.attrib.clear()
        node.attrib.update(name=name, value=elements.numbers([scale * part for part in blackbody(temperature)]))
    elif node.tag in ("spectrum", "rgb") and node.get("value", "").startswith("#"):
        digits = node.get("value", "")[1:7]
        encoded = [int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)]
        node.tag = "rgb"
        node.set("value", elements.numbers(images.linear(np.array(encoded, np.float32)).tolist()))
    elif node.tag == "spectrum" and re.fullmatch(r"\s*[^\s:,]+[\s,]+[^\s:,]+[\s,]+[^\s:,]+\s*", node.get("value", "")):
        node.tag = "rgb"  # three numbers were a colour


def blackbody(temperature_k: float) -> tuple[float, float, float]:
    """The colour of a black body in linear RGB with a mean of 1, by Tanner Helland's fit to its chromaticity."""
    t = max(10.0, min(400.0, temperature_k / 100))
    red = 1.0 if t <= 66 else 329.7 * (t - 60) ** -0.1332 / 255
    green = (99.47 * math.log(t) - 161.12) / 255 if t <= 66 else 288.12 * (t - 60) ** -0.0755 / 255
    blue = 1.0 if t >= 66 else 0.0 if t <= 19 else (138.52 * math.log(t - 10) - 305.04) / 255
    linear = [max(0.0, min(1.0, part)) ** 2.2 for part in (red, green, blue)]
    mean = sum(linear) / 3
    return linear[0] / mean, linear[1] / mean, linear[2] / mean


def _upgrade_texture(texture: Element) -> None:
    """Scale and offset of texture coordinates, which were numbers of their own."""
    if texture.tag != "texture":
        return
    found = {name: _taken(texture, name) for name in ("uscale", "vscale", "uvscale", "uoffset", "voffset")}
    if any(value is not None for value in found.values()):
        both = found["uvscale"] or 1.0
        transform = SubElement(texture, "transform", name="to_uv")
        SubElement(transform, "scale", x=str(found["uscale"] or both), y=str(found["vscale"] or both))
        SubElement(transform, "translate", x=str(found["uoffset"] or 0.0), y=str(found["voffset"] or 0.0))


def _taken(node: Element, name: str) -> float | None:
    found = elements.child(node, name)
    if found is None:
        return None
    node.remove(found)
    return float(found.get("value", "0"))


# ------------------------------------------------------------------------------------------- what has a successor


def _phong(bsdf: Element) -> None:
    """Walter et al. 2007: a Phong lobe of exponent n is about as wide as a Beckmann lobe of α = √(2 / (n + 2))."""
    exponent = _taken(bsdf, "exponent")
    _glossy(bsdf, math.sqrt(2 / ((30.0 if exponent is None else exponent) + 2)))


def _ward(bsdf: Element) -> None:
    alphas = [_taken(bsdf, name) for name in ("alpha", "alpha_u", "alpha_v")]
    given = [alpha for alpha in alphas if alpha]
    _glossy(bsdf, sum(given) / len(given) if given else 0.1)


def _glossy(bsdf: Element, alpha: float) -> None:
    for name in ("exponent", "alpha_u", "alpha_v", "variant", "specular_reflectance"):
        old = elements.child(bsdf, name)
        if old is not None:
            bsdf.remove(old)
    bsdf.set("type", "roughplastic")
    elements.put_value(bsdf, "alpha", alpha)


def _coating(bsdf: Element) -> None:
    """What lies under the coat stays."""
    under = next((node for node in bsdf if node.tag in ("bsdf", "ref")), None)
    if under is None or under.tag == "ref":
        _keep_children(bsdf, ("ref",))
        bsdf.set("type", "twosided")
        return
    bsdf[:] = list(under)
    bsdf.set("type", under.get("type", "diffuse"))


def _mixture(bsdf: Element) -> None:
    """The first two are blended by their weights."""
    weights = elements.child(bsdf, "weights")
    given = [float(x) for x in re.findall(r"[-+.\deE]+", weights.get("value", "") if weights is not None else "")]
    parts = [node for node in bsdf if node.tag in ("bsdf", "ref")][:2]
    share = given[1] / max(given[0] + given[1], 1e-9) if len(given) > 1 else 0.5
    bsdf[:] = parts
    if len(parts) == 2:
        bsdf.set("type", "blendbsdf")
        elements.put_value(bsdf, "weight", share)
    else:
        bsdf.set("type", "twosided")


def _keep_children(node: Element, tags: tuple[str, ...]) -> None:
    node[:] = [part for part in node if part.tag in tags]


def _scaled_texture(texture: Element) -> None:
    """The texture that was scaled."""
    inner = next((node for node in texture if node.tag == "texture"), None)
    if inner is not None:
        texture[:] = list(inner)
        texture.set("type", inner.get("type", "bitmap"))


def _sky(dark: str) -> Callable[[Element], None]:
    """The part of `sunsky` that is meant: the other one gets no light."""

    def become(emitter: Element) -> None:
        emitter.set("type", "sunsky")
        for old in ("extend", "sky_scale", "sun_scale", "resolution", "stretch", "sun_radius_scale"):
            found = elements.child(emitter, old)
            if found is not None:
                emitter.remove(found)
        elements.put_value(emitter, dark, 0.0)

    return become


def _becomes(successor: str) -> Callable[[Element], None]:
    return lambda node: node.set("type", successor)


_SUCCESSORS: dict[tuple[str, str], Callable[[Element], None]] = {
    ("bsdf", "phong"): _phong,
    ("bsdf", "ward"): _ward,
    ("bsdf", "roughdiffuse"): _becomes("diffuse"),
    ("bsdf", "difftrans"): _becomes("diffuse"),
    ("bsdf", "coating"): _coating,
    ("bsdf", "roughcoating"): _coating,
    ("bsdf", "mixturebsdf"): _mixture,
    ("texture", "ldrtexture"): _becomes("bitmap"),
    ("texture", "gridtexture"): _becomes("checkerboard"),
    ("texture", "scale"): _scaled_texture,
    ("emitter", "sky"): _sky("sun_scale"),
    ("emitter", "sun"): _sky("sky_scale"),
}
