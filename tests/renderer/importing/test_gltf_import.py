"""glTF as it is imported: names, places, extensions and lights as the specification has them."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from imported_scenes import FOUR, Loaded, Read, colour_at, losses

from photonfarm.core.errors import SpecError
from photonfarm.renderer.tools.importing import images

Quad = Callable[..., Path]

TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4"), np.array([[0, 1, 2]], "<u4")
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4"), np.array([[0, 1, 2], [0, 2, 3]], "<u4")


def put_lights(gltf: Any, *lights: dict[str, Any], **places: Any) -> None:
    """Add lights to a document, each at a node."""
    gltf.document["extensions"] = {"KHR_lights_punctual": {"lights": list(lights)}}
    for number in range(len(lights)):
        gltf.node(f"L{number}", extensions={"KHR_lights_punctual": {"light": number}}, **places)


def test_nodes_are_placed_by_all_above_them_and_mirrored_ones_keep_their_fronts(gltf: Any, loaded: Loaded) -> None:
    mesh = gltf.mesh(*SQUARE)
    gltf.document["meshes"][mesh]["primitives"] *= 2
    gltf.node("Leg", mesh, scale=[-1, 1, 1])
    gltf.node("Chair", rotation=[0, 0, 0.5**0.5, 0.5**0.5], translation=[5, 0, 0], children=[0])
    gltf.node("Other", mesh)
    gltf.document["scenes"][0]["nodes"] = [1, 2]
    scene, made = loaded(gltf.write())
    assert [shape.id() for shape in made.shapes()] == ["Leg_0", "Leg_1", "Other_0", "Other_1"]
    assert scene.objects["Leg_0"] == "Chair"
    box = made.shapes()[0].bbox()
    assert np.allclose([*box.min, *box.max], [4, -1, 0, 5, 0, 0], atol=1e-6)  # (x, y) → (−x, y) → (5 − y, −x)
    si = made.ray_intersect(mi.Ray3f(mi.Point3f(4.5, -0.5, 1), mi.Vector3f(0, 0, -1)))
    assert np.array(si.n)[2] == 1


def test_strips_and_fans_become_triangles(gltf: Any, loaded: Loaded) -> None:
    zigzag, around = ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    for mode, corners in ((5, zigzag), (6, around)):
        mesh = gltf.mesh(np.array(corners, "<f4"), np.arange(4, dtype="<u4"))
        gltf.document["meshes"][mesh]["primitives"][0]["mode"] = mode
        gltf.node(f"Mode{mode}", mesh)
    _, made = loaded(gltf.write())
    for shape in made.shapes():
        assert float(np.array(shape.surface_area())[0]) == pytest.approx(1)
    si = made.ray_intersect(mi.Ray3f(mi.Point3f([0.2, 0.8], [0.2, 0.8], 1), mi.Vector3f(0, 0, -1)))
    assert np.array(si.n)[2].tolist() == [1, 1]


def test_lights_stand_and_shine_where_the_file_says(gltf: Any, quad: Quad, loaded: Loaded) -> None:
    lights = [
        {"type": "point", "intensity": 3},
        {"type": "spot", "spot": {"outerConeAngle": 0.5}},
        {"type": "directional", "color": [1, 0, 0], "intensity": 2},
    ]
    put_lights(gltf, *lights, translation=[1, 2, 3])
    _, made = loaded(quad())
    kinds = [emitter.class_name() for emitter in made.emitters()]
    assert kinds == ["PointLight", "SpotLight", "DirectionalEmitter"]
    reference = mi.Interaction3f()
    reference.p = mi.Point3f(1, 2, 1)  # below the spot light, which shines along −z
    towards = [
        np.array(made.emitters()[i].sample_direction(reference, mi.Point2f(0.5))[0].d).ravel() for i in (0, 1, 2)
    ]
    for direction in towards:
        assert direction == pytest.approx([0, 0, 1], abs=1e-5)
    weight = np.array(made.emitters()[0].sample_direction(reference, mi.Point2f(0.5))[1]).ravel()
    assert weight == pytest.approx([0.75] * 3)  # 3 / 2²


def test_integers_that_are_normalised_are_read(gltf: Any, loaded: Loaded) -> None:
    gltf.document["extensionsRequired"] = ["KHR_mesh_quantization"]
    mesh = gltf.mesh(*SQUARE)
    position = gltf.array(np.array([[0, 0, 0, 0], [255, 0, 0, 0], [255, 255, 0, 0], [0, 255, 0, 0]], "|u1"), "VEC3")
    gltf.document["accessors"][position]["normalized"] = True
    gltf.document["bufferViews"][-1]["byteStride"] = 4
    gltf.document["meshes"][mesh]["primitives"][0]["attributes"]["POSITION"] = position
    gltf.node("Square", mesh)
    _, made = loaded(gltf.write())
    assert float(np.array(made.shapes()[0].surface_area())[0]) == pytest.approx(1)


def test_a_glb_is_the_same_scene(quad: Quad, read: Read, tmp_path: Path) -> None:
    from photonfarm.renderer.tools.importing.elements import text

    separate = text(read(quad()).root)
    document = json.loads((tmp_path / "room.gltf").read_text())
    del document["buffers"][0]["uri"]
    words = json.dumps(document).encode()
    words += b" " * (-len(words) % 4)
    binary = (tmp_path / "room.bin").read_bytes()
    chunks = struct.pack("<II", len(words), 0x4E4F534A) + words + struct.pack("<II", len(binary), 0x004E4942) + binary
    (tmp_path / "one.glb").write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    assert text(read(tmp_path / "one.glb").root) == separate


def test_skins_and_morph_targets_with_weights_are_losses_and_stand_as_modelled(gltf: Any, read: Read) -> None:
    mesh = gltf.mesh(*TRIANGLE)
    target = {"POSITION": gltf.array(np.array([[0, 0, 0], [2, 0, 0], [0, 0, 0]], "<f4"), "VEC3")}
    gltf.document["meshes"][mesh]["primitives"][0]["targets"] = [target, {}]
    gltf.node("AtRest", mesh, weights=[0, 0])
    assert losses(read(gltf.write())) == []
    gltf.node("Bent", mesh, weights=[0.5, 0])
    gltf.node("Skinned", mesh, skin=0, translation=[0, 0, 2])
    gltf.document["skins"] = [{"joints": [0]}]
    scene = read(gltf.write())
    assert losses(scene) == [("geometry", "weights"), ("geometry", "skin")]
    assert scene.meshes["Skinned"].vertices.tolist() == [[0, 0, 2], [1, 0, 2], [0, 1, 2]]


def test_nodes_that_are_not_visible_are_not_there_with_all_below_them(gltf: Any, read: Read) -> None:
    lamp = {"KHR_lights_punctual": {"light": 0}}
    gltf.document["extensions"] = {"KHR_lights_punctual": {"lights": [{"type": "point"}]}}
    gltf.node("Below", gltf.mesh(*TRIANGLE), extensions=lamp)
    gltf.node("Hidden", extensions={"KHR_node_visibility": {"visible": False}}, children=[0])
    gltf.node("Shown", 0)
    gltf.document["scenes"][0]["nodes"] = [1, 2]
    scene = read(gltf.write())
    assert list(scene.meshes) == ["Shown"]
    assert scene.root.find("emitter") is None


def test_points_and_lines_are_losses_of_geometry(gltf: Any, read: Read) -> None:
    for mode in (0, 1, 4):
        gltf.document["meshes"][gltf.mesh(*TRIANGLE)]["primitives"][0]["mode"] = mode
        gltf.node(f"Mode{mode}", mode if mode < 2 else 2)
    scene = read(gltf.write())
    assert losses(scene) == [("geometry", "POINTS"), ("geometry", "LINES")]
    assert list(scene.meshes) == ["Mode4"]


@pytest.mark.parametrize(("inner", "outer"), [(0, np.pi / 4), (0.3, 0.31), (0, np.pi / 2)])
def test_spots_fade_as_the_extension_recommends(
    gltf: Any, quad: Quad, loaded: Loaded, inner: float, outer: float
) -> None:
    spot = {"type": "spot", "intensity": 3, "spot": {"innerConeAngle": inner, "outerConeAngle": outer}}
    put_lights(gltf, spot)
    scene, made = loaded(quad())
    angles = np.linspace(0, 0.99 * outer, 50)
    reference = mi.Interaction3f()
    reference.p = mi.Point3f(np.sin(angles) * 0.6, np.sin(angles) * 0.8, -np.cos(angles))
    lit = np.array(made.emitters()[0].sample_direction(reference, mi.Point2f(0.5))[1])[0]
    fade = (np.cos(angles) - np.cos(outer)) / (np.cos(inner) - np.cos(outer))
    assert np.abs(lit - 3 * fade.clip(0, 1) ** 2).max() < 0.02 * 3
    assert losses(scene) == []


@pytest.mark.parametrize(
    ("light", "lost"),
    [({"color": [-1, 1, 1]}, "intensity"), ({"type": "spot", "spot": {"outerConeAngle": 0}}, "outerConeAngle")],
)
def test_lights_that_no_light_can_be_are_losses(gltf: Any, quad: Quad, read: Read, light: Any, lost: str) -> None:
    put_lights(gltf, {"type": "point"} | light)
    assert losses(read(quad())) == [("light", lost)]


def test_the_units_of_blenders_lamps_are_said(gltf: Any, quad: Quad, read: Read) -> None:
    gltf.document["asset"]["generator"] = "Khronos glTF Blender I/O v5.0.21"
    assert not [change for change in read(quad()).changes if "683" in str(change)]
    gltf.document["extensions"] = {"KHR_lights_punctual": {"lights": [{"type": "point"}]}}
    (said,) = [change for change in read(gltf.write()).changes if "683" in str(change)]
    assert (said.effect, said.name) == (None, "KHR_lights_punctual")


def test_what_has_no_effect_on_a_still_picture_is_no_loss(gltf: Any, quad: Quad, read: Read) -> None:
    gltf.document |= {"animations": [{}, {}], "extensionsUsed": ["EXT_unused"]}
    gltf.document["extensionsRequired"] = ["KHR_materials_variants"]
    neutral: dict[str, Any] = {"KHR_xmp_json_ld": {}, "KHR_materials_specular": {}, "KHR_materials_sheen": {}}
    neutral |= {
        "KHR_materials_clearcoat": {"clearcoatFactor": 0},
        "KHR_materials_anisotropy": {"anisotropyStrength": 0},
    }
    changes = list(read(quad(extensions=neutral, occlusionTexture={"index": 0})).changes)
    assert {change.effect for change in changes} == {None}
    assert {change.name for change in changes} == {"animations", "KHR_xmp_json_ld", "occlusionTexture"}


def test_extensions_that_are_not_read_are_named_by_what_they_sit_on(gltf: Any, quad: Quad, read: Read) -> None:
    put_lights(gltf, {"type": "point", "extensions": {"EXT_of_light": {}}}, {"type": "area"})
    path = quad(extensions={"KHR_materials_unlit": {}, "KHR_materials_sheen": {"sheenColorFactor": [0, 0, 0.1]}})
    document = json.loads(path.read_text())
    document["scenes"][0]["extensions"] = {"EXT_lights_image_based": {}}
    document["nodes"][-1]["extensions"] = {"EXT_of_node": {}}
    document["meshes"][0]["primitives"][0]["extensions"] = {"EXT_of_primitive": {}}
    document["meshes"].append({"primitives": [], "extensions": {"EXT_of_nothing": {}}})
    path.write_text(json.dumps(document))
    assert set(losses(read(path))) == {
        ("light", "EXT_lights_image_based"),
        ("light", "EXT_of_light"),
        ("light", "area"),
        ("geometry", "EXT_of_node"),
        ("geometry", "EXT_of_primitive"),
        ("colour", "KHR_materials_unlit"),
        ("colour", "KHR_materials_sheen"),
    }


def test_extensions_of_images_and_numbers_are_named_where_they_are_used(gltf: Any, quad: Quad, read: Read) -> None:
    quad(pbrMetallicRoughness={"baseColorTexture": gltf.image(FOUR, "four.png")})
    gltf.document["samplers"], gltf.document["textures"][0]["sampler"] = [{}], 0
    for kind in ("textures", "samplers", "images", "accessors", "bufferViews"):
        gltf.document[kind][0]["extensions"] = {f"EXT_{kind}": {}}
    gltf.document["images"].append({"uri": "unused.png", "extensions": {"EXT_unused": {}}})
    colours, others = ("images", "samplers", "textures"), ("accessors", "bufferViews")
    wanted = {("colour", f"EXT_{kind}") for kind in colours} | {("geometry", f"EXT_{kind}") for kind in others}
    assert set(losses(read(gltf.write()))) == wanted


@pytest.mark.parametrize("fallback", [True, False])
def test_what_is_compressed_is_read_only_where_it_has_its_data_beside_it(gltf: Any, read: Read, fallback: bool) -> None:
    primitive = gltf.document["meshes"][gltf.mesh(*TRIANGLE)]["primitives"][0]
    primitive["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {}}}
    gltf.node("It", 0)
    if fallback:
        assert losses(read(gltf.write())) == []
        return
    del gltf.document["accessors"][primitive["attributes"]["POSITION"]]["bufferView"]
    with pytest.raises(SpecError, match="KHR_draco_mesh_compression"):
        read(gltf.write())


def test_a_lamp_that_is_seen_from_both_sides_shines_from_both(case: Callable[[str], Path], loaded: Loaded) -> None:
    _, scene = loaded(case("gltf-lamp-facing-up/scene.gltf"))
    for origin, direction in (([2, 2, 1.5], [0, 1, 0]), ([2, 2.45, 1.5], [0, -1, 0])):
        si = scene.ray_intersect(mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction)))
        assert np.array(si.emitter(scene).eval(si)).ravel() == pytest.approx([10] * 3)


def test_instances_stand_where_they_are(case: Callable[[str], Path], loaded: Loaded) -> None:
    scene, made = loaded(case("gltf-gpu-instancing/inst.glb"))
    assert sum(float(np.array(shape.surface_area())[0]) for shape in made.shapes()) == pytest.approx(70.96, rel=1e-3)
    x, z = mi.Float([0.5, 3.4, 0.5, 3.4]), mi.Float([0.5, 0.5, 2.5, 2.5])
    si = made.ray_intersect(mi.Ray3f(mi.Point3f(x, 2.4, z), mi.Vector3f(0, -1, 0)))
    assert np.array(si.p)[1] == pytest.approx([0.9] * 4)
    assert losses(scene) == []


def test_meshes_that_are_compressed_are_refused_by_name(case: Callable[[str], Path], read: Read) -> None:
    with pytest.raises(SpecError, match="KHR_meshopt_compression"):
        read(case("gltf-khr-meshopt/textured-khr.glb"))
    assert losses(read(case("gltf-khr-meshopt/textured-plain.glb"))) == []


def test_normal_maps_keep_their_upper_side_where_images_are_mirrored(
    case: Callable[[str], Path], loaded: Loaded
) -> None:
    _, scene = loaded(case("gltf-mirrored-uv-normal-map/scene.gltf"))
    for x in (0.5, 2.5, 4.5):
        si = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, 0.5, 5), mi.Vector3f(0, 0, -1)))
        for y, value in ((0.5**0.5, 0.2515), (-(0.5**0.5), 0)):
            lit = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(mi.Vector3f(0, y, 0.5**0.5)))
            assert np.array(lit).ravel()[0] == pytest.approx(value, abs=3e-3)


@pytest.mark.parametrize(("tangent", "lost"), [([1, 0, 0, 1], []), ([0, 1, 0, 1], [("colour", "TANGENT")])])
def test_tangents_that_are_turned_against_the_texture_are_said(
    gltf: Any, quad: Quad, read: Read, tangent: list[float], lost: Any
) -> None:
    quad(normalTexture=gltf.image(FOUR, "four.png"))
    attributes = gltf.document["meshes"][0]["primitives"][0]["attributes"]
    attributes["TANGENT"] = gltf.array(np.tile(np.array([tangent], "<f4"), (4, 1)), "VEC4")
    assert losses(read(gltf.write())) == lost


def test_grey_of_16_bits_has_its_value(case: Callable[[str], Path], loaded: Loaded) -> None:
    made, scene = loaded(case("gltf-16-bit-grey/scene.gltf"))
    assert colour_at(scene, 0.5, 0.5) == pytest.approx([0.214] * 3, abs=0.01)
    (roughness,) = (node for node in made.root.iter("texture") if node.get("name") == "roughness")
    file = next(node.get("value", "") for node in roughness if node.get("name") == "filename")
    assert images.decode(Path(file).read_bytes(), "it")[0, 0, 0] == pytest.approx(0.5, abs=0.01)


def test_images_wrap_differently_along_both_axes(case: Callable[[str], Path], loaded: Loaded) -> None:
    _, scene = loaded(case("gltf-wrap/scene.gltf"))
    blue, white, green, red = [0, 0, 1], [1, 1, 1], [0, 1, 0], [1, 0, 0]
    places = (0.1, 0.9), (0.9, 0.9), (0.9, 0.1), (2.1, 0.9), (2.9, 0.9), (2.1, 0.1)
    assert [colour_at(scene, *place) for place in places] == [blue, white, green, green, red, white]


def test_images_that_are_not_there_leave_their_factors(gltf: Any, quad: Quad, loaded: Loaded, tmp_path: Path) -> None:
    surface = {"baseColorTexture": gltf.image(FOUR, "four.png"), "baseColorFactor": [0.5, 0.25, 0.75, 1]}
    path = quad(pbrMetallicRoughness=surface)
    (tmp_path / "four.png").unlink()
    scene, made = loaded(path)
    assert colour_at(made, 0.5, 0.5) == pytest.approx([0.5, 0.25, 0.75])
    assert losses(scene) == [("colour", "images")]
