"""Run by Blender's Python, not by ours: opens a .blend, USD or FBX file and writes what Blender would render.

    python blender_export.py IN OUT        with the wheel `bpy`
    blender --background --factory-startup --python blender_export.py -- IN OUT

Surfaces go into OUT, a GLB; lamps, the sky and all that is to be said into a JSON file beside it. Blender's own
exporter changes lamps and leaves out what is no mesh: lamps go round it, and all that is drawn is made meshes before.
"""

from __future__ import annotations

import json
import math
import sys
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import bpy

sys.path.insert(0, str(Path(__file__).parent))

from blender_materials import DULL, prepare, source  # type: ignore[import-not-found]

OLDEST = (4, 5)
"""The first Blender whose lamps have an exposure, a temperature and `normalize`."""

_NO_MESHES = ("CURVES", "HAIR", "POINTCLOUD", "VOLUME", "GREASEPENCIL")
_RAYS = dict.fromkeys(("camera", "diffuse", "glossy", "transmission"), True)
_LIT = dict.fromkeys(("visible_diffuse", "visible_glossy", "visible_transmission", "visible_shadow"), True)
_SEEN = {"visible_camera": True, **_LIT, "is_holdout": False, "is_shadow_catcher": False}
"""Flags of worlds, lamps and surfaces, as all rays take them here."""

_OF_LAMPS = ("normalize", "shadow_soft_size", "angle", "spot_size", "spot_blend", "shape", "size", "size_y", "spread")

_MIXES = (("RGBA", "MIX"), ("RGBA", "MULTIPLY"), ("FLOAT", "MIX"))
"""The types of mix nodes of lamps whose values are known."""

SKY = (2048, 1024)
"""The size of an image of the sky; the sun of a sky is three of its pixels across."""

OBJECT_SHARE = 0.34
"""An object that others hang on is their owner up to this share of all meshes; above, it is a folder of objects."""

said: list[tuple[str | None, str, str, str]] = []


def say(effect: str | None, name: str, meaning: str, place: str = "") -> None:
    """Say what of the picture differs: its geometry, light or colour; None: nothing of it."""
    said.append((effect, name, meaning, place))


def main() -> None:
    """Open, look, mend and write."""
    if bpy.app.version < OLDEST:
        sys.exit(f"fault: Blender {bpy.app.version_string} is too old; {'.'.join(map(str, OLDEST))} or newer is needed")
    file, out = sys.argv[-2:]
    _open(file)
    scene = bpy.context.scene
    scene.camera = scene.camera or next((each for each in scene.objects if each.type == "CAMERA"), None)
    seen = list(scene.camera.matrix_world.translation) if scene.camera else None
    scene.camera = scene.camera or bpy.data.objects.new("", bpy.data.cameras.new(""))
    _look(scene)
    _say_what_else(scene)
    if not Drawn.things:
        why = "; ".join(f"{name} {meaning} {place}" for _, name, meaning, place in said)
        sys.exit(f"fault: Blender draws no surface of it; {why or 'it has none'}")
    made: dict[str, Any] = {"camera": seen, "lamps": Drawn.lamps, "said": said}
    made |= {"sky": _sky(scene.world, str(Path(out).with_suffix(".exr"))), "owners": _replace_objects(scene)}
    _prepare_materials(scene)
    off = ("export_animations", "export_active_vertex_color_when_no_material", "export_all_vertex_colors")
    try:
        bpy.ops.export_scene.gltf(filepath=out, export_format="GLB", use_active_scene=True, **dict.fromkeys(off, False))
    except RuntimeError as error:
        sys.exit(f"fault: Blender reads it, but its exporter to glTF fails: {str(error).strip().splitlines()[-1]}")
    Path(out).with_suffix(".json").write_text(json.dumps(made), encoding="utf-8")


