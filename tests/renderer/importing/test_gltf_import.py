"""glTF as it is imported: names, places, materials and lights as the specification has them."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import mitsuba as mi
import numpy as np
import pytest

from photonfarm.renderer.importing.elements import child
from photonfarm.renderer.importing.imported import ImportedScene
from photonfarm.renderer.importing.readers import images
from photonfarm.shared.core.errors import SpecError

Read = Callable[[Path], ImportedScene]
Loaded = Callable[[Path], tuple[ImportedScene, Any]]

FOUR = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]])
"""Red and green above blue and white."""


def colour_at(scene: Any, x: float, y: float) -> list[float]:
    """The diffuse reflectance of the unit square."""
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, y, 1), mi.Vector3f(0, 0, -1)))
    return [round(float(part), 2) for part in np.array(si.bsdf().eval_diffuse_reflectance(si)).ravel()]


def of_type(root: Element, kind: str) -> Element:
    return next(node for node in root.iter() if node.get("type") == kind)


# ------------------------------------------------------------------------------------------------------- materials


@pytest.mark.parametrize(
    ("transform", "top_left", "top_right"),
    [
        ({}, [1, 0, 0], [0, 1, 0]),
        ({"offset": [0.5, 0]}, [0, 1, 0], [1, 0, 0]),
        ({"offset": [0, 0.5]}, [0, 0, 1], [1, 1, 1]),
        ({"rotation": np.pi / 2}, [0, 0, 1], [1, 0, 0]),  # (u, v) → (v, −u)
        ({"scale": [-1, 1]}, [0, 1, 0], [1, 0, 0]),
    ],
)
def test_images_lie_on_surfaces_as_their_transforms_say(
    gltf: Any, quad: Callable[..., Path], loaded: Loaded, transform: Any, top_left: Any, top_right: Any
) -> None:
    found = gltf.image(FOUR, "four.png") | {"extensions": {"KHR_texture_transform": transform}}
    _, scene = loaded(quad(pbrMetallicRoughness={"baseColorTexture": found, "metallicFactor": 0}))
    assert colour_at(scene, 0.25, 0.75) == top_left
    assert colour_at(scene, 0.75, 0.75) == top_right


def test_roughness_is_the_green_channel_and_metallic_the_blue_one_raw_and_times_their_factors(
    gltf: Any, quad: Callable[..., Path], read: Read
) -> None:
    pixels = np.full((2, 2, 3), (9, 100, 200))
    surface = {"metallicRoughnessTexture": gltf.image(pixels, "mr.png"), "roughnessFactor": 0.5, "metallicFactor": 1}
    principled = of_type(read(quad(pbrMetallicRoughness=surface)).root, "principled")
    for name, value in (("roughness", 50), ("metallic", 200)):
        texture = child(principled, name)
        assert texture is not None
        raw, file = child(texture, "raw"), child(texture, "filename")
        assert raw is not None
        assert file is not None
        assert raw.get("value") == "true"
        stored = images.decoded(Path(file.get("value", "")).read_bytes(), "it")[0, 0, 0]
        assert stored * 255 == pytest.approx(value, abs=0.6)


def test_colours_are_multiplied_in_linear_light(gltf: Any, quad: Callable[..., Path], loaded: Loaded) -> None:
    surface = {"baseColorTexture": gltf.image(FOUR, "four.png"), "baseColorFactor": [0.5, 1, 0.25, 1]}
    _, scene = loaded(quad(pbrMetallicRoughness=surface | {"metallicFactor": 0}))
    assert colour_at(scene, 0.75, 0.25) == pytest.approx([0.5, 1, 0.25], abs=0.01)


def test_green_of_a_normal_map_tilts_upwards_in_the_image(
    gltf: Any, quad: Callable[..., Path], loaded: Loaded
) -> None:  # fmt: skip
    tilted = gltf.image(np.full((2, 2, 3), (128, 218, 218)), "normal.png")
    _, scene = loaded(quad(normalTexture=tilted, pbrMetallicRoughness={"metallicFactor": 0}))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(0.5, 0.5, 1), mi.Vector3f(0, 0, -1)))
    up, down = (
        np.array(si.bsdf().eval(mi.BSDFContext(), si, si.to_local(mi.Vector3f(0, y, 0.7)))).mean() for y in (0.7, -0.7)
    )
    assert up > 3 * down


def test_emission_has_its_strength_and_its_mesh_the_normals_of_its_faces(quad: Callable[..., Path], read: Read) -> None:
    strength = {"KHR_materials_emissive_strength": {"emissiveStrength": 8}}
    (shape,) = read(quad(emissiveFactor=[1, 0.5, 0], extensions=strength)).root.findall("shape")
    emitter = shape.find("emitter")
    assert emitter is not None
    radiance, flat = child(emitter, "radiance"), child(shape, "face_normals")
    assert radiance is not None
    assert flat is not None
    assert radiance.get("value") == "8, 4, 0"


def test_an_image_of_emission_keeps_values_above_one(gltf: Any, quad: Callable[..., Path], loaded: Loaded) -> None:
    strength = {"KHR_materials_emissive_strength": {"emissiveStrength": 8}}
    glow = gltf.image(FOUR, "glow.png")
    _, scene = loaded(quad(emissiveFactor=[1, 1, 1], emissiveTexture=glow, extensions=strength))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(0.75, 0.25, 1), mi.Vector3f(0, 0, -1)))
    assert np.array(scene.emitters()[0].eval(si)).max() == pytest.approx(8, rel=0.01)


@pytest.mark.parametrize(
    ("extensions", "roughness", "kind"),
    [
        ({"KHR_materials_transmission": {"transmissionFactor": 1}}, 0, "thindielectric"),
        (
            {"KHR_materials_transmission": {"transmissionFactor": 1}, "KHR_materials_volume": {"thicknessFactor": 1}},
            0,
            "dielectric",
        ),
        ({"KHR_materials_transmission": {"transmissionFactor": 0.7}}, 0.4, "principled"),
    ],
)
def test_what_light_passes_is_glass_with_its_refractive_index(
    quad: Callable[..., Path], loaded: Loaded, extensions: Any, roughness: float, kind: str
) -> None:
    surface = {"roughnessFactor": roughness, "metallicFactor": 0}
    extensions = extensions | {"KHR_materials_ior": {"ior": 1.7}}
    scene, made = loaded(quad(pbrMetallicRoughness=surface, extensions=extensions))
    glass = of_type(scene.root, kind)
    ior = child(glass, "eta" if kind == "principled" else "int_ior")
    assert ior is not None
    assert ior.get("value") == "1.7"
    assert mi.has_flag(made.shapes()[0].bsdf().flags(), mi.BSDFFlags.Transmission)


def test_what_is_masked_is_opaque_or_not(gltf: Any, quad: Callable[..., Path], loaded: Loaded) -> None:
    pixels = np.dstack([FOUR, np.array([[0, 100], [200, 255]])])
    surface = {"baseColorTexture": gltf.image(pixels, "leaf.png"), "metallicFactor": 0}
    _, scene = loaded(quad(pbrMetallicRoughness=surface, alphaMode="MASK"))
    x, y = mi.Float([0.25, 0.75, 0.25, 0.75]), mi.Float([0.75, 0.75, 0.25, 0.25])
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, y, 1), mi.Vector3f(0, 0, -1)))
    through = np.array(si.bsdf().eval_null_transmission(si))[0]
    assert through.tolist() == pytest.approx([1, 1, 0, 0], abs=1e-6)


def test_what_is_not_carried_over_is_listed(gltf: Any, quad: Callable[..., Path], read: Read) -> None:
    gltf.document["animations"] = [{}, {}]
    gltf.document["extensionsUsed"] = ["EXT_mesh_gpu_instancing"]
    notes = " ".join(read(quad(extensions={"KHR_materials_sheen": {}}, occlusionTexture={"index": 0})).notes)
    for lost in ("animations (2)", "EXT_mesh_gpu_instancing", "sheen", "baked occlusion"):
        assert lost in notes


# -------------------------------------------------------------------------------------------------- nodes and lights


def test_nodes_are_placed_by_all_above_them_and_mirrored_ones_keep_their_fronts(gltf: Any, loaded: Loaded) -> None:
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4"), np.array([[0, 1, 2], [0, 2, 3]], "<u4")
    mesh = gltf.mesh(*square)
    gltf.document["meshes"][mesh]["primitives"] *= 2
    gltf.node("Leg", mesh, scale=[-1, 1, 1])
    gltf.node("Chair", rotation=[0, 0, float(np.sin(np.pi / 4)), float(np.cos(np.pi / 4))], translation=[5, 0, 0],
              children=[0])  # fmt: skip
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


def test_lights_stand_and_shine_where_the_file_says(gltf: Any, quad: Callable[..., Path], loaded: Loaded) -> None:
    lights = [{"type": "point", "intensity": 3}, {"type": "spot", "spot": {"outerConeAngle": 0.5}},
              {"type": "directional", "color": [1, 0, 0], "intensity": 2}]  # fmt: skip
    gltf.document["extensions"] = {"KHR_lights_punctual": {"lights": lights}}
    for number in range(3):
        gltf.node(f"L{number}", translation=[1, 2, 3], extensions={"KHR_lights_punctual": {"light": number}})
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


def test_integers_that_are_normalised_and_sparse_ones_are_read(gltf: Any, loaded: Loaded) -> None:
    gltf.document["extensionsRequired"] = ["KHR_mesh_quantization"]
    corners = np.array([[0, 0, 0, 0], [255, 0, 0, 0], [255, 255, 0, 0], [0, 255, 0, 0]], "|u1")
    mesh = gltf.mesh(np.zeros((4, 3), "<f4"), np.array([[0, 1, 2], [0, 2, 3]], "<u4"))
    position = gltf.array(corners, "VEC3")
    gltf.document["accessors"][position]["normalized"] = True
    gltf.document["bufferViews"][-1]["byteStride"] = 4
    gltf.document["meshes"][mesh]["primitives"][0]["attributes"]["POSITION"] = position
    gltf.node("Square", mesh)
    where = gltf.array(np.arange(4, dtype="<u2").reshape(-1, 1), "SCALAR")
    what = gltf.array(np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]], "<f4"), "VEC3")
    views = [gltf.document["accessors"][number]["bufferView"] for number in (where, what)]
    sparse = {
        "count": 4,
        "indices": {"bufferView": views[0], "componentType": 5123},
        "values": {"bufferView": views[1]},
    }
    gltf.document["accessors"].append({"componentType": 5126, "count": 4, "type": "VEC3", "sparse": sparse})
    other = gltf.mesh(np.zeros((4, 3), "<f4"), np.array([[0, 1, 2], [0, 2, 3]], "<u4"))
    gltf.document["meshes"][other]["primitives"][0]["attributes"]["POSITION"] = what + 1
    gltf.node("Larger", other)
    _, made = loaded(gltf.write())
    assert [float(np.array(shape.surface_area())[0]) for shape in made.shapes()] == pytest.approx([1, 4])


def test_a_glb_is_the_same_scene(gltf: Any, quad: Callable[..., Path], read: Read, tmp_path: Path) -> None:
    from photonfarm.renderer.importing.elements import text

    separate = text(read(quad()).root)
    document = json.loads((tmp_path / "room.gltf").read_text())
    del document["buffers"][0]["uri"]
    words = json.dumps(document).encode()
    words += b" " * (-len(words) % 4)
    binary = (tmp_path / "room.bin").read_bytes()
    chunks = struct.pack("<II", len(words), 0x4E4F534A) + words + struct.pack("<II", len(binary), 0x004E4942) + binary
    (tmp_path / "one.glb").write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    assert text(read(tmp_path / "one.glb").root) == separate


# ---------------------------------------------------------------------------------------------------- what is wrong


def without(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def changed(**entries: Any) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        document = json.loads((folder / "room.gltf").read_text()) | entries
        (folder / "room.gltf").write_text(json.dumps(document))

    return change


@pytest.mark.parametrize(
    ("break_it", "named"),
    [
        (without("room.bin"), "room.bin"),
        (without("four.png"), "four.png"),
        (lambda folder: (folder / "room.bin").write_bytes(b"1234"), "needs"),
        (lambda folder: (folder / "four.png").write_bytes(b"no image"), "image 0"),
        (lambda folder: (folder / "room.gltf").write_text("{"), "room.gltf"),
        (changed(extensionsRequired=["KHR_draco_mesh_compression"]), "KHR_draco_mesh_compression"),
        (changed(asset={"version": "1.0"}), "1.0"),
        (changed(meshes=[]), "room.gltf"),
        (changed(nodes=[], scenes=[{"nodes": []}]), "room.gltf"),
    ],
)
def test_what_cannot_be_read_is_named(
    gltf: Any, quad: Callable[..., Path], read: Read, tmp_path: Path, break_it: Callable[[Path], None], named: str
) -> None:
    path = quad(pbrMetallicRoughness={"baseColorTexture": gltf.image(FOUR, "four.png")})
    break_it(tmp_path)
    with pytest.raises(SpecError, match=named):
        read(path)
