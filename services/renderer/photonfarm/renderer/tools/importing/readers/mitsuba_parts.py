"""Parts of Mitsuba scenes: colours in each way of writing them, as linear sRGB; and what photonfarm cannot render.

The latter is taken out of a scene or replaced by what is nearest, and named.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import SpecError
from photonfarm.renderer.tools.importing import elements, images
from photonfarm.renderer.tools.importing.changes import Changes, Effect
from photonfarm.renderer.tools.importing.imported import Ids
from photonfarm.renderer.tools.importing.meshes import Floats, read_mesh, write_ply
from photonfarm.scene.files import POLARISED, SHAPES

Colour = NDArray[np.float64]
"""Linear sRGB, (3,)."""


def read_old(node: Element) -> Colour | None:
    """The colour of an element of Mitsuba 0.6, None for what is none; raises ValueError for numbers that are none.

    `rgb` is linear also in hexadecimal digits, and `srgb` is not. Spectra and black bodies are integrated against the
    CIE's curves without a white point, as 0.6's RGB mode does.
    """
    text = node.get("value", "").strip()
    if node.tag == "blackbody":
        scale = float(node.get("scale") or node.get("multiplier") or 1)
        return _blackbody(float(node.get("temperature", "").strip().rstrip("Kk"))) * scale
    if node.tag == "spectrum" and node.get("filename"):
        import mitsuba as mi

        return _integrate(*mi.spectrum_from_file(node.get("filename", "")))
    if node.tag == "spectrum" and ":" in text:
        samples = numbers_of(text.replace(":", " "))
        return _integrate(samples[::2], samples[1::2])
    if node.tag not in ("rgb", "srgb", "xyz", "spectrum"):
        return None
    digits = re.fullmatch("#([0-9a-fA-F]{6})", text)
    numbers = [byte / 255 for byte in bytes.fromhex(digits[1])] if digits else numbers_of(text)
    if len(numbers) not in (1, 3):
        raise ValueError(f"{text!r} has {len(numbers)} numbers, and a colour has one or three")
    values = np.broadcast_to(np.array(numbers), 3)
    if node.tag == "xyz":
        return images.RGB_OF_XYZ @ values
    return images.linear(values.astype(np.float32)).astype(np.float64) if node.tag == "srgb" else values


def read_new(texture: Element, *, shines: bool) -> Colour | None:
    """The colour of a texture that Mitsuba 3 evaluates in its spectral modes alone, None for others."""
    values = {part.get("name", ""): part.get("value", "") for part in texture}
    kind = texture.get("type")
    if kind == "blackbody":
        return _blackbody(float(values.get("temperature", "5000"))) * float(values.get("scale", "1"))
    if kind not in ("regular", "irregular") or "values" not in values:
        return None
    samples = numbers_of(values["values"])
    ends = float(values.get("wavelength_min", "360")), float(values.get("wavelength_max", "830"))
    at = np.linspace(*ends, len(samples)).tolist() if kind == "regular" else numbers_of(values.get("wavelengths", ""))
    if len(at) != len(samples):
        raise ValueError(f"it has {len(samples)} values and {len(at)} wavelengths")
    return _integrate(at, samples, reflects=not shines)


def put_colour(node: Element, colour: Colour) -> None:
    """Let an element be a colour, of the same name."""
    node.tag, node[:] = "rgb", []
    node.attrib = {"name": node.get("name", ""), "value": elements.numbers(colour.tolist())}


def numbers_of(text: str) -> list[float]:
    """Numbers with spaces or commas between; raises ValueError for what is none, or is not finite."""
    numbers = [float(each) for each in re.findall(r"[^\s,]+", text)]
    if not np.isfinite(numbers).all():
        raise ValueError(f"{text!r} is no number")
    return numbers


def _blackbody(kelvin: float) -> Colour:
    """Planck's radiance in W / (m² sr nm), as a colour."""
    wavelengths = np.linspace(360.0, 830.0, 95)
    metres = wavelengths * 1e-9
    radiance = 1.191042972e-25 / metres**5 / np.expm1(0.01438776877 / (metres * kelvin))
    return _integrate(wavelengths.tolist(), radiance.tolist())