def _open(file: str) -> None:
    suffix = Path(file).suffix.lower()
    try:
        if suffix == ".blend":
            bpy.ops.wm.open_mainfile(filepath=file, load_ui=False, use_scripts=False)
            return
        bpy.ops.wm.read_factory_settings(use_empty=True)
        if suffix == ".fbx":
            say(None, ".fbx", "has no sky and no unit for lights; those that are areas become points in Blender")
            bpy.ops.wm.fbx_import(filepath=file)
            return
        say(None, suffix, "lights that are cylinders, meshes or portals become points in Blender")
        world = bpy.context.scene.world = bpy.data.worlds.new("World")  # which its sky goes into
        world.use_nodes = True
        source(world.node_tree.get_output_node("CYCLES").inputs["Surface"]).inputs["Color"].default_value = (0, 0, 0, 1)
        bpy.ops.wm.usd_import(filepath=file, merge_parent_xform=False)
        held = Counter(each.parent for each in bpy.data.objects)
        alone = [each for each in bpy.data.objects if each.type != "EMPTY" and each.parent and held[each.parent] == 1]
        Drawn.names = {each.name: each.parent.name.partition(".")[0] for each in alone}  # Blender's dots number copies
    except RuntimeError as error:
        why = str(error).splitlines()[0].removeprefix("Error: ").replace(file, Path(file).name)
        sys.exit(f"fault: is no {suffix} file that Blender {bpy.app.version_string} reads: {why}")


class Drawn(bpy.types.RenderEngine):
    """All that a render would draw, which Blender shows to engines alone: with the settings of renders."""

    bl_idname, bl_label = "PHOTONFARM", "photonfarm"
    meshes: ClassVar[dict[tuple[int, ...], Any]] = {}
    things: ClassVar[list[tuple[str, Any, Any, list[str]]]] = []  # name, mesh, matrix, names of what it hangs on
    lamps: ClassVar[list[dict[str, Any]]] = []
    names: ClassVar[dict[str, str]] = {}  # of objects that are named after what they alone hang on

    def render(self, depsgraph: Any) -> None:
        """Collect what is drawn."""
        for instance in depsgraph.object_instances:
            drawn, kind = instance.object, instance.object.type
            strands = {"HAIR" for system in drawn.particle_systems if system.settings.render_type == "PATH"}
            for missing in ({kind} | strands) & set(_NO_MESHES):
                say("geometry", missing, "is no mesh, and is missing", f"object {drawn.name!r}")
            if kind == "LIGHT" and instance.show_self and not drawn.data.cycles.is_portal:
                self.lamps.append(_lamp(drawn, [list(row) for row in instance.matrix_world]))
            elif kind == "MESH" and instance.show_self and len(drawn.data.polygons):
                self._add(instance, drawn)

    def _add(self, instance: Any, drawn: Any) -> None:
        _say_flags(drawn, _SEEN, "geometry", f"object {drawn.name!r}")
        own = {k: each.material for k, each in enumerate(drawn.material_slots) if each.link == "OBJECT"}
        key = (drawn.data.as_pointer(), *(each.as_pointer() if each else 0 for each in own.values()))
        if key not in self.meshes:
            self.meshes[key] = drawn.data.copy()
            for number, material in own.items():
                self.meshes[key].materials[number] = material and material.original
        above, names = instance.parent if instance.is_instance else drawn.parent, []
        while above is not None:
            names.append(above.name)
            above = above.parent
        name = self.names.get(drawn.name, drawn.name)
        self.things.append((name, self.meshes[key], instance.matrix_world.copy(), names))


def _say_flags(holder: Any, usual: dict[str, bool], effect: str, place: str) -> None:
    for name, value in usual.items():
        if getattr(holder, name) != value:
            say(effect, name, f"is {not value}, which has no effect here", place)


def _look(scene: Any) -> None:
    """Let Blender render the first view layer by an engine that only looks."""
    layers = [layer for layer in scene.view_layers if layer.use] or list(scene.view_layers)
    if len(layers) > 1:
        say("geometry", "view layers", f"only {layers[0].name!r} is read", f"of {len(layers)}")
    if layers[0].material_override:
        say("colour", "material_override", "objects have their own materials", f"view layer {layers[0].name!r}")
    for layer in scene.view_layers:
        layer.use = layer == layers[0]
    bpy.utils.register_class(Drawn)
    scene.render.engine = Drawn.bl_idname
    scene.render.use_compositing = scene.render.use_sequencer = scene.render.use_freestyle = False
    bpy.ops.render.render()


