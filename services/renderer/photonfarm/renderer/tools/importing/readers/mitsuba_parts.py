"""What photonfarm cannot render of Mitsuba scenes: taken out, or replaced by what is nearest, and named."""

from __future__ import annotations

from collections.abc import Iterator
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from photonfarm.renderer.tools.importing import elements
from photonfarm.renderer.tools.importing.changes import Changes, Effect
from photonfarm.renderer.tools.importing.imported import Floats, Ids
from photonfarm.scene.files import POLARISED, SHAPES

_KINDS = {"bsdf": "BSDF", "emitter": "Emitter", "texture": "Texture"}
"""What Mitsuba has plugins for, by element."""

_NOT_RENDERED = {
    "shape": lambda kind: kind not in (*SHAPES, "instance", "shapegroup"),  # the last two become others
    "texture": lambda kind: kind in ("blackbody", "regular", "irregular"),  # of Mitsuba's spectral modes
}

MOST = 5000
"""The most shapes that instances are expanded into; more are a forest, which no memory holds."""

_ROUND = ("sphere", "cylinder", "disk")
"""The shapes that Mitsuba keeps round under each transform of their own."""

_TURNED = ("obj", "ply", "serialized", "sphere")
"""The shapes whose normals turn where a transform of their own mirrors them, and turn not in an instance."""


def mend(root: Element, changes: Changes) -> None:
    """Mend a scene in place, and say what was left out or replaced."""
    _keep_used(root)
    above = elements.parents(root)
    left_out = list(_leave_out(root, above, changes))
    gone = {part.get("id") for node in left_out for part in node.iter() if part.tag != "ref"}
    for node in list(root.iter()):
        node[:] = [part for part in node if not (part.tag == "ref" and part.get("id") in gone)]
    unseen = {node.get("id") for node in root.findall("bsdf") if node.get("type") == "null"} - {None}
    for shape in root.findall("shape"):
        if any(part.get("type") == "null" or (part.tag == "ref" and part.get("id") in unseen) for part in shape):
            root.remove(shape)
            changes.note("is left out, as nothing of it is seen", elements.place(shape), name="null")


def effect_of(node: Element, above: dict[Element, Element]) -> Effect:
    """What of the picture an element is about; a texture, as what it is on."""
    while node.tag == "texture" and node in above:
        node = above[node]
    effects: dict[str, Effect] = {"shape": "geometry", "emitter": "light"}
    return effects.get(node.tag, "colour")


def _keep_used(root: Element) -> None:
    """Move materials and textures that are referred to out of what they are in; leave out those that nothing uses."""
    used = {node.get("id") for node in root.iter("ref")}
    for parent in [node for part in root for node in part.iter()]:
        for place, node in enumerate(parent):
            if node.tag in ("bsdf", "texture") and node.get("id") in used:
                named = {key: text for key, text in node.attrib.items() if key in ("id", "name")}
                node.attrib.pop("name", None)
                parent[place] = Element("ref", named)
                root.insert(0, node)
    held = {node.get("id") for node in root if node.tag != "ref"}  # a shape that a <ref> names again stays one
    of_others = {node for node in root if node.tag in ("bsdf", "texture") or node.get("type") == "shapegroup"}
    left_out = {node for node in of_others if node.get("id") not in used}
    left_out |= {node for node in root if node.tag == "ref" and node.get("id") in held}
    root[:] = [node for node in root if node not in left_out]


def _leave_out(parent: Element, above: dict[Element, Element], changes: Changes) -> Iterator[Element]:
    """Take out, or replace, what is not rendered of all that is in an element; what was taken out."""
    for node in list(parent):
        kind, where, is_known = node.get("type", ""), elements.place(node), _is_known(node)
        if node.tag != "bsdf" and not is_known:
            changes.lose(effect_of(node, above), kind, "is not rendered here, and is left out", where)
        elif node.tag in ("medium", "volume", "phase"):
            changes.lose("colour", "medium", "is left out: only surfaces are rendered", where)
        else:
            if node.tag == "bsdf" and (kind in POLARISED or not is_known):
                changes.lose("colour", kind, f"is not rendered here, and became {_replace(node)}", where)
            elif kind == "directionalarea":
                node.set("type", "area")
                changes.lose("light", kind, "became an area light, which shines in all directions", where)
            yield from _leave_out(node, above, changes)
            continue
        parent.remove(node)
        yield node


