"""What photonfarm cannot render, taken out of a Mitsuba scene or replaced by what is nearest, and named."""

from __future__ import annotations

from collections.abc import Iterator
from xml.etree.ElementTree import Element

from photonfarm.renderer.importing import elements
from photonfarm.shared.scene.files import POLARISED, SHAPES
from photonfarm.shared.scene.located_xml import line_of

_SHAPES = (*SHAPES, "instance", "shapegroup")  # the last two become others

_MEDIUM_PLACES = ("interior", "exterior", "medium")


def mend(root: Element) -> list[str]:
    """Mend a scene in place; sentences about what was left out or replaced."""
    _unwrap_merges(root)
    return [*_drop_media(root), *_drop_shapes(root), *_replace_materials(root)]


def _unwrap_merges(root: Element) -> None:
    for merge in root.findall("shape[@type='merge']"):
        place = list(root).index(merge)
        root.remove(merge)
        for shape in reversed(merge.findall("shape")):
            root.insert(place, shape)


def _drop_media(root: Element) -> Iterator[str]:
    """Take media out; a shape that only bounds one goes with it, as nothing of it would be seen."""
    media = {node.get("id") for node in root.iter("medium")} - {None}
    invisible = {node.get("id") for node in root.iter("bsdf") if node.get("type") == "null"} - {None}
    for shape in root.findall(".//shape"):
        inside = [part for part in shape if _is_medium(part, media)]
        if not inside:
            continue
        for part in inside:
            shape.remove(part)
        if _bounds_only(shape, invisible):
            elements.parents(root)[shape].remove(shape)
            yield f"{_named(shape)} only bounds a medium, and is left out with it, as only surfaces are rendered"
        else:
            yield f"{_named(shape)}: the medium is left out, as only surfaces are rendered"
    for node in root.findall("medium") + root.findall("volume") + root.findall("phase"):
        root.remove(node)


def _is_medium(part: Element, media: set[str | None]) -> bool:
    return part.tag == "medium" or (
        part.tag == "ref" and (part.get("id") in media or part.get("name") in _MEDIUM_PLACES)
    )


def _bounds_only(shape: Element, invisible: set[str | None]) -> bool:
    """Whether a shape is null, or was left without a material: Mitsuba then takes it for a mere boundary."""
    materials = [part for part in shape if part.tag == "bsdf" or (part.tag == "ref" and part.get("name") is None)]
    return all(part.get("type") == "null" or part.get("id") in invisible for part in materials)


def _drop_shapes(root: Element) -> Iterator[str]:
    above = elements.parents(root)
    for shape in root.findall(".//shape"):
        if shape.get("type") not in _SHAPES:
            above[shape].remove(shape)
            yield f"{_named(shape)} is left out: shapes of type {shape.get('type')!r} cannot be rendered here"


def _replace_materials(root: Element) -> Iterator[str]:
    for bsdf in root.iter("bsdf"):
        if bsdf.get("type") in POLARISED:
            yield f"{elements.place(bsdf)} of type {bsdf.get('type')!r} became diffuse: polarisation is not rendered"
            make_diffuse(bsdf)
    for emitter in root.iter("emitter"):
        if emitter.get("type") == "directionalarea":
            emitter.set("type", "area")
            yield f"{elements.place(emitter)} of type 'directionalarea' became an area light, which no angle limits"


def make_diffuse(bsdf: Element) -> None:
    """Make a material diffuse, with a reflectance that it states."""
    names = ("reflectance", "diffuse_reflectance", "base_color", "specular_reflectance")
    stated = next((found for name in names if (found := elements.child(bsdf, name)) is not None), None)
    bsdf[:] = []
    bsdf.set("type", "diffuse")
    if stated is None:
        elements.put_value(bsdf, "reflectance", (0.5, 0.5, 0.5))
    else:
        stated.set("name", "reflectance")
        bsdf.append(stated)


def _named(shape: Element) -> str:
    file = elements.child(shape, "filename")
    known = shape.get("id") or (file.get("value") if file is not None else None) or shape.get("type")
    return f"line {line_of(shape)}: shape {known!r}"