def _lamp(drawn: Any, matrix: list[list[float]]) -> dict[str, Any]:
    """A lamp's own numbers, and in `strength` its energy, exposure, colour, temperature and nodes."""
    data, linking, name = drawn.data, drawn.light_linking, Drawn.names.get(drawn.name, drawn.name)
    place = f"lamp {name!r}"
    _say_flags(drawn, _LIT, "light", place)  # cameras see no lamps in any case
    _say_flags(data, {"use_shadow": True}, "light", place)
    if linking.receiver_collection or linking.blocker_collection:
        say("light", "light_linking", "it lights all", place)
    power = data.energy * 2.0**data.exposure
    tint = data.temperature_color if data.use_temperature else (1, 1, 1)
    factor = _colour_of_nodes(data.node_tree, place) if data.use_nodes else (1, 1, 1)
    strength = [power * a * b * c for a, b, c in zip(data.color, tint, factor, strict=True)]
    numbers = {key: getattr(data, key) for key in _OF_LAMPS if hasattr(data, key)}
    return {"name": name, "kind": data.type, "matrix": matrix, "strength": strength, **numbers}


def _colour_of_nodes(tree: Any, place: str) -> list[float]:
    """The colour that a lamp's nodes multiply its own by, without what varies."""
    output = tree.get_output_node("CYCLES") if tree else None
    return _emission(source(output.inputs["Surface"]), place) if output else [0.0, 0.0, 0.0]


def _emission(shader: Any, place: str) -> list[float]:
    """What a shader of a lamp emits, or several that are added or mixed."""
    kind = shader.type if shader else ""
    if kind == "EMISSION":
        colour, strength = (_constant(shader.inputs[name], place) for name in ("Color", "Strength"))
        return [part * strength[0] for part in colour]
    if kind in ("ADD_SHADER", "MIX_SHADER"):
        one, other = (_emission(source(part), place) for part in list(shader.inputs)[-2:])
        share = _constant(shader.inputs[0], place)[0] if kind == "MIX_SHADER" else 0.5
        scale = 1 if kind == "MIX_SHADER" else 2  # a sum is twice an even mix
        return [scale * ((1 - share) * a + share * b) for a, b in zip(one, other, strict=True)]
    if shader is not None:
        say("light", shader.bl_label, "is not carried over", place)
        return [1.0, 1.0, 1.0]
    return [0.0, 0.0, 0.0]


def _constant(part: Any, place: str) -> list[float]:
    """The value of an input as three numbers; that of two which are mixed or multiplied, too."""
    node = source(part)
    kind = node.type if node else ""
    if kind == "BLACKBODY" and not node.inputs[0].is_linked:
        lamp = bpy.data.lights.new("", "POINT")
        lamp.temperature = node.inputs[0].default_value
        return list(lamp.temperature_color)
    if kind == "MIX" and (node.data_type, node.blend_type) in _MIXES:
        share, one, other = (_constant(each, place) for each in node.inputs if each.enabled)
        if node.blend_type == "MULTIPLY":
            other = [a * b for a, b in zip(one, other, strict=True)]
        return [a + share[0] * (b - a) for a, b in zip(one, other, strict=True)]
    if kind in ("RGB", "VALUE"):
        part = node.outputs[0]
    elif kind == "LIGHT_FALLOFF" and part.links[0].from_socket == node.outputs[0]:
        part = node.inputs["Strength"]
    elif node is not None:
        say("light", node.bl_label, f"{node.name!r} is not carried over", place)
    value = part.default_value
    return list(value)[:3] if part.type == "RGBA" else [value] * 3


def _sky(world: Any, file: str) -> list[float] | str:
    """The light of the world: a radiance, or a file with one per direction, as Cycles sees it."""
    if world and not world.use_nodes:
        return list(world.color)
    output = world.node_tree.get_output_node("CYCLES") if world and world.node_tree else None
    if output is None:
        return [0.0, 0.0, 0.0]
    place, shader = f"world {world.name!r}", source(output.inputs["Surface"])
    _say_flags(world.cycles_visibility, _RAYS, "light", place)
    if output.inputs["Volume"].is_linked:
        say("light", "Volume", "is not carried over", place)
    if any(node.type == "LIGHT_PATH" for node in world.node_tree.nodes):
        say("light", "Light Path", "the world lights all as cameras see it", place)
    if shader is None:
        return [0.0, 0.0, 0.0]
    if shader.type == "BACKGROUND" and not any(part.is_linked for part in shader.inputs):
        return [part * shader.inputs["Strength"].default_value for part in shader.inputs["Color"].default_value[:3]]
    _photograph(world, file)
    say(None, "world", f"its light is an image of {SKY[0]} × {SKY[1]} directions, as Cycles has it", place)
    return file


