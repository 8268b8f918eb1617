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
from pathlib import Path
from typing import Any, ClassVar

import bpy

sys.path.insert(0, str(Path(__file__).parent))

from blender_materials import prepare  # type: ignore[import-not-found]

_NO_MESHES = {"CURVES": "hair", "POINTCLOUD": "points", "VOLUME": "a volume", "GREASEPENCIL": "drawn lines"}
_RAYS = ("camera", "diffuse", "glossy", "transmission", "shadow")
_OF_LAMPS = ("normalize", "shadow_soft_size", "angle", "spot_size", "spot_blend", "shape", "size", "size_y", "spread")
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
    source, out = sys.argv[-2:]
    _open(source)
    scene = bpy.context.scene
    if scene.camera is None:
        scene.camera = bpy.data.objects.new("", bpy.data.cameras.new(""))
    seen = list(scene.camera.matrix_world.translation) if scene.camera.name in scene.objects else None
    _look(scene)
    _say_what_else(scene)
    if not Drawn.things:
        why = "; ".join(f"{name} {meaning} {place}" for _, name, meaning, place in said)
        sys.exit(f"fault: Blender draws no surface of it; {why or 'it has none'}")
    made: dict[str, Any] = {"camera": seen, "lamps": Drawn.lamps, "said": said}
    made |= {"sky": _sky(scene.world, str(Path(out).with_suffix(".exr"))), "owners": _replace_objects(scene)}
    known = bpy.ops.export_scene.gltf.get_rna_type().properties.keys()
    off = ("export_animations", "export_active_vertex_color_when_no_material", "export_all_vertex_colors")
    try:
        options = {"export_format": "GLB", "use_active_scene": True, **dict.fromkeys(off, False)}
        bpy.ops.export_scene.gltf(filepath=out, **{key: options[key] for key in options.keys() & known})
    except RuntimeError as error:
        sys.exit(f"fault: Blender reads it, but its exporter to glTF fails: {str(error).strip().splitlines()[-1]}")
    Path(out).with_suffix(".json").write_text(json.dumps(made), encoding="utf-8")


def _open(source: str) -> None:
    suffix = Path(source).suffix.lower()
    if suffix == ".blend":
        bpy.ops.wm.open_mainfile(filepath=source, load_ui=False, use_scripts=False)
        return
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if suffix == ".fbx":
        say(None, ".fbx", "has no unit for lights; they are as bright as Blender takes them to be")
        newer = hasattr(bpy.ops.wm, "fbx_import")
        (bpy.ops.wm.fbx_import if newer else bpy.ops.import_scene.fbx)(filepath=source)
    else:
        bpy.ops.wm.usd_import(filepath=source)


class Drawn(bpy.types.RenderEngine):
    """All that a render would draw, which Blender shows to engines alone: with the settings of renders."""

    bl_idname, bl_label = "PHOTONFARM", "photonfarm"
    meshes: ClassVar[dict[tuple[int, ...], Any]] = {}
    things: ClassVar[list[tuple[str, Any, Any, list[str]]]] = []  # name, mesh, matrix, names of what it hangs on
    lamps: ClassVar[list[dict[str, Any]]] = []

    def render(self, depsgraph: Any) -> None:
        """Collect what is drawn."""
        for instance in depsgraph.object_instances:
            drawn, kind = instance.object, instance.object.type
            if kind in _NO_MESHES:
                say("geometry", kind, f"is missing: {_NO_MESHES[kind]}", f"object {drawn.name!r}")
            if kind not in ("MESH", "LIGHT") or not instance.show_self:
                continue
            flags = [f"no {rays} rays" for rays in _RAYS if not getattr(drawn, f"visible_{rays}")]
            if kind == "MESH":
                flags += [name for name in ("is_holdout", "is_shadow_catcher") if getattr(drawn, name)]
            else:
                flags = [flag for flag in flags if "camera" not in flag]  # which see no lamps in any case
                linking = getattr(drawn, "light_linking", None)
                if linking and (linking.receiver_collection or linking.blocker_collection):
                    flags.append("light_linking")
                self.lamps.append(_lamp(drawn.data, drawn.name, [list(row) for row in instance.matrix_world]))
            for flag in flags:
                say("light" if kind == "LIGHT" else "geometry", flag, "is drawn as any other", f"object {drawn.name!r}")
            if kind == "MESH" and len(drawn.data.polygons):
                self._add(instance, drawn)

    def _add(self, instance: Any, drawn: Any) -> None:
        own = {k: each.material for k, each in enumerate(drawn.material_slots) if each.link == "OBJECT"}
        key = (drawn.data.as_pointer(), *(each.as_pointer() if each else 0 for each in own.values()))
        if key not in self.meshes:
            self.meshes[key] = drawn.data.copy()
            for number, material in own.items():
                self.meshes[key].materials[number] = material and material.original
        for system in () if instance.is_instance else drawn.particle_systems:
            if system.settings.type == "HAIR" and system.settings.render_type == "PATH":
                say("geometry", "HAIR", "is missing: particles", f"object {drawn.name!r}")
        above, names = instance.parent if instance.is_instance else drawn.parent, []
        while above is not None:
            names.append(above.name)
            above = above.parent
        self.things.append((drawn.name, self.meshes[key], instance.matrix_world.copy(), names))


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


