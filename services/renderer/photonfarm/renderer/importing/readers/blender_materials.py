"""Run by Blender's Python: materials as its exporter to glTF can write them, and what of them it cannot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

_DULL: dict[str, Any] = {"Roughness": 1.0, "Specular IOR Level": 0.0}
_BLACK = {**_DULL, "Base Color": (0, 0, 0, 1)}
_ROUGH = {"Color": "Base Color", "Base Color": "Base Color", "Roughness": "Roughness", "Normal": "Normal"}
_LIGHT = {"Color": "Emission Color", "Strength": "Emission Strength"}
_SHADERS: dict[str, tuple[dict[str, str], dict[str, Any]]] = {
    "BSDF_DIFFUSE": ({"Color": "Base Color", "Normal": "Normal"}, _DULL),
    **dict.fromkeys(("BSDF_GLOSSY", "BSDF_ANISOTROPIC", "BSDF_METALLIC"), (_ROUGH, {"Metallic": 1.0})),
    "BSDF_GLASS": ({**_ROUGH, "IOR": "IOR"}, {"Transmission Weight": 1.0}),
    "BSDF_TRANSPARENT": ({"Color": "Base Color"}, {**_DULL, "Alpha": 0.0}),
    "EMISSION": (_LIGHT, _BLACK),
    "": ({}, _BLACK),
}
"""The shaders that the Principled BSDF can stand for: which input becomes which of its own, and its other values."""

_OLD = {"Emission Color": "Emission", "Specular IOR Level": "Specular", "Transmission Weight": "Transmission"}
_NEUTRAL = ("Subsurface Weight", "Diffuse Roughness", "Thin Film Thickness")
_COLOURS, _NUMBERS, _MOST = ("Base Color", "Emission Color"), ("Roughness", "Metallic"), 4096


def prepare(material: Any, say: Callable[[str, str, str], None]) -> None:
    """Make the surface of a material one Principled BSDF of values and plain images; say what is lost by that."""
    material.use_backface_culling = False  # Cycles shows both sides whatever it says
    if not material.use_nodes:
        material.use_nodes = True
        _input(
            _source(material.node_tree.get_output_node("CYCLES").inputs[0]), "Base Color"
        ).default_value = material.diffuse_color
    tree = material.node_tree
    output = tree.get_output_node("CYCLES") or tree.nodes.new("ShaderNodeOutputMaterial")
    for name, effect in (("Volume", "colour"), ("Displacement", "geometry")):
        if _cut(output.inputs[name]):
            say(effect, name, "is not carried over")
    surface = _principled(tree, _source(output.inputs["Surface"]), say)
    if surface.id_data == tree:
        tree.links.new(surface.outputs[0], output.inputs["Surface"])
    for part in surface.inputs:
        if part.name in _NEUTRAL and (part.default_value > 0 or part.is_linked):
            say("colour", part.name, "is not carried over")
        node, end = _end(part)
        lost = _unfit(part)
        if (node is None or lost is not None) and _cut(part) and node is None:
            part.default_value = end.default_value  # of a group, which the exporter does not look for
        elif lost is not None:
            say("colour", lost.bl_label, f"{part.name} does not vary here; bake it to an image to keep it")
    if _input(surface, "Transmission Weight").default_value > 0:
        _make_solid(tree)


def _principled(tree: Any, node: Any, say: Callable[[str, str, str], None]) -> Any:
    """The Principled BSDF that does what a shader does, as far as one can."""
    kind = node.type if node else ""
    if kind == "BSDF_PRINCIPLED":
        return node
    if kind in ("MIX_SHADER", "ADD_SHADER") and node.id_data == tree:
        return _mixed(tree, node, say)
    if kind not in _SHADERS:
        say("colour", node.bl_label, "became diffuse")
    takes, values = _SHADERS.get(kind, _SHADERS["BSDF_DIFFUSE"])
    made = tree.nodes.new("ShaderNodeBsdfPrincipled")
    for name, value in values.items():
        _input(made, name).default_value = value
    for part in node.inputs if node else ():
        if part.name in takes:
            _give(part, _input(made, takes[part.name]))
    return made


def _mixed(tree: Any, node: Any, say: Callable[[str, str, str], None]) -> Any:
    """One shader for two: opacity for one that is transparent, the light of one that emits; else the heavier."""
    pair = [_source(part) for part in list(node.inputs)[-2:]]
    kinds = [part.type if part else "" for part in pair]
    adds, share = node.type == "ADD_SHADER", node.inputs[0]
    special = "EMISSION" if adds else "BSDF_TRANSPARENT"
    place = kinds.index(special) if special in kinds else -1
    if place >= 0 and (adds or place == 0 or not share.is_linked):
        made = _principled(tree, pair[1 - place], say)
        for name, ours in _LIGHT.items() if adds else ():
            _give(pair[place].inputs[name], _input(made, ours))
        if not adds:
            _give(share, made.inputs["Alpha"])
            made.inputs["Alpha"].default_value = abs(place - share.default_value)
        return made
    say("colour", node.bl_label, "only the heavier of its two shaders is carried over")
    return _principled(tree, pair[not adds and share.default_value > 0.5], say)


def _unfit(part: Any) -> Any:
    """The node that an input is linked to, if the exporter would not write what it makes; else None."""
    node, name = _source(part), part.name
    if node is None or node.type in ("RGB", "VALUE") or (node.type == "VERTEX_COLOR" and name == "Base Color"):
        return None
    kind = node.type
    if name == "Normal" and kind == "NORMAL_MAP" and node.space == "TANGENT":
        return _unfit(node.inputs["Color"])
    if kind == "MIX" and node.blend_type == "MULTIPLY" and name in _COLOURS and node.inputs[0].default_value == 1:
        factors = [part for part in node.inputs if part.type == "RGBA" and part.is_linked]
        return None if len(factors) == 1 and _is_plain(_source(factors[0]), "sRGB") else node
    if kind in ("SEPARATE_COLOR", "SEPRGB") and name in _NUMBERS:
        node = _source(node.inputs[0])
    fits = name in (*_COLOURS, *_NUMBERS, "Alpha", "Color")
    return None if fits and _is_plain(node, "sRGB" if name in _COLOURS else "Non-Color") else node


def _is_plain(node: Any, space: str) -> bool:
    """Whether a node is an image by texture coordinates, as glTF has them."""
    if node is None or node.type != "TEX_IMAGE" or not node.image or not min(node.image.size):
        return False
    place, image = _source(node.inputs[0]), node.image
    if place is not None and place.type == "MAPPING" and not any(part.is_linked for part in place.inputs[1:]):
        place = _source(place.inputs[0])
    of_uv = place is None or place.type == "UVMAP" or (place.type == "TEX_COORD" and place.outputs["UV"].is_linked)
    fits = image.colorspace_settings.name == space and not image.is_float and image.source in ("FILE", "GENERATED")
    return bool(of_uv and fits and node.projection == "FLAT" and node.extension != "CLIP")


def _make_solid(tree: Any) -> None:
    """Say that glass is a solid, which it is for Cycles, by a node of the exporter's own."""
    import bpy

    node = tree.nodes.new("ShaderNodeGroup")
    node.node_tree = bpy.data.node_groups.new("glTF Material Output", "ShaderNodeTree")
    node.node_tree.interface.new_socket("Thickness", socket_type="NodeSocketFloat")
    node.inputs["Thickness"].default_value = 1.0