def _photograph(world: Any, file: str) -> None:
    """Write the radiance of all directions, +y in the middle and +z above, in a scene whose settings are its own."""
    scene, camera = bpy.data.scenes.new("sky"), bpy.data.cameras.new("sky")
    scene.camera = bpy.data.objects.new("sky", camera)
    scene.collection.objects.link(scene.camera)
    scene.world, scene.camera.rotation_euler, camera.type = world, (math.pi / 2, 0, 0), "PANO"
    (camera if hasattr(camera, "panorama_type") else camera.cycles).panorama_type = "EQUIRECTANGULAR"
    scene.render.engine, scene.cycles.device, scene.cycles.samples = "CYCLES", "CPU", 16
    scene.cycles.use_adaptive_sampling = scene.cycles.use_denoising = False
    (scene.render.resolution_x, scene.render.resolution_y), scene.render.filepath = SKY, file
    settings = scene.render.image_settings
    settings.file_format, settings.color_mode, settings.color_depth = "OPEN_EXR", "RGB", "32"
    bpy.ops.render.render(write_still=True, scene=scene.name)
    bpy.data.scenes.remove(scene)


def _say_what_else(scene: Any) -> None:
    for library in bpy.data.libraries:
        if not Path(bpy.path.abspath(library.filepath)).exists():
            say("geometry", "library", "is not there, nor what is in it", library.filepath)
    if len(bpy.data.scenes) > 1:
        say(None, "scenes", f"{scene.name!r} is read, of {len(bpy.data.scenes)}")
    if bpy.data.actions:
        say(None, "", f"the scene moves; it is read as in frame {scene.frame_current}")
    if abs(scene.unit_settings.scale_length - 1) > 1e-6:
        say(None, "scale_length", f"a unit is {scene.unit_settings.scale_length:g} m; lengths stay in Blender's units")
    if scene.view_settings.exposure:
        stops = scene.view_settings.exposure
        say(None, "", f"the view's exposure of {stops:+g} stops is left out; photonfarm sets its own")


def _replace_objects(scene: Any) -> dict[str, str]:
    """Put the meshes that are drawn in place of all objects; the owner of each, by names."""
    for each in list(bpy.data.objects):
        bpy.data.objects.remove(each)
    heads = Counter(name for *_, names in Drawn.things for name in names)
    owners, most = {}, OBJECT_SHARE * len(Drawn.things)
    for name, mesh, matrix, names in Drawn.things:
        x, y, z = (column.normalized() for column in matrix.to_3x3().transposed())
        if max(abs(x.dot(y)), abs(y.dot(z)), abs(x.dot(z))) > 1e-5:  # glTF has no shear
            mesh = mesh.copy()
            mesh.transform(matrix)
            if matrix.determinant() < 0:
                mesh.flip_normals()
            matrix.identity()
        made = bpy.data.objects.new(name, mesh)
        made.matrix_basis = matrix
        scene.collection.objects.link(made)
        owners[made.name] = next((head for head in reversed(names) if heads[head] <= most), name)
    return owners


def _prepare_materials(scene: Any) -> None:
    """Make all materials that are drawn such as the exporter can write; Cycles takes a diffuse grey for none."""
    grey = bpy.data.materials.new("no material")
    grey.use_nodes = True
    shader = source(grey.node_tree.get_output_node("CYCLES").inputs["Surface"])
    for name, value in {**DULL, "Base Color": (0.8, 0.8, 0.8, 1)}.items():
        shader.inputs[name].default_value = value
    shown = set()
    for mesh in {each.data for each in scene.objects}:
        if not mesh.materials:
            mesh.materials.append(grey)
        for number in {min(face.material_index, len(mesh.materials) - 1) for face in mesh.polygons}:
            mesh.materials[number] = mesh.materials[number] or grey
            shown.add(mesh.materials[number])
    for material in shown:
        prepare(material, partial(say, place=f"material {material.name!r}"))


main()