def _integrate(wavelengths: list[float], values: list[float], *, reflects: bool = False) -> Colour:
    """The colour of light; of what reflects, as Mitsuba 3 has it: under daylight, and within 0 and 1."""
    import mitsuba as mi

    return np.array(mi.spectrum_list_to_srgb(wavelengths, values, reflects, reflects), np.float64).clip(0)


_SHAPES = (*SHAPES, "instance", "shapegroup")  # the last two become others

_KINDS = {"bsdf": "BSDF", "emitter": "Emitter", "texture": "Texture"}
"""What Mitsuba has plugins for, by element."""

_MEDIA = ("medium", "volume", "phase")

MOST = 5000
"""The most shapes that instances are expanded into; more are a forest, which no memory holds."""

_ROUND = ("sphere", "cylinder", "disk")
"""The shapes that Mitsuba keeps round under each transform of their own."""

_MESHES = ("obj", "ply", "serialized", "cube")
"""The shapes whose normals turn where a transform of their own mirrors them, and turn not in an instance."""

_IDENTITY, _MIRROR = np.eye(4), np.diag([-1.0, 1.0, 1.0, 1.0])


def mend(root: Element, changes: Changes) -> None:
    """Mend a scene in place, and say what was left out or replaced."""
    _keep_used(root)
    _drop_media(root, changes)
    above = elements.parents(root)
    left_out = list(_leave_out(root, above, changes))
    gone = {part.get("id") for node in left_out for part in node.iter() if part.tag != "ref"}
    for node in list(root.iter()):
        node[:] = [part for part in node if not (part.tag == "ref" and part.get("id") in gone)]
    _integrate_spectra(root, above)


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


def _drop_media(root: Element, changes: Changes) -> None:
    """Take media out; a shape that only bounds one goes with it, as nothing of it would be seen."""
    media = {node.get("id") for node in root.iter() if node.tag in _MEDIA} - {None}
    unseen = {node.get("id") for node in root.iter("bsdf") if node.get("type") == "null"} - {None}
    above = elements.parents(root)
    for node in list(root.iter()):
        kept = [part for part in node if part.tag not in _MEDIA and part.get("id") not in media]
        held, node[:] = len(node), kept
        if len(kept) == held or node.tag not in ("shape", "emitter"):
            continue
        seen = [part for part in kept if part.tag in ("bsdf", "emitter", "ref") and part.get("id") not in unseen]
        has_material = any(part.tag in ("bsdf", "ref") for part in kept)  # Mitsuba gives others a grey one
        if node.tag == "shape" and has_material and all(part.get("type") == "null" for part in seen):
            above[node].remove(node)
            changes.lose("geometry", "medium", "is left out, with what only bounds it", elements.place(node))
        else:
            changes.lose("colour", "medium", "is left out: only surfaces are rendered", elements.place(node))


def _leave_out(parent: Element, above: dict[Element, Element], changes: Changes) -> Iterator[Element]:
    """Take out, or replace, what is not rendered of all that is in an element; what was taken out."""
    for node in list(parent):
        kind, is_known = node.get("type", ""), node.tag not in _KINDS or _is_known(node)
        if (node.tag == "shape" and kind not in _SHAPES) or (node.tag != "bsdf" and not is_known):
            meaning = "is not rendered here, and is left out"
            changes.lose(effect_of(node, above), kind, meaning, elements.place(node))
            parent.remove(node)
            yield node
            continue
        if node.tag == "bsdf" and (kind in POLARISED or not is_known):
            changes.lose("colour", kind, f"is not rendered here, and became {_replace(node)}", elements.place(node))
        elif kind == "directionalarea":
            node.set("type", "area")
            changes.lose("light", kind, "became an area light, which shines in all directions", elements.place(node))
        yield from _leave_out(node, above, changes)


def _is_known(node: Element) -> bool:
    import mitsuba as mi

    kind = mi.PluginManager.instance().plugin_type(node.get("type", ""))
    return kind == getattr(mi.ObjectType, _KINDS[node.tag]) or node.get("type") in ("rgb", "spectrum")


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