_around: dict[Any, Any] = {}  # the group node whose tree, its own, this is


def _source(part: Any) -> Any:
    """The node that an input is linked to, also in a group or around it; None for an input that has a value."""
    return _end(part)[0]


def _end(part: Any) -> Any:
    """(The node that an input is linked to, the input next to it); None, and the input whose value it has."""
    while part.is_linked:
        origin = part.links[0].from_socket
        node = origin.node
        if node.type == "GROUP" and node.node_tree:
            if node.node_tree.users > 1:  # what is changed in it is changed for this one alone
                node.node_tree = node.node_tree.copy()
            _around[node.node_tree] = node
            end = next(each for each in node.node_tree.nodes if each.type == "GROUP_OUTPUT" and each.is_active_output)
            part = end.inputs[origin.name]
        elif node.type == "GROUP_INPUT" and node.id_data in _around:
            part = _around[node.id_data].inputs[origin.name]
        elif node.type == "REROUTE":
            part = node.inputs[0]
        else:
            return node, part
    return None, part


def _input(node: Any, name: str) -> Any:
    """An input of the Principled BSDF, some of whose names were others before Blender 4."""
    return node.inputs.get(name) or node.inputs[_OLD[name]]


def _give(theirs: Any, ours: Any) -> None:
    """Give an input the value of another, and what it is linked to."""
    if hasattr(theirs, "default_value"):
        ours.default_value = theirs.default_value
    if theirs.is_linked:
        ours.id_data.links.new(theirs.links[0].from_socket, ours)


def _cut(part: Any) -> bool:
    """Take away what an input is linked to; whether it was."""
    linked = bool(part.is_linked)
    if linked:
        part.id_data.links.remove(part.links[0])
    return linked
