"""What photonfarm cannot render, taken out of a Mitsuba scene or replaced by what is nearest, and named."""

from __future__ import annotations

from xml.etree.ElementTree import Element

from photonfarm.renderer.importing import elements
from photonfarm.renderer.importing.changes import Changes, Effect
from photonfarm.renderer.importing.readers import mitsuba_spectra
from photonfarm.shared.scene.files import POLARISED, SHAPES

_SHAPES = (*SHAPES, "instance", "shapegroup")  # the last two become others

_KINDS = {"bsdf": "BSDF", "emitter": "Emitter", "texture": "Texture"}
"""What Mitsuba has plugins for, by element."""

_MEDIUM_PLACES = ("interior", "exterior", "medium")


def mend(root: Element, changes: Changes) -> None:
    """Mend a scene in place, and say what was left out or replaced."""
    _keep_used(root)
    gone = {node.get("id") for tag in ("medium", "volume", "phase") for node in root.iter(tag)}
    _drop_media(root, gone - {None}, changes)
    above = elements.parents(root)
    for node in [part for part in root.iter() if part.tag in ("shape", *_KINDS)]:
        parent, kind = above[node], node.get("type", "")
        if parent is not root and node not in list(parent):
            continue  # left out with what it was in
        if kind == "merge":
            place = list(parent).index(node)
            parent[place : place + 1] = node.findall("shape")
            above.update(dict.fromkeys(node, parent))
        elif node.tag == "shape" and kind not in _SHAPES:
            gone |= _lose(node, parent, above, changes, "cannot be rendered here, and is left out")
        elif kind == "directionalarea":
            node.set("type", "area")
            changes.lose("light", kind, "became an area light, which shines in all directions", elements.place(node))
        elif node.tag == "bsdf" and (kind in POLARISED or not _is_known(node)):
            changes.lose("colour", kind, "is not rendered here, and became diffuse", elements.place(node))
            _make_diffuse(node)
        elif node.tag in _KINDS and not _is_known(node):
            gone |= _lose(node, parent, above, changes, "is not in Mitsuba 3, and is left out")
    for node in list(root.iter()):
        node[:] = [part for part in node if not (part.tag == "ref" and part.get("id") in gone)]
    _integrate_spectra(root)


def effect_of(node: Element, above: dict[Element, Element]) -> Effect:
    """What of the picture an element is about; a texture, as what it is on."""
    while node.tag == "texture" and node in above:
        node = above[node]
    effects: dict[str, Effect] = {"shape": "geometry", "emitter": "light"}
    return effects.get(node.tag, "colour")


def _lose(
    node: Element, parent: Element, above: dict[Element, Element], changes: Changes, meaning: str
) -> set[str | None]:  # fmt: skip
    """Take an element out; the ids that are gone with it."""
    changes.lose(effect_of(node, above), node.get("type", ""), meaning, elements.place(node))
    parent.remove(node)
    return {part.get("id") for part in node.iter() if part.tag != "ref"} - {None}


def _keep_used(root: Element) -> None:
    """Move materials and textures that are referred to out of what they are in, and leave out those that are not."""
    used = {node.get("id") for node in root.iter("ref")}
    for parent in [node for part in root for node in part.iter()]:
        for place, node in enumerate(parent):
            if node.tag in ("bsdf", "texture") and node.get("id") in used:
                named = {key: text for key, text in node.attrib.items() if key in ("id", "name")}
                node.attrib.pop("name", None)
                parent[place] = Element("ref", named)
                root.insert(0, node)
    root[:] = [node for node in root if node.tag not in ("bsdf", "texture") or node.get("id") in used]


def _is_known(node: Element) -> bool:
    import mitsuba as mi

    kind = mi.PluginManager.instance().plugin_type(node.get("type", ""))
    return kind == getattr(mi.ObjectType, _KINDS[node.tag]) or node.get("type") in ("rgb", "spectrum")


def _drop_media(root: Element, media: set[str | None], changes: Changes) -> None:
    """Take media out; a shape that only bounds one goes with it, as nothing of it would be seen."""
    invisible = {node.get("id") for node in root.iter("bsdf") if node.get("type") == "null"} - {None}
    above = elements.parents(root)
    for shape in [node for node in root.iter() if node.tag in ("shape", "emitter")]:
        outside = [part for part in shape if not _is_medium(part, media)]
        if len(outside) == len(shape):
            continue
        shape[:] = outside
        materials = [
            part for part in shape if part.tag in ("bsdf", "emitter") or (part.tag == "ref" and not part.get("name"))
        ]
        if shape.tag == "shape" and all(
            part.get("type") == "null" or part.get("id") in invisible for part in materials
        ):
            above[shape].remove(shape)
            meaning = "is left out with what only bounds it: only surfaces are rendered"
            changes.lose("geometry", "medium", meaning, elements.place(shape))
        else:
            changes.lose("colour", "medium", "is left out: only surfaces are rendered", elements.place(shape))
    root[:] = [node for node in root if node.tag not in ("medium", "volume", "phase")]


def _is_medium(part: Element, media: set[str | None]) -> bool:
    return part.tag == "medium" or (
        part.tag == "ref" and (part.get("id") in media or part.get("name") in _MEDIUM_PLACES)
    )


def _make_diffuse(bsdf: Element) -> None:
    """Make a material diffuse, with a reflectance that it states."""
    names = ("reflectance", "diffuse_reflectance", "base_color", "specular_reflectance", "transmittance")
    stated = next((found for name in names if (found := elements.child(bsdf, name)) is not None), None)
    bsdf[:] = []
    bsdf.set("type", "diffuse")
    if stated is None:
        elements.put_value(bsdf, "reflectance", (0.5, 0.5, 0.5))
    else:
        stated.set("name", "reflectance")
        bsdf.append(stated)


def _integrate_spectra(root: Element) -> None:
    """Make colours of black bodies and sampled spectra, which Mitsuba 3 evaluates in its spectral modes alone."""
    above = elements.parents(root)
    for node in list(root.iter("texture")):
        colour = mitsuba_spectra.of_new(node, shines=effect_of(node, above) == "light")
        if colour is None:
            continue
        for user in [part for part in root.iter("ref") if part.get("id") == node.get("id")]:
            mitsuba_spectra.put(user, colour)
        if above[node] is root:
            root.remove(node)
        mitsuba_spectra.put(node, colour)
