"""Materials of glTF as they are imported, with their images, as the specification has them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import mitsuba as mi
import numpy as np
import pytest
from imported_scenes import FOUR, Loaded, Read, colour_at, losses, of_type

from photonfarm.renderer.tools.importing import images
from photonfarm.renderer.tools.importing.elements import child

Quad = Callable[..., Path]

PASSES, SOLID = "KHR_materials_transmission", {"KHR_materials_volume": {"thicknessFactor": 1}}


def find(node: Element, *names: str) -> Element:
    """A property of an element, or one of that."""
    for name in names:
        found = child(node, name)
        assert found is not None, name
        node = found
    return node


def texel(image: Element) -> np.ndarray:
    """The first texel of an image."""
    return images.decode(Path(find(image, "filename").get("value", "")).read_bytes(), "it")[0, 0, :3]


def look_down(scene: Any, x: Any, y: Any) -> Any:
    """What lies below a place."""
    return scene.ray_intersect(mi.Ray3f(mi.Point3f(x, y, 1), mi.Vector3f(0, 0, -1)))


@pytest.mark.parametrize(
    ("transform", "top_left", "top_right"),
    [
        ({"offset": [0.5, 0]}, [0, 1, 0], [1, 0, 0]),
        ({"offset": [0, 0.5]}, [0, 0, 1], [1, 1, 1]),
        ({"rotation": np.pi / 2}, [0, 0, 1], [1, 0, 0]),  # (u, v) → (v, −u)
        ({"scale": [-1, 1]}, [0, 1, 0], [1, 0, 0]),
    ],
)
def test_images_lie_on_surfaces_as_their_transforms_say(
    gltf: Any, quad: Quad, loaded: Loaded, transform: Any, top_left: Any, top_right: Any
) -> None:
    found = gltf.image(FOUR, "four.png") | {"extensions": {"KHR_texture_transform": transform}}
    _, scene = loaded(quad(pbrMetallicRoughness={"baseColorTexture": found, "metallicFactor": 0}))
    assert colour_at(scene, 0.25, 0.75) == top_left
    assert colour_at(scene, 0.75, 0.75) == top_right


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
    gltf: Any, quad: Quad, loaded: Loaded, wrap_s: int, wrap_t: int, colours: Any
) -> None:
    four_times = {"extensions": {"KHR_texture_transform": {"scale": [4, 4], "offset": [-1, -1]}}}
    found = gltf.image(FOUR, "four.png") | four_times
    gltf.document["samplers"] = [{"wrapS": wrap_s, "wrapT": wrap_t, "magFilter": 9728}]
    gltf.document["textures"][0]["sampler"] = 0
    scene, made = loaded(quad(pbrMetallicRoughness={"baseColorTexture": found, "metallicFactor": 0}))
    assert colour_at(made, 0.25 / 4, 1 - 1.25 / 4) == colours[0]
    assert colour_at(made, 2.75 / 4, 1 - 0.25 / 4) == colours[1]
    assert losses(scene) == []


@pytest.mark.parametrize("same", [True, False])
def test_a_second_set_of_texture_coordinates_is_a_loss_only_where_it_differs(
    gltf: Any, quad: Quad, read: Read, same: bool
) -> None:
    found = gltf.image(FOUR, "four.png")
    quad(pbrMetallicRoughness={"baseColorTexture": found}, emissiveTexture=found | {"texCoord": 1})
    attributes = gltf.document["meshes"][0]["primitives"][0]["attributes"]
    other = gltf.array(np.zeros((4, 2), "<f4"), "VEC2")
    attributes["TEXCOORD_1"] = attributes["TEXCOORD_0"] if same else other
    assert losses(read(gltf.write())) == ([] if same else [("colour", "TEXCOORD_1")])


def test_textures_take_an_image_that_is_read_times_its_factor_or_the_factor_alone(
    gltf: Any, quad: Quad, loaded: Loaded
) -> None:
    found = gltf.image(FOUR, "four.webp")
    gltf.document["textures"][0] = {"extensions": {"EXT_texture_webp": {"source": 0}}}
    surface = {"baseColorTexture": found, "baseColorFactor": [0.25, 1, 1, 1], "metallicFactor": 0}
    scene, made = loaded(quad(pbrMetallicRoughness=surface))
    assert losses(scene) == []
    assert colour_at(made, 0.75, 0.25) == pytest.approx([0.25, 1, 1], abs=0.1)
    gltf.document["textures"][0] = {"extensions": {"KHR_texture_basisu": {"source": 0}}}
    scene, made = loaded(gltf.write())
    assert losses(scene) == [("colour", "KHR_texture_basisu")]
    assert colour_at(made, 0.25, 0.75) == [0.25, 1, 1]
    gltf.document["textures"][0] = {"source": 0, "extensions": {"EXT_texture_avif": {"source": 1}}}
    scene, _ = loaded(gltf.write())
    assert losses(scene) == []
    assert "EXT_texture_avif" in [change.name for change in scene.changes]


def test_roughness_is_the_green_channel_and_metallic_the_blue_one_raw_and_times_their_factors(
    gltf: Any, quad: Quad, read: Read
) -> None:
    pixels = np.full((2, 2, 3), (9, 100, 200))
    surface = {"metallicRoughnessTexture": gltf.image(pixels, "mr.png"), "roughnessFactor": 0.5, "metallicFactor": 1}
    principled = of_type(read(quad(pbrMetallicRoughness=surface)).root, "principled")
    for name, value in (("roughness", 50), ("metallic", 200)):
        assert find(principled, name, "raw").get("value") == "true"
        assert texel(find(principled, name))[0] * 255 == pytest.approx(value, abs=0.6)


def test_green_of_a_normal_map_tilts_upwards_in_the_image(gltf: Any, quad: Quad, loaded: Loaded) -> None:
    tilted = gltf.image(np.full((2, 2, 3), (128, 218, 218)), "normal.png")
    _, scene = loaded(quad(normalTexture=tilted, pbrMetallicRoughness={"metallicFactor": 0}))
    si = look_down(scene, 0.5, 0.5)
    up, down = (
        np.array(si.bsdf().eval(mi.BSDFContext(), si, si.to_local(mi.Vector3f(0, y, 0.7)))).mean() for y in (0.7, -0.7)
    )
    assert up > 3 * down


def test_the_strength_of_a_normal_map_is_in_its_image(gltf: Any, quad: Quad, read: Read) -> None:
    found = gltf.image(np.full((2, 2, 3), (255, 128, 255)), "normal.png") | {"scale": 0.5}
    x, y, z = 2 * texel(find(of_type(read(quad(normalTexture=found)).root, "normalmap"), "normalmap")) - 1
    assert x / z == pytest.approx(0.5, abs=0.01)
    assert x * x + y * y + z * z == pytest.approx(1, abs=0.01)


def test_emission_has_its_strength_and_its_mesh_the_normals_of_its_faces(gltf: Any, quad: Quad, loaded: Loaded) -> None:
    strength = {"KHR_materials_emissive_strength": {"emissiveStrength": 8}}
    glow = gltf.image(FOUR, "glow.png")
    scene, made = loaded(quad(emissiveFactor=[1, 0.5, 0], emissiveTexture=glow, extensions=strength))
    assert find(of_type(scene.root, "ply"), "face_normals") is not None
    radiance = np.array(made.emitters()[0].eval(look_down(made, 0.75, 0.25))).ravel()
    assert radiance == pytest.approx([8, 4, 0], rel=0.01)


@pytest.mark.parametrize(
    ("solid", "passes", "roughness", "kind"),
    [
        ({}, 1, 0, "thindielectric"),
        (SOLID, 1, 0, "dielectric"),
        ({}, 0.7, 0.4, "principledthin"),
        (SOLID, 0.7, 0.4, "principled"),
    ],
)
def test_what_light_passes_is_glass_with_its_refractive_index(
    quad: Quad, loaded: Loaded, solid: Any, passes: float, roughness: float, kind: str
) -> None:
    surface = {"roughnessFactor": roughness, "metallicFactor": 0}
    extensions = {PASSES: {"transmissionFactor": passes}, "KHR_materials_ior": {"ior": 1.7}} | solid
    scene, made = loaded(quad(pbrMetallicRoughness=surface, extensions=extensions))
    glass = of_type(scene.root, kind)
    assert find(glass, "eta" if "principled" in kind else "int_ior").get("value") == "1.7"
    assert mi.has_flag(made.shapes()[0].bsdf().flags(), mi.BSDFFlags.Transmission)


@pytest.mark.parametrize(
    ("passes", "metal", "rough", "share"), [(1, 0, 0, 1), (0.5, 0, 0, 0.5), (0.9, 0, 0.2, 0.9), (1, 1, 0, 0)]
)
def test_thin_glass_is_as_much_of_a_surface_as_light_passes(
    quad: Quad, loaded: Loaded, passes: float, metal: float, rough: float, share: float
) -> None:
    surface = {"roughnessFactor": rough, "metallicFactor": metal, "baseColorFactor": [1, 0.25, 1, 1]}
    _, scene = loaded(quad(pbrMetallicRoughness=surface, extensions={PASSES: {"transmissionFactor": passes}}))
    u, v, w = (mi.Float(values) for values in np.random.default_rng(1).random((3, 4096)))
    for z in (1, -1):
        si = scene.ray_intersect(mi.Ray3f(mi.Point3f([0.3] * 4096, 0.4, z), mi.Vector3f(0, 0, -z)))
        sample, weight = si.bsdf().sample(mi.BSDFContext(), si, u, mi.Point2f(v, w))
        through = np.array(mi.Frame3f.cos_theta(sample.wo)) * np.array(mi.Frame3f.cos_theta(si.wi)) < 0
        thin_pane = 2 * 0.04 / 1.04  # what its two sides reflect
        for channel, tint in ((0, 1), (1, 0.25)):
            passed = (np.array(weight)[channel] * through).mean()
            assert passed == pytest.approx(share * tint * (1 - thin_pane), abs=0.03)


def test_glass_says_what_it_loses_of_metal_and_of_coats(gltf: Any, quad: Quad, read: Read) -> None:
    glass = {PASSES: {"transmissionFactor": 1}, "KHR_materials_clearcoat": {"clearcoatFactor": 1}}
    normals = gltf.image(np.full((2, 2, 3), (128, 128, 255)), "normal.png")
    turned = normals | {"extensions": {"KHR_texture_transform": {"rotation": 1}}}
    surface = {"roughnessFactor": 0, "metallicFactor": 0}
    scene = read(quad(pbrMetallicRoughness=surface, extensions=glass, normalTexture=turned))
    assert of_type(of_type(scene.root, "normalmap"), "thindielectric") is not None
    assert [change.name for change in scene.changes] == ["KHR_texture_transform", "KHR_materials_clearcoat"]
    gltf.document["materials"][0]["pbrMetallicRoughness"]["metallicFactor"] = 0.5
    assert losses(read(gltf.write())) == [("colour", PASSES)]


def test_what_is_masked_is_opaque_and_shines_or_not(gltf: Any, quad: Quad, loaded: Loaded) -> None:
    pixels = np.dstack([FOUR, np.array([[0, 100], [200, 255]])])
    surface = {"baseColorTexture": gltf.image(pixels, "leaf.png"), "metallicFactor": 0}
    _, scene = loaded(quad(pbrMetallicRoughness=surface, alphaMode="MASK", emissiveFactor=[1, 0.5, 1]))
    si = look_down(scene, mi.Float([0.25, 0.75, 0.25, 0.75]), mi.Float([0.75, 0.75, 0.25, 0.25]))
    through = np.array(si.bsdf().eval_null_transmission(si))[0]
    assert through.tolist() == pytest.approx([1, 1, 0, 0], abs=1e-6)
    assert np.array(si.emitter(scene).eval(si))[1].tolist() == pytest.approx([0, 0, 0.5, 0.5], abs=1e-3)


def test_what_is_masked_away_by_its_factor_is_not_there(gltf: Any, quad: Quad, read: Read) -> None:
    quad(alphaMode="MASK", pbrMetallicRoughness={"baseColorFactor": [1, 1, 1, 0.4]}, emissiveFactor=[1, 1, 1])
    gltf.node("Other", gltf.mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4"), np.array([[0, 1, 2]], "<u4")))
    scene = read(gltf.write())
    assert list(scene.meshes) == ["Other"]
    assert losses(scene) == []
    assert ["node 'Quad'"] in [change.places for change in scene.changes if change.name == "alphaMode"]


@pytest.mark.parametrize(
    ("colours", "kind", "image", "lost"),
    [
        (np.outer([0, 255, 255, 0], [1, 1, 1]).astype("|u1"), "VEC3", False, []),
        (np.outer([0, 1, 1, 0], [1, 1, 1]).astype("<f4"), "VEC3", True, ["COLOR_0"]),
        (np.array([[1, 1, 1, 0], [1, 1, 1, 1]] * 2, "<f4"), "VEC4", False, ["COLOR_0"]),
        (np.full((4, 4), 0.5, "<f4"), "VEC4", True, []),
        (np.ones((4, 4), "<f4"), "VEC4", True, []),
    ],
)
def test_colours_of_vertices_multiply_a_plain_one_of_the_material(
    gltf: Any, quad: Quad, loaded: Loaded, colours: Any, kind: str, image: bool, lost: list[str]
) -> None:
    surface = {"baseColorFactor": [0.5, 1, 1, 1], "metallicFactor": 0}
    if image:
        surface["baseColorTexture"] = gltf.image(FOUR, "four.png")
    quad(pbrMetallicRoughness=surface, alphaMode="BLEND")
    gltf.document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = gltf.array(colours, kind)
    scene, made = loaded(gltf.write())
    assert losses(scene) == [("colour", name) for name in lost]
    if not image and not lost:
        assert colour_at(made, 0.2, 0.5) == pytest.approx([0.1, 0.2, 0.2], abs=0.01)
        assert colour_at(made, 0.8, 0.5) == pytest.approx([0.4, 0.8, 0.8], abs=0.01)


@pytest.mark.parametrize(
    ("gloss", "reflectance", "lost"),
    [
        ({"specularFactor": 0.5}, 0.02, False),
        ({"specularFactor": 0, "specularColorFactor": [1, 0, 0]}, 0, False),
        ({"specularColorFactor": [2, 2, 2]}, 0.08, False),
        ({"specularColorFactor": [1, 0.5, 0]}, 0.02, True),
        ({"specularTexture": {"index": 0}}, 0.04, True),
    ],
)
def test_the_strength_of_reflection_is_an_index_of_refraction(
    quad: Quad, read: Read, gloss: Any, reflectance: float, lost: bool
) -> None:
    scene = read(quad(extensions={"KHR_materials_specular": gloss}))
    ior = float(find(of_type(scene.root, "principled"), "eta").get("value", ""))
    assert ((ior - 1) / (ior + 1)) ** 2 == pytest.approx(reflectance, abs=1e-4)
    assert losses(scene) == [("colour", "KHR_materials_specular")] * lost


def test_a_clear_coat_is_carried_over_with_its_images(gltf: Any, quad: Quad, loaded: Loaded) -> None:
    coat = {"clearcoatFactor": 0.5, "clearcoatTexture": gltf.image(FOUR, "four.png"), "clearcoatRoughnessFactor": 0.3}
    scene, _ = loaded(quad(extensions={"KHR_materials_clearcoat": coat}))
    principled = of_type(scene.root, "principled")
    assert find(principled, "clearcoat").get("type") == "bitmap"
    gloss = float(find(principled, "clearcoat_gloss").get("value", ""))
    assert 0.1 - 0.099 * gloss == pytest.approx(0.3**2)
    assert losses(scene) == []


@pytest.mark.parametrize(
    ("diffuse", "specular", "base", "metal"),
    [
        ([0.5, 0.25, 0.125], [0.04, 0.04, 0.04], [0.5, 0.25, 0.125], 0),  # a dielectric as metallic-roughness has it
        ([0, 0, 0], [0.9, 0.6, 0.3], [0.9, 0.6, 0.3], 1),  # a metal
    ],
)
def test_specular_glossiness_becomes_metal_and_roughness(
    quad: Quad, read: Read, diffuse: Any, specular: Any, base: Any, metal: float
) -> None:
    gloss = {"diffuseFactor": [*diffuse, 1], "specularFactor": specular, "glossinessFactor": 0.75}
    scene = read(quad(extensions={"KHR_materials_pbrSpecularGlossiness": gloss}))
    made = {part.get("name"): part.get("value") or "" for part in of_type(scene.root, "principled")}
    assert [float(part) for part in made["base_color"].split(",")] == pytest.approx(base, abs=2e-3)
    assert float(made["metallic"]) == pytest.approx(metal, abs=2e-3)
    assert float(made["roughness"]) == pytest.approx(0.25)
    assert losses(scene) == []


def test_images_of_unlike_size_are_joined_texel_by_texel(gltf: Any, quad: Quad, loaded: Loaded) -> None:
    leaf = gltf.image(np.dstack([FOUR, np.array([[0, 100], [200, 255]])]), "leaf.png")
    glow = gltf.image(np.full((3, 5, 3), 255), "glow.png")
    surface = {"baseColorTexture": leaf, "metallicFactor": 0}
    scene, made = loaded(
        quad(pbrMetallicRoughness=surface, alphaMode="MASK", emissiveFactor=[1, 1, 1], emissiveTexture=glow)
    )
    si = look_down(made, mi.Float([0.1, 0.9, 0.1, 0.9]), mi.Float([5 / 6, 5 / 6, 1 / 6, 1 / 6]))
    assert np.array(si.emitter(made).eval(si))[1].tolist() == pytest.approx([0, 0, 1, 1], abs=1e-3)
    assert losses(scene) == []