def _integrate_spectra(root: Element, above: dict[Element, Element]) -> None:
    """Make colours of black bodies and sampled spectra, which Mitsuba 3 evaluates in its spectral modes alone."""
    for node in list(root.iter("texture")):
        users = [part for part in root.iter("ref") if part.get("id") == node.get("id")]
        for user in users or [node]:
            shines = effect_of(above[user] if users else node, above) == "light"
            try:
                colour = read_new(node, shines=shines)
            except ValueError as error:
                raise SpecError(f"{elements.place(node)}: cannot be read: {error}") from error
            if colour is not None:
                put_colour(user, colour)
        if users and users[0].tag == "rgb" and node in list(root):
            root.remove(node)


def expand(root: Element, changes: Changes, scratch: Path) -> None:
    """Put copies of its group's shapes, which can move and be sampled as lights, in the place of each instance."""
    groups = {group.get("id"): group for group in root.findall("shape[@type='shapegroup']")}
    copies: dict[Element, list[Element]] = {}
    ids, made = Ids(root), 0
    mirrored = cache(partial(_mirror, scratch=scratch))
    for number, instance in enumerate(root.findall("shape[@type='instance']"), 1):
        ref, placed = instance.find("ref"), elements.child(instance, "to_world")
        group = instance.find("shape") if ref is None else groups.get(ref.get("id"))
        matrix = _IDENTITY if placed is None else np.array(placed[0].get("value", "").split(), np.float64)
        shapes = [] if group is None or made >= MOST else group.findall("shape")
        copies[instance] = [_place(shape, matrix.reshape(4, 4), mirrored, changes) for shape in shapes]
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


def _place(shape: Element, matrix: Floats, mirrored: Callable[[Element], Element], changes: Changes) -> Element:
    """A copy of a shape, moved by the matrix of an instance; its front stays its front, as in Mitsuba's instances."""
    kind, is_mirrored = shape.get("type", ""), np.linalg.det(matrix[:3, :3]) < 0
    square = matrix[:3, :3].T @ matrix[:3, :3]
    if kind in _ROUND and not np.allclose(square, np.eye(3) * np.trace(square) / 3, atol=1e-5 * np.trace(square)):
        meaning = "stays round where an instance stretches it; make it a mesh"
        changes.lose("geometry", kind, meaning, elements.place(shape))
    if is_mirrored and kind in _MESHES:
        shape, matrix = mirrored(shape), matrix @ _MIRROR
    copy = elements.copy_element(shape)
    if (own := elements.child(copy, "to_world")) is None:
        own = SubElement(copy, "transform", name="to_world")
    SubElement(own, "matrix", value=" ".join(map(repr, matrix.ravel().tolist())))
    if is_mirrored and kind == "sphere":
        if (flipped := elements.child(copy, "flip_normals")) is not None:
            copy.remove(flipped)
        elements.put_value(copy, "flip_normals", flipped is None or flipped.get("value") != "true")
    return copy


def _mirror(shape: Element, scratch: Path) -> Element:
    """A mesh as a mirror at x = 0 shows it, with its fronts; one that Mitsuba refuses stays, and is told later."""
    import mitsuba as mi

    alone = elements.copy_element(shape)
    alone[:] = [part for part in alone if part.tag not in ("bsdf", "emitter", "ref")]
    alone.set("version", "3.0.0")
    config = mi.parser.ParserConfig(mi.variant())
    config.unused_properties = mi.LogLevel.Debug
    try:
        state = mi.parser.parse_string(config, elements.text(alone).replace("$", r"\$"))
        mi.parser.transform_all(config, state)
        mesh = read_mesh(mi.parser.instantiate(config, state)).transform(_MIRROR)
    except RuntimeError:
        return shape
    made = Element("shape", type="ply")
    file = write_ply(mesh, scratch / f"{len(list(scratch.iterdir()))}-mirrored.ply")
    elements.put_value(made, "filename", str(file))
    elements.put_value(made, "face_normals", mesh.normals is None)
    made.extend(elements.copy_element(part) for part in shape if part.tag in ("bsdf", "emitter", "ref"))
    return made