def _lamp(data: Any, name: str, matrix: list[list[float]]) -> dict[str, Any]:
    """A lamp's own numbers, and in `strength` its energy, exposure, colour, temperature and nodes."""
    place = f"lamp {name!r}"
    if not data.use_shadow:
        say("light", "use_shadow", "it casts shadows as any other", place)
    power = data.energy * 2.0 ** getattr(data, "exposure", 0.0)
    tint = data.temperature_color if getattr(data, "use_temperature", False) else (1, 1, 1)
    factor = _of_nodes(data.node_tree, place) if data.use_nodes else (1, 1, 1)
    strength = [power * a * b * c for a, b, c in zip(data.color, tint, factor, strict=True)]
    kind = "PORTAL" if data.type == "AREA" and data.cycles.is_portal else data.type
    numbers = {key: getattr(data, key) for key in _OF_LAMPS if hasattr(data, key)}
    return {"name": name, "kind": kind, "matrix": matrix, "strength": strength, **numbers}


def _of_nodes(tree: Any, place: str) -> list[float]:
    """The colour that a lamp's nodes multiply its own by, without what varies."""
    output = tree.get_output_node("CYCLES") if tree else None
    shader = output.inputs["Surface"].links[0].from_node if output and output.inputs["Surface"].is_linked else None
    if shader is None:
        return [0.0, 0.0, 0.0]
    if shader.type != "EMISSION":
        say("light", shader.bl_label, "is not carried over", place)
        return [1.0, 1.0, 1.0]
    colour, strength = (_constant(shader.inputs[name], place) for name in ("Color", "Strength"))
    return [part * strength[0] for part in colour]


def _constant(part: Any, place: str) -> list[float]:
    """The value of an input as three numbers."""
    node = part.links[0].from_node if part.is_linked else None
    if node is not None and node.type in ("RGB", "VALUE"):
        part = node.outputs[0]
    elif node is not None and node.type == "BLACKBODY" and not node.inputs[0].is_linked and bpy.app.version >= (4, 5):
        lamp = bpy.data.lights.new("", "POINT")
        lamp.temperature = node.inputs[0].default_value
        return list(lamp.temperature_color)
    elif node is not None and node.type == "LIGHT_FALLOFF" and part.links[0].from_socket == node.outputs[0]:
        part = node.inputs["Strength"]
    elif node is not None:
        say("light", node.bl_label, f"{node.name!r} is not carried over", place)
    value = part.default_value
    return list(value)[:3] if part.type == "RGBA" else [value] * 3


def _sky(world: Any, file: str) -> list[float] | str | None:
    """The light of the world: a radiance, or a file with one per direction, as Cycles sees it; None if it is dark."""
    output = world.node_tree.get_output_node("CYCLES") if world and world.node_tree else None
    if output is None:
        return None
    place, links = f"world {world.name!r}", output.inputs["Surface"].links
    hidden = [rays for rays in _RAYS[:4] if not getattr(world.cycles_visibility, rays)]
    hidden += ["volume"] * output.inputs["Volume"].is_linked
    hidden += ["Light Path"] * any(node.type == "LIGHT_PATH" for node in world.node_tree.nodes)
    for name in hidden:
        say("light", name, "the world lights all as cameras see it", place)
    if not links:
        return None
    shader = links[0].from_node
    if shader.type == "BACKGROUND" and not any(part.is_linked for part in shader.inputs):
        values = [part * shader.inputs["Strength"].default_value for part in shader.inputs["Color"].default_value[:3]]
        return values if max(values) > 0 else None
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
        say(None, "exposure", f"{scene.view_settings.exposure:g} stops of the view are not part of the light")


def _replace_objects(scene: Any) -> dict[str, str]:
    """Put the meshes that are drawn in place of all objects; the owner of each, by names."""
    for each in list(bpy.data.objects):
        bpy.data.objects.remove(each)
    heads = Counter(name for *_, names in Drawn.things for name in names)
    owners = {}
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
        most = OBJECT_SHARE * len(Drawn.things)
        owners[made.name] = next((head for head in reversed(names) if heads[head] <= most), name)
    grey = bpy.data.materials.new("no material")  # what Cycles takes where there is none: diffuse
    grey.use_nodes = True
    shader = grey.node_tree.nodes.new("ShaderNodeBsdfDiffuse")
    shader.inputs["Color"].default_value = (0.8, 0.8, 0.8, 1.0)
    grey.node_tree.links.new(shader.outputs[0], grey.node_tree.get_output_node("CYCLES").inputs["Surface"])
    shown = set()
    for mesh in {each.data for each in scene.objects}:
        if not mesh.materials:
            mesh.materials.append(grey)
        for number in {min(face.material_index, len(mesh.materials) - 1) for face in mesh.polygons}:
            mesh.materials[number] = mesh.materials[number] or grey
            shown.add(mesh.materials[number])
    for material in shown:
        place = f"material {material.name!r}"
        prepare(material, lambda effect, name, meaning, place=place: say(effect, name, meaning, place))
    return owners


main()
