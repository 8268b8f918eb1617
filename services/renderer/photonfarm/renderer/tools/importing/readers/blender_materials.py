"""Run by Blender's Python: materials as its exporter to glTF can write them, and what of them it cannot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import bpy

DULL: dict[str, Any] = {"Roughness": 1.0, "Specular IOR Level": 0.0}
"""The values of a Principled BSDF that is diffuse."""

_BLACK = {**DULL, "Base Color": (0, 0, 0, 1)}
_ROUGH = {"Color": "Base Color", "Base Color": "Base Color", "Roughness": "Roughness", "Normal": "Normal"}
_LIGHT = {"Color": "Emission Color", "Strength": "Emission Strength"}
_SHADERS: dict[str, tuple[dict[str, str], dict[str, Any]]] = {
    "BSDF_DIFFUSE": ({"Color": "Base Color", "Normal": "Normal"}, DULL),
    **dict.fromkeys(("BSDF_GLOSSY", "BSDF_METALLIC"), (_ROUGH, {"Metallic": 1.0})),
    "BSDF_GLASS": ({**_ROUGH, "IOR": "IOR"}, {"Transmission Weight": 1.0}),
    "BSDF_TRANSPARENT": ({"Color": "Base Color"}, {**DULL, "Alpha": 0.0}),
    "EMISSION": (_LIGHT, _BLACK),
    "": ({}, _BLACK),
}
"""The shaders that the Principled BSDF can stand for: which input becomes which of its own, and its other values."""

# Inputs of the Principled BSDF that have to be 0, those of other shaders, and those that may be images
_NEUTRAL = ("Subsurface Weight", "Sheen Weight", "Anisotropic", "Diffuse Roughness", "Thin Film Thickness")
_SPECIAL = ("Roughness", "Anisotropy", "Thin Film Thickness")
_COLOURS, _NUMBERS = ("Base Color", "Emission Color"), ("Roughness", "Metallic")

Lose = Callable[[str, str, str], None]


def prepare(material: Any, lose: Lose) -> None:
    """Make the surface of a material one Principled BSDF of values and plain images; `lose` says what differs then."""
    material.use_backface_culling = False  # Cycles shows both sides whatever it says
    if not material.use_nodes:  # which the exporter writes as it is
        return
    tree = material.node_tree
    output = tree.get_output_node("CYCLES") or tree.nodes.new("ShaderNodeOutputMaterial")
    has_volume = output.inputs["Volume"].is_linked
    for name, effect in (("Volume", "colour"), ("Displacement", "geometry")):
        for link in output.inputs[name].links:
            lose(effect, name, "is not carried over")
            tree.links.remove(link)
    node = source(output.inputs["Surface"])
    if node is None and has_volume:  # which has no surface
        node = tree.nodes.new("ShaderNodeBsdfTransparent")
    surface = _make_principled(tree, node, lose)
    tree.links.new(surface.outputs[0], output.inputs["Surface"])
    for part in surface.inputs:
        unfit = _find_unfit(part)
        if part.name in _NEUTRAL and (part.is_linked or part.default_value > 0):
            lose("colour", part.name, "is not carried over")
            for link in part.links:
                tree.links.remove(link)
            part.default_value = 0  # so that the exporter does not write it
        elif unfit is not None:
            effect = "light" if "Emission" in part.name else "colour"
            lose(effect, unfit.bl_label, f"{part.name} does not vary here; bake it to an image to keep it")
            tree.links.remove(part.links[0])
    if surface.inputs["Coat Weight"].default_value > 0 and min(surface.inputs["Coat Tint"].default_value) < 1:
        lose("colour", "Coat Tint", "is not carried over")
    if surface.inputs["Transmission Weight"].default_value > 0:
        _make_solid(tree)


def source(part: Any) -> Any:
    """The node that an input is linked to; None for an input that has a value."""
    while part.is_linked and part.links[0].from_node.type == "REROUTE":
        part = part.links[0].from_node.inputs[0]
    return part.links[0].from_node if part.is_linked else None


def _make_principled(tree: Any, node: Any, lose: Lose) -> Any:
    """The Principled BSDF that does what a shader does, as far as one can."""
    kind = node.type if node else ""
    if kind == "BSDF_PRINCIPLED":
        return node
    if kind in ("MIX_SHADER", "ADD_SHADER"):
        return _mix(tree, node, lose)
    if kind not in _SHADERS:
        lose("colour", node.bl_label, "became diffuse; bake it to images to keep it")
    takes, values = _SHADERS.get(kind, _SHADERS["BSDF_DIFFUSE"])
    made = tree.nodes.new("ShaderNodeBsdfPrincipled")
    for name, value in values.items():
        made.inputs[name].default_value = value
    for part in node.inputs if node else ():
        if part.name in takes:
            _give(part, made.inputs[takes[part.name]])
        elif kind in _SHADERS and (part.is_linked or (part.name in _SPECIAL and part.default_value > 0)):
            lose("colour", part.name, f"of {node.bl_label} is not carried over")
    if kind == "BSDF_TRANSPARENT":
        _say_tint(node, lose)
    return made


def _mix(tree: Any, node: Any, lose: Lose) -> Any:
    """One shader for two: opacity for one that is transparent, the light of one that emits; else the heavier."""
    pair = [source(part) for part in list(node.inputs)[-2:]]
    kinds = [part.type if part else "" for part in pair]
    adds, share = node.type == "ADD_SHADER", node.inputs[0]
    special = "EMISSION" if adds else "BSDF_TRANSPARENT"
    place = kinds.index(special) if special in kinds else -1
    if place < 0 or (place == 1 and not adds and share.is_linked):
        effect = "light" if "EMISSION" in kinds else "colour"
        lose(effect, node.bl_label, "only the heavier of its two shaders is carried over; bake it to images to keep it")
        heavier = 0 if adds or share.default_value <= 0.5 else 1
        return _make_principled(tree, pair[heavier], lose)
    made = _make_principled(tree, pair[1 - place], lose)
    if adds:
        if made.inputs["Emission Strength"].default_value > 0 or made.inputs["Emission Strength"].is_linked:
            lose("light", node.bl_label, "only one of its two lights is carried over")
        for name, ours in _LIGHT.items():
            _give(pair[place].inputs[name], made.inputs[ours])
    else:
        _say_tint(pair[place], lose)
        if made.inputs["Alpha"].default_value < 1 or made.inputs["Alpha"].is_linked:
            lose("colour", "Alpha", "of what is mixed with something transparent is not carried over")
        _give(share, made.inputs["Alpha"])
        made.inputs["Alpha"].default_value = abs(place - share.default_value)  # the share is that of the second shader
    return made


def _say_tint(transparent: Any, lose: Lose) -> None:
    if transparent.inputs["Color"].is_linked or min(transparent.inputs["Color"].default_value[:3]) < 1:
        lose("colour", transparent.bl_label, "lets all colours through")


def _find_unfit(part: Any) -> Any:
    """The node that an input is linked to, if the exporter would not write what it makes; else None."""
    node, name = source(part), part.name
    if node is None or node.type in ("RGB", "VALUE") or (node.type == "VERTEX_COLOR" and name == "Base Color"):
        return None
    image = part if name in (*_COLOURS, *_NUMBERS, "Alpha") else None
    if name == "Normal" and node.type == "NORMAL_MAP" and node.space == "TANGENT":
        image = node.inputs["Color"]
    elif name in _NUMBERS and node.type == "SEPARATE_COLOR":
        image = node.inputs[0]
    return None if image and _is_plain(image, "sRGB" if name in _COLOURS else "Non-Color") else node


def _is_plain(part: Any, space: str) -> bool:
    """Whether an input is linked to an image by texture coordinates, as glTF has them, of a colour space."""
    node = source(part)
    if node is None or node.type != "TEX_IMAGE" or not node.image or not min(node.image.size):
        return False
    place, image = source(node.inputs[0]), node.image
    if place is not None and place.type == "MAPPING" and not any(each.is_linked for each in place.inputs[1:]):
        place = source(place.inputs[0])
    of_uv = place is None or place.type == "UVMAP" or (place.type == "TEX_COORD" and place.outputs["UV"].is_linked)
    in_space = image.colorspace_settings.name == space or part.links[0].from_socket.name == "Alpha"
    fits = in_space and not image.is_float and image.source in ("FILE", "GENERATED")
    return bool(of_uv and fits and node.projection == "FLAT" and node.extension != "CLIP")


def _make_solid(tree: Any) -> None:
    """Say that glass is a solid, which it is for Cycles, by a node of the exporter's own."""
    node = tree.nodes.new("ShaderNodeGroup")
    node.node_tree = bpy.data.node_groups.new("glTF Material Output", "ShaderNodeTree")
    node.node_tree.interface.new_socket("Thickness", socket_type="NodeSocketFloat")
    node.inputs["Thickness"].default_value = 1.0


def _give(theirs: Any, ours: Any) -> None:
    """Give an input the value of another, and what it is linked to."""
    if theirs.type == ours.type:
        ours.default_value = theirs.default_value
    if theirs.is_linked:
        ours.id_data.links.new(theirs.links[0].from_socket, ours)