def _is_known(node: Element) -> bool:
    import mitsuba as mi

    kind = node.get("type", "")
    if node.tag in _NOT_RENDERED and _NOT_RENDERED[node.tag](kind):
        return False
    if node.tag not in _KINDS or kind in ("rgb", "spectrum"):
        return True
    return bool(mi.PluginManager.instance().plugin_type(kind) == getattr(mi.ObjectType, _KINDS[node.tag]))


def _replace(bsdf: Element) -> str:
    """Make a material what it is on, or else diffuse, with a reflectance that it states; which of them."""
    names = ("reflectance", "diffuse_reflectance", "base_color", "specular_reflectance", "transmittance")
    stated = next((child for name in names if (child := elements.child(bsdf, name)) is not None), None)
    under = [part for part in bsdf if part.tag == "bsdf" or (part.tag == "ref" and not part.get("name"))]
    bsdf[:] = []
    if under:  # a blend of it with itself, as there may be an id for the material as a whole
        bsdf.set("type", "blendbsdf")
        bsdf.extend([under[0], elements.copy_element(under[0])])
        elements.put_value(bsdf, "weight", 0.0)
        return "what it is on"
    bsdf.set("type", "diffuse")
    bsdf.append(elements.put_value(elements.scene(), "", (0.5, 0.5, 0.5)) if stated is None else stated)
    bsdf[0].set("name", "reflectance")
    return "diffuse"


def expand(root: Element, changes: Changes) -> None:
    """Put copies of its group's shapes, which can move and be sampled as lights, in the place of each instance."""
    groups = {group.get("id"): group for group in root.findall("shape[@type='shapegroup']")}
    copies: dict[Element, list[Element]] = {}
    ids, made = Ids(root), 0
    for number, instance in enumerate(root.findall("shape[@type='instance']"), 1):
        ref, placed = instance.find("ref"), elements.child(instance, "to_world")
        group = instance.find("shape") if ref is None else groups.get(ref.get("id"))
        matrix = np.eye(4) if placed is None else np.array(placed[0].get("value", "").split(), np.float64)
        shapes = [] if group is None or made >= MOST else group.findall("shape")
        copies[instance] = [_place(shape, matrix.reshape(4, 4), changes) for shape in shapes]
        for shape, copy in zip(shapes, copies[instance], strict=True):
            name = shape.get("id") or (ref is not None and ref.get("id")) or "instance"
            copy.set("id", ids.make(f"{name}_{number}"))
        made += len(shapes)
    root[:] = [part for node in root if node.get("id") not in groups for part in copies.get(node, [node])]
    if made:
        changes.note(f"{len(copies)} instances became {made} shapes of their own")
    if left_out := sum(not each for each in copies.values()):
        meaning = f"{left_out} of {len(copies)} are missing, of empty groups or beyond {MOST} shapes"
        changes.lose("geometry", "instance", meaning)


def _place(shape: Element, matrix: Floats, changes: Changes) -> Element:
    """A copy of a shape, moved by the matrix of an instance; its front stays its front, as in Mitsuba's instances."""
    kind, square = shape.get("type", ""), matrix[:3, :3].T @ matrix[:3, :3]
    is_mirrored = np.linalg.det(matrix[:3, :3]) < 0
    is_stretched = not np.allclose(square, np.eye(3) * np.trace(square) / 3, atol=1e-5 * np.trace(square))
    if (kind in _ROUND and is_stretched) or (kind == "cube" and is_mirrored):
        meaning = "stays round where an instance stretches it, or shows its inside where one mirrors it; make it a mesh"
        changes.lose("geometry", kind, meaning, elements.place(shape))
    copy = elements.copy_element(shape)
    if (own := elements.child(copy, "to_world")) is None:
        own = SubElement(copy, "transform", name="to_world")
    SubElement(own, "matrix", value=" ".join(map(repr, matrix.ravel().tolist())))
    if is_mirrored and kind in _TURNED:
        flipped = elements.child(copy, "flip_normals")
        if flipped is not None:
            copy.remove(flipped)
        elements.put_value(copy, "flip_normals", flipped is None or flipped.get("value") != "true")
    return copy
