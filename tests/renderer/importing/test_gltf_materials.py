"""Materials of glTF as they are imported, with their images, as the specification has them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from imported_scenes import FOUR, Loaded, Read, colour_at, losses, of_type

from photonfarm.renderer.tools.importing import images
from photonfarm.renderer.tools.importing.elements import child


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
        stored = images.decode(Path(file.get("value", "")).read_bytes(), "it")[0, 0, 0]
        assert stored * 255 == pytest.approx(value, abs=0.6)


def test_colours_are_multiplied_in_linear_light(gltf: Any, quad: Callable[..., Path], loaded: Loaded) -> None:
    surface = {"baseColorTexture": gltf.image(FOUR, "four.png"), "baseColorFactor": [0.5, 1, 0.25, 1]}
    _, scene = loaded(quad(pbrMetallicRoughness=surface | {"metallicFactor": 0}))
    assert colour_at(scene, 0.75, 0.25) == pytest.approx([0.5, 1, 0.25], abs=0.01)


def test_green_of_a_normal_map_tilts_upwards_in_the_image(gltf: Any, quad: Callable[..., Path], loaded: Loaded) -> None:
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
        ({"KHR_materials_transmission": {"transmissionFactor": 0.7}}, 0.4, "principledthin"),
        (
            {"KHR_materials_transmission": {"transmissionFactor": 0.7}, "KHR_materials_volume": {"thicknessFactor": 1}},
            0.4,
            "principled",
        ),
    ],
)
def test_what_light_passes_is_glass_with_its_refractive_index(
    quad: Callable[..., Path], loaded: Loaded, extensions: Any, roughness: float, kind: str
) -> None:
    surface = {"roughnessFactor": roughness, "metallicFactor": 0}
    extensions = extensions | {"KHR_materials_ior": {"ior": 1.7}}
    scene, made = loaded(quad(pbrMetallicRoughness=surface, extensions=extensions))
    glass = of_type(scene.root, kind)
    ior = child(glass, "eta" if "principled" in kind else "int_ior")
    assert ior is not None
    assert ior.get("value") == "1.7"
    assert mi.has_flag(made.shapes()[0].bsdf().flags(), mi.BSDFFlags.Transmission)


@pytest.mark.parametrize(
    ("passes", "metal", "rough", "share"), [(1, 0, 0, 1), (0.5, 0, 0, 0.5), (0.9, 0, 0.2, 0.9), (1, 1, 0, 0)]
)
def test_thin_glass_is_as_much_of_a_surface_as_light_passes(
    quad: Callable[..., Path], loaded: Loaded, passes: float, metal: float, rough: float, share: float
) -> None:
    surface = {"roughnessFactor": rough, "metallicFactor": metal, "baseColorFactor": [1, 0.25, 1, 1]}
    _, scene = loaded(
        quad(pbrMetallicRoughness=surface, extensions={"KHR_materials_transmission": {"transmissionFactor": passes}})
    )
    for z in (1, -1):
        si = scene.ray_intersect(mi.Ray3f(mi.Point3f([0.3] * 4096, 0.4, z), mi.Vector3f(0, 0, -z)))
        numbers = (
            mi.Float(np.random.default_rng(1).random(4096)),
            mi.Point2f(np.random.default_rng(2).random((2, 4096))),
        )
        sample, weight = si.bsdf().sample(mi.BSDFContext(), si, *numbers)
        through = np.array(mi.Frame3f.cos_theta(sample.wo)) * np.array(mi.Frame3f.cos_theta(si.wi)) < 0
        thin_pane = 2 * 0.04 / 1.04  # what its two sides reflect
        for channel, tint in ((0, 1), (1, 0.25)):
            passed = (np.array(weight)[channel] * through).mean()
            assert passed == pytest.approx(share * tint * (1 - thin_pane), abs=0.03)


def test_thin_glass_that_is_metal_in_part_is_a_loss(quad: Callable[..., Path], read: Read) -> None:
    glass = {"KHR_materials_transmission": {"transmissionFactor": 1}}
    scene = read(quad(pbrMetallicRoughness={"metallicFactor": 0.5}, extensions=glass))
    assert losses(scene) == [("colour", "KHR_materials_transmission")]


def test_clear_glass_has_its_normal_map_and_says_that_it_has_no_coat(
    gltf: Any, quad: Callable[..., Path], read: Read
) -> None:
    glass = {"KHR_materials_transmission": {"transmissionFactor": 1}, "KHR_materials_clearcoat": {"clearcoatFactor": 1}}
    normals = gltf.image(np.full((2, 2, 3), (128, 128, 255)), "normal.png")
    turned = normals | {"extensions": {"KHR_texture_transform": {"rotation": 1}}}
    surface = {"roughnessFactor": 0, "metallicFactor": 0}
    scene = read(quad(pbrMetallicRoughness=surface, extensions=glass, normalTexture=turned))
    assert of_type(of_type(scene.root, "normalmap"), "thindielectric") is not None
    assert [(change.effect, change.name) for change in scene.changes] == [
        (None, "KHR_texture_transform"),
        ("colour", "KHR_materials_clearcoat"),
    ]


def test_what_is_masked_is_opaque_and_shines_or_not(gltf: Any, quad: Callable[..., Path], loaded: Loaded) -> None:
    pixels = np.dstack([FOUR, np.array([[0, 100], [200, 255]])])
    surface = {"baseColorTexture": gltf.image(pixels, "leaf.png"), "metallicFactor": 0}
    _, scene = loaded(quad(pbrMetallicRoughness=surface, alphaMode="MASK", emissiveFactor=[1, 0.5, 1]))
    x, y = mi.Float([0.25, 0.75, 0.25, 0.75]), mi.Float([0.75, 0.75, 0.25, 0.25])
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, y, 1), mi.Vector3f(0, 0, -1)))
    through = np.array(si.bsdf().eval_null_transmission(si))[0]
    assert through.tolist() == pytest.approx([1, 1, 0, 0], abs=1e-6)
    assert np.array(si.emitter(scene).eval(si))[1].tolist() == pytest.approx([0, 0, 0.5, 0.5], abs=1e-3)


def test_the_colour_and_gloss_of_the_old_model_stay_with_a_loss(quad: Callable[..., Path], read: Read) -> None:
    gloss = {"diffuseFactor": [0.5, 0.25, 0.125, 1], "specularFactor": [0.9, 0.6, 0.3], "glossinessFactor": 0.75}
    scene = read(quad(extensions={"KHR_materials_pbrSpecularGlossiness": gloss}))
    made = {part.get("name"): part.get("value") for part in of_type(scene.root, "principled")}
    assert (made["base_color"], made["metallic"], made["roughness"]) == ("0.5, 0.25, 0.125", "0", "0.25")
    assert losses(scene) == [("colour", "KHR_materials_pbrSpecularGlossiness")]


def test_textures_take_an_image_that_is_read_and_none_if_there_is_none(
    gltf: Any, quad: Callable[..., Path], loaded: Loaded
) -> None:
    found = gltf.image(FOUR, "four.webp") | {"extensions": {}}
    gltf.document["textures"][0] = {"extensions": {"EXT_texture_webp": {"source": 0}}}
    surface = {"baseColorTexture": found, "baseColorFactor": [0.25, 1, 1, 1], "metallicFactor": 0}
    scene, made = loaded(quad(pbrMetallicRoughness=surface))
    assert losses(scene) == []
    assert colour_at(made, 0.75, 0.25) == pytest.approx([0.25, 1, 1], abs=0.1)
    gltf.document["textures"][0] = {"extensions": {"KHR_texture_basisu": {"source": 0}}}
    scene, made = loaded(gltf.write())
    assert losses(scene) == [("colour", "KHR_texture_basisu")]
    assert colour_at(made, 0.25, 0.75) == [0.25, 1, 1]


@pytest.mark.parametrize(
    ("colours", "kind", "alpha", "left", "right", "lost"),
    [
        (np.full((4, 3), 0.5, "<f4"), "VEC3", "OPAQUE", [0.25, 0.5, 0.5], [0.25, 0.5, 0.5], []),
        (np.full((4, 4), 51, "|u1"), "VEC4", "BLEND", [0.1, 0.2, 0.2], [0.1, 0.2, 0.2], []),
        (
            np.array([[0], [1], [1], [0]], "<f4") * np.ones((1, 3), "<f4"),
            "VEC3",
            "OPAQUE",
            [0.1, 0.2, 0.2],
            [0.4, 0.8, 0.8],
            [],
        ),
        (
            np.array([[1, 1, 1, 0], [1, 1, 1, 1]] * 2, "<f4"),
            "VEC4",
            "BLEND",
            [0.5, 1, 1],
            [0.5, 1, 1],
            [("colour", "COLOR_0")],
        ),
    ],
)
def test_colours_of_vertices_multiply_that_of_the_material(
    gltf: Any,
    quad: Callable[..., Path],
    loaded: Loaded,
    colours: Any,
    kind: str,
    alpha: str,
    left: Any,
    right: Any,
    lost: Any,
) -> None:
    surface = {"baseColorFactor": [0.5, 1, 1, 1], "metallicFactor": 0}
    path = quad(pbrMetallicRoughness=surface, alphaMode=alpha)
    gltf.document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = gltf.array(colours, kind)
    path = gltf.write()
    scene, made = loaded(path)
    assert losses(scene) == lost
    if alpha == "OPAQUE":
        assert colour_at(made, 0.2, 0.5) == pytest.approx(left, abs=0.01)
        assert colour_at(made, 0.8, 0.5) == pytest.approx(right, abs=0.01)
        return
    opacity = child(of_type(scene.root, "mask"), "opacity")
    assert opacity is not None
    assert float(opacity.get("value", "")) == pytest.approx(colours[:, 3].mean() / (255 if kind == "|u1" else 1), 1)


def test_what_is_masked_away_by_its_factor_is_not_there(gltf: Any, quad: Callable[..., Path], read: Read) -> None:
    quad(alphaMode="MASK", pbrMetallicRoughness={"baseColorFactor": [1, 1, 1, 0.4]}, emissiveFactor=[1, 1, 1])
    gltf.node("Other", gltf.mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4"), np.array([[0, 1, 2]], "<u4")))
    scene = read(gltf.write())
    assert list(scene.meshes) == ["Other"]
    assert losses(scene) == []
    assert ["node 'Quad'"] in [change.places for change in scene.changes if change.name == "alphaMode"]


@pytest.mark.parametrize(
    ("gloss", "reflectance", "lost"),
    [
        ({}, 0.04, False),
        ({"specularFactor": 0.5}, 0.02, False),
        ({"specularFactor": 0, "specularColorFactor": [1, 0, 0]}, 0, False),
        ({"specularColorFactor": [2, 2, 2]}, 0.08, False),
        ({"specularColorFactor": [1, 0.5, 0]}, 0.02, True),
        ({"specularTexture": {"index": 0}}, 0.04, True),
    ],
)
def test_the_strength_of_reflection_is_an_index_of_refraction(
    quad: Callable[..., Path], read: Read, gloss: Any, reflectance: float, lost: bool
) -> None:
    scene = read(quad(extensions={"KHR_materials_specular": gloss}))
    eta = child(of_type(scene.root, "principled"), "eta")
    assert eta is not None
    ior = float(eta.get("value", ""))
    assert ((ior - 1) / (ior + 1)) ** 2 == pytest.approx(reflectance, abs=1e-4)
    assert losses(scene) == [("colour", "KHR_materials_specular")] * lost


def test_a_clear_coat_is_carried_over_with_its_images(gltf: Any, quad: Callable[..., Path], loaded: Loaded) -> None:
    coat = {"clearcoatFactor": 0.5, "clearcoatTexture": gltf.image(FOUR, "four.png"), "clearcoatRoughnessFactor": 0.3}
    scene, _ = loaded(quad(extensions={"KHR_materials_clearcoat": coat}))
    principled = of_type(scene.root, "principled")
    strength, gloss = child(principled, "clearcoat"), child(principled, "clearcoat_gloss")
    assert strength is not None
    assert gloss is not None
    assert strength.get("type") == "bitmap"
    assert 0.1 - 0.099 * float(gloss.get("value", "")) == pytest.approx(0.3**2)
    assert losses(scene) == []


def test_the_strength_of_a_normal_map_is_in_its_image(gltf: Any, quad: Callable[..., Path], read: Read) -> None:
    found = gltf.image(np.full((2, 2, 3), (255, 128, 255)), "normal.png") | {"scale": 0.5}
    image = child(of_type(read(quad(normalTexture=found)).root, "normalmap"), "normalmap")
    assert image is not None
    file = child(image, "filename")
    assert file is not None
    x, y, z = 2 * images.decode(Path(file.get("value", "")).read_bytes(), "it")[0, 0, :3] - 1
    assert x / z == pytest.approx(0.5, abs=0.01)
    assert x * x + y * y + z * z == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize(
    ("wrap_s", "wrap_t", "colours"),  # at u −0.75, v 0.25, and at u 1.75, v −0.75
    [
        (33648, 10497, [[0, 1, 0], [1, 0, 0]]),
        (10497, 33648, [[1, 0, 0], [1, 1, 1]]),
        (33071, 33648, [[1, 0, 0], [1, 1, 1]]),
        (33648, 33648, [[0, 1, 0], [0, 0, 1]]),
        (33071, 33071, [[1, 0, 0], [0, 1, 0]]),
    ],
)
def test_images_wrap_along_each_axis_as_their_sampler_says(
    gltf: Any, quad: Callable[..., Path], loaded: Loaded, wrap_s: int, wrap_t: int, colours: Any
) -> None:
    found = gltf.image(FOUR, "four.png") | {
        "extensions": {"KHR_texture_transform": {"scale": [4, 4], "offset": [-1, -1]}}
    }
    gltf.document["samplers"] = [{"wrapS": wrap_s, "wrapT": wrap_t, "magFilter": 9728}]
    gltf.document["textures"][0]["sampler"] = 0
    scene, made = loaded(quad(pbrMetallicRoughness={"baseColorTexture": found, "metallicFactor": 0}))
    assert colour_at(made, 0.25 / 4, 1 - 1.25 / 4) == colours[0]
    assert colour_at(made, 2.75 / 4, 1 - 0.25 / 4) == colours[1]
    assert losses(scene) == []


@pytest.mark.parametrize("same", [True, False])
def test_a_second_set_of_texture_coordinates_is_a_loss_only_where_it_differs(
    gltf: Any, quad: Callable[..., Path], read: Read, same: bool
) -> None:
    found = gltf.image(FOUR, "four.png")
    quad(pbrMetallicRoughness={"baseColorTexture": found}, emissiveTexture=found | {"texCoord": 1})
    attributes = gltf.document["meshes"][0]["primitives"][0]["attributes"]
    other = gltf.array(np.zeros((4, 2), "<f4"), "VEC2")
    attributes["TEXCOORD_1"] = attributes["TEXCOORD_0"] if same else other
    assert losses(read(gltf.write())) == ([] if same else [("colour", "TEXCOORD_1")])
