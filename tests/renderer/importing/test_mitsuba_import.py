"""Mitsuba's XML as it is imported: old versions upgraded, what cannot be rendered left out and named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from photonfarm.renderer.importing.imported import ImportedScene
from photonfarm.renderer.importing.readers import mitsuba_parts
from photonfarm.renderer.importing.readers.images import save_radiance
from photonfarm.shared.core.errors import SpecError
from photonfarm.shared.scene.files import SceneFile

Loaded = Callable[[Path], tuple[ImportedScene, Any]]
Read = Callable[[Path], ImportedScene]


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Function (content, version) → a scene file."""

    def make(content: str, version: str = "3.0.0") -> Path:
        (tmp_path / "scene.xml").write_text(f'<scene version="{version}">\n{content}\n</scene>')
        return tmp_path / "scene.xml"

    return make


def reflectance(made: Any, x: float, y: float) -> np.ndarray:
    """The colour of what a ray down at (x, y) meets."""
    hit = made.ray_intersect(mi.Ray3f([x, y, 5], [0, 0, -1]))
    return np.array(hit.bsdf().eval_diffuse_reflectance(hit)).ravel()


def from_sky(made: Any, directions: np.ndarray) -> np.ndarray:
    """What comes from directions (N, 3); (N, 3)."""
    looked = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    looked.wi = mi.Vector3f(np.ascontiguousarray(-unit.T))
    return np.array(made.environment().eval(looked)).T


SPHERE = '<shape type="sphere" id="Ball"/>'


def test_names_of_version_0_6_are_those_of_version_3(write: Callable[..., Path], loaded: Loaded) -> None:
    content = """
      <bsdf type="roughplastic" id="Red"><float name="intIOR" value="1.4"/>
        <rgb name="diffuseReflectance" value="#ff0000"/></bsdf>
      <bsdf type="phong" id="Shiny"><float name="exponent" value="48"/>
        <spectrum name="diffuseReflectance" value=".1, .2, .3"/></bsdf>
      <texture type="checkerboard" id="Squares"><float name="uscale" value="4"/>
        <float name="voffset" value=".5"/></texture>
      <bsdf type="diffuse" id="Chess"><ref name="reflectance" id="Squares"/></bsdf>
      <shape type="sphere"><ref id="Red"/><transform name="toWorld"><scale value="2"/></transform></shape>
      <shape type="sphere"><ref id="Shiny"/><blackbody name="unknownThing" temperature="5000K"/></shape>
      <shape type="rectangle"><ref id="Chess"/></shape>
      <emitter type="sky"><float name="turbidity" value="3"/></emitter>"""
    scene, made = loaded(write(content, "0.6.0"))
    red, shiny, chess = made.shapes()
    assert np.array(red.bbox().max) == pytest.approx([2, 2, 2])
    assert "eta = [1.39" in str(red.bsdf())
    assert "alpha_u = UniformSpectrum[value=[0.1]]" in str(shiny.bsdf())  # 1 / √(2 · 50)
    assert "0.5" in str(chess.bsdf())
    assert made.emitters()[0].class_name() == "SunskyEmitter"
    notes = " ".join(map(str, scene.changes))
    for said in ("phong", "sky", "unknownThing", "3 of 3 shapes"):
        assert said in notes


@pytest.mark.parametrize(
    ("written", "expected"),
    [
        ('<srgb name="reflectance" value="0.5"/>', [0.214] * 3),
        ('<srgb name="reflectance" value="#808080"/>', [0.216] * 3),
        ('<rgb name="reflectance" value="#808080"/>', [0.502] * 3),  # linear also in digits
        ('<rgb name="reflectance" value="1.5, .75, 0"/>', [1, 0.5, 0]),  # energy is conserved
        ('<spectrum name="reflectance" value=".1, .2, .3"/>', [0.1, 0.2, 0.3]),
        ('<spectrum name="reflectance" value="0.3" intent="reflectance"/>', [0.3] * 3),
        ('<spectrum name="reflectance" value="400:.5, 700:.5"/>', [0.6, 0.475, 0.452]),  # of no white point
        ('<xyz name="reflectance" value=".3, .3, .3"/>', [0.361, 0.285, 0.273]),
    ],
)  # fmt: skip
def test_colours_of_0_6_are_those_of_its_rgb_mode(
    write: Callable[..., Path], loaded: Loaded, written: str, expected: list[float]
) -> None:
    _, made = loaded(write(f'<shape type="rectangle"><bsdf type="diffuse">{written}</bsdf></shape>', "0.6.0"))
    assert reflectance(made, 0.1, 0.1) == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ("", [0.216, 0.051, 1]),
        ('<float name="gamma" value="1"/>', [0.502, 0.251, 1]),
        ('<float name="gamma" value="-1"/>', [0.216, 0.051, 1]),
        ('<float name="gamma" value="2.2"/>', [0.5019608**2.2, 0.2509804**2.2, 1]),
        ('<string name="channel" value="g"/>', [0.051] * 3),
        ('<string name="channel" value="a"/>', [0.8] * 3),
        ('<string name="filterType" value="ewa"/><boolean name="cache" value="true"/>', [0.216, 0.051, 1]),
    ],
)
def test_bitmaps_of_0_6_are_read_as_they_say(
    write: Callable[..., Path], loaded: Loaded, tmp_path: Path, said: str, expected: list[float]
) -> None:
    Image.fromarray(np.full((2, 2, 4), (128, 64, 255, 204), np.uint8)).save(tmp_path / "it.png")
    content = f'<texture name="reflectance" type="bitmap"><string name="filename" value="it.png"/>{said}</texture>'
    content = f'<shape type="rectangle" id="Plate"><bsdf type="diffuse">{content}</bsdf></shape>'
    scene, made = loaded(write(content, "0.6.0"))
    assert reflectance(made, 0.1, 0.1) == pytest.approx(expected, abs=1e-3)
    assert not list(scene.changes)


def test_textures_of_0_6_are_moved_and_named_as_they_say(
    write: Callable[..., Path], loaded: Loaded, tmp_path: Path
) -> None:
    Image.fromarray(np.array([[0, 255]], np.uint8)).save(tmp_path / "it.png")
    named = '<string name="filename" value="it.png"/><string name="filterType" value="nearest"/>'
    content = f"""<shape type="rectangle"><bsdf type="diffuse"><texture type="scale" id="S" name="reflectance">
        <texture type="bitmap" id="T">{named}<float name="voffset" value="1"/></texture></texture></bsdf></shape>"""
    for number, name in enumerate("ST"):
        content += f"""<shape type="rectangle"><transform name="toWorld"><translate x="{4 * number + 4}"/></transform>
        <bsdf type="diffuse"><ref name="reflectance" id="{name}"/></bsdf></shape>"""
    scene, made = loaded(write(content, "0.6.0"))
    assert [reflectance(made, x, 0)[0] for x in (-0.5, 0.5, 4.5, 8.5)] == pytest.approx([0, 1, 1, 1])
    matrix = scene.root.find("texture/transform/matrix")
    assert matrix is not None
    assert matrix.get("value", "").split()[6:8] == ["0", "1"]  # v · 1 + 1


def test_light_of_0_6_has_its_colour_and_level(write: Callable[..., Path], loaded: Loaded) -> None:
    for written, expected in (
        ('<spectrum name="radiance" value="2"/>', [2, 2, 2]),  # Mitsuba 3: 2.4, 1.9, 1.8
        ('<blackbody name="radiance" temperature="3000K" scale="0.01"/>', [7.331, 3.496, 1.127]),  # Planck's law
    ):
        _, made = loaded(write(f'<emitter type="constant">{written}</emitter>{SPHERE}', "0.6.0"))
        assert from_sky(made, np.array([[0, 0, 1]]))[0] == pytest.approx(expected, rel=1e-3)
    content = SPHERE + '<emitter type="constant"><spectrum name="radiance" type="blackbody">'
    _, made = loaded(write(content + '<float name="temperature" value="3000"/></spectrum></emitter>'))
    assert from_sky(made, np.array([[0, 0, 1]]))[0] == pytest.approx([733.1, 349.6, 112.7], rel=1e-3)


def test_the_sun_of_0_6_stands_where_its_place_and_time_say(write: Callable[..., Path], loaded: Loaded) -> None:
    place = '<float name="hour" value="9.5"/><float name="latitude" value="52"/><float name="longitude" value="5"/>'
    content = f'<emitter type="sun">{place}<float name="timezone" value="1"/></emitter>{SPHERE}'
    _, made = loaded(write(content, "0.6.0"))
    sun = np.array([[0.69690, 0.67320, 0.24726]])  # by 0.6's code (sunmodel.h): +X is east, −Z is north
    assert from_sky(made, sun).min() > 1000
    assert from_sky(made, sun * [1, 1, -1]).max() == 0


def test_skies_of_0_6_are_above(case: Callable[[str], Path], loaded: Loaded) -> None:
    directions = np.random.default_rng(0).normal(size=(20000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for name, mean, sun in (("overhead", 0.112, [0, 1, 0]), ("oblique", 0.109, [0.3, 0.9, 0.1])):
        _, made = loaded(case(f"mi06-sunsky/{name}.xml"))
        assert from_sky(made, directions[directions[:, 1] > 0.1]).mean() == pytest.approx(mean, rel=0.01)
        assert from_sky(made, directions[directions[:, 1] < -0.1]).max() == 0
        expected = {"overhead": 0.175, "oblique": 0.187}[name]
        assert from_sky(made, np.array([sun])).mean() == pytest.approx(expected, rel=0.01)
    assert from_sky(made, np.array([[-0.31, 0.94, 0.10]])).mean() == pytest.approx(0.065, rel=0.01)


def test_the_cases_of_mitsuba_have_their_right_values(case: Callable[[str], Path], loaded: Loaded) -> None:
    _, made = loaded(case("mi06-srgb/scene.xml"))
    assert [reflectance(made, x, 0)[0] for x in (0, 3, 6)] == pytest.approx([0.214, 0.216, 0.5], abs=1e-3)
    scene, made = loaded(case("mi06-bitmap-gamma/scene.xml"))
    assert reflectance(made, 0, 0) == pytest.approx([0.502] * 3, abs=1e-3)
    assert not list(scene.changes)
    _, made = loaded(case("mi-include-parameter/scene.xml"))
    assert np.array([made.bbox().min, made.bbox().max]).ravel() == pytest.approx([-2] * 3 + [2] * 3)
    _, made = loaded(case("mi-alias/scene.xml"))
    assert reflectance(made, 0, 0) == pytest.approx([0.8, 0.1, 0.1])
    with pytest.raises(SpecError, match=r"scene\.xml.*line 6: entity 'header'.*<include"):
        loaded(case("mi06-entity/scene.xml"))


MIXTURE = """<bsdf type="mixturebsdf"><string name="weights" value="{}"/><bsdf type="diffuse">
  <rgb name="reflectance" value="1 0 0"/></bsdf><bsdf type="diffuse"><rgb name="reflectance" value="0 1 0"/></bsdf>
  </bsdf>"""


@pytest.mark.parametrize(
    ("written", "described", "said"),
    [
        ('<bsdf type="conductor"/>', "0.201005, 0.92375, 1.10222", None),  # copper
        ('<bsdf type="roughdielectric"><string name="distribution" value="phong"/></bsdf>', "beckmann", "distribution"),
        ('<bsdf type="ward"><float name="alphaU" value=".2"/><float name="alphaV" value=".3"/></bsdf>',
         "alpha_u = UniformSpectrum[value=[0.2]], alpha_v = UniformSpectrum[value=[0.3]]", "ward"),
        ('<bsdf type="roughdiffuse"><float name="alpha" value=".3"/></bsdf>', "SmoothDiffuse", "roughdiffuse"),
        ('<bsdf type="conductor"><spectrum name="eta" value="1.5"/><spectrum name="k" value="400:3, 700:3"/></bsdf>',
         "1.5, 1.5, 1.5", None),
        ('<texture type="checkerboard" id="T"/><texture type="scale" id="S"><float name="scale" value=".25"/>'
         '<ref id="T"/></texture><bsdf type="bumpmap"><ref id="S"/><bsdf type="diffuse"/></bsdf>',
         "scale = 0.25", None),
        ('<texture type="bitmap" id="T"><string name="filename" value="n.png"/><float name="gamma" value="1"/>'
         '</texture><bsdf type="normalmap"><ref id="T"/><bsdf type="diffuse"/></bsdf>', "NormalMap", None),
        (MIXTURE.format(".5, .5"), "weight = UniformSpectrum[value=[0.5]]", None),
        ('<bsdf type="bumpmap"><texture type="scale"><float name="scale" value=".25"/><texture type="checkerboard"/>'
         '</texture><bsdf type="diffuse"/></bsdf>', "scale = 0.25", None),
    ],
)  # fmt: skip
def test_materials_of_0_6_have_its_defaults_or_are_the_nearest(
    write: Callable[..., Path], loaded: Loaded, tmp_path: Path, written: str, described: str, said: str | None
) -> None:
    Image.fromarray(np.full((2, 2, 3), (128, 128, 255), np.uint8)).save(tmp_path / "n.png")
    textures, bsdf, rest = written.partition("<bsdf")
    scene, made = loaded(write(f'{textures}<shape type="rectangle" id="Plate">{bsdf}{rest}</shape>', "0.6.0"))
    assert described in " ".join(str(made.shapes()[0].bsdf()).split())
    assert [change.name for change in scene.changes if change.effect is None] == ([said] if said else [])
    assert not [change for change in scene.changes if change.effect]


@pytest.mark.parametrize(
    ("content", "effect", "name"),
    [
        ('<texture type="bitmap"><string name="filename" value="it.exr"/><float name="gamma" value="2.2"/></texture>',
         "colour", "gamma"),
        ('<texture type="bitmap"><string name="filename" value="grey.png"/><string name="wrapModeU" value="clamp"/>'
         "</texture>", "colour", "wrapMode"),
        ('<texture type="scale"><float name="scale" value=".5"/><texture type="checkerboard"/></texture>',
         "colour", "scale"),
        ('<texture type="vertexcolors"/>', "colour", "vertexcolors"),
        ('<emitter type="sky"><float name="stretch" value="1.2"/></emitter>', "light", "stretch"),
        ('<emitter type="collimated"/>', "light", "collimated"),
        ('<emitter type="envmap"><string name="filename" value="grey.png"/><float name="gamma" value="1"/></emitter>',
         "light", "gamma"),
        ('<shape type="disk"><bsdf type="phong"><texture name="exponent" type="checkerboard"/></bsdf></shape>',
         "colour", "exponent"),
        (f'<shape type="disk">{MIXTURE.format(".5, .2")}</shape>', "colour", "mixturebsdf"),
        ('<shape type="disk"><bsdf type="coating"><bsdf type="diffuse"/></bsdf></shape>', "colour", "coating"),
        ('<shape type="disk"><bsdf type="mask"><rgb name="opacity" value=".9 .1 .1"/><bsdf type="diffuse"/></bsdf>'
         "</shape>",
         "colour", "opacity"),
        ('<shape type="heightfield"/>', "geometry", "heightfield"),
        ('<shape type="sphere"><subsurface type="dipole"/></shape>', "colour", "subsurface"),
        ('<shape type="obj"><string name="filename" value="it.obj"/></shape>', "colour", "mtllib"),
        ('<shape type="obj"><string name="filename" value="it.obj"/><bsdf type="diffuse" name="Red"/>'
         '<bsdf type="diffuse" name="BlueWall"/></shape>', "colour", "usemtl"),
        ('<shape type="sphere"><float name="maxSmoothAngle" value="30"/></shape>', "geometry", "maxSmoothAngle"),
    ],
)  # fmt: skip
def test_what_0_6_has_and_mitsuba_3_has_not_is_a_loss_by_its_name(
    write: Callable[..., Path], loaded: Loaded, tmp_path: Path, content: str, effect: str, name: str
) -> None:
    Image.fromarray(np.full((4, 8, 3), 128, np.uint8)).save(tmp_path / "grey.png")
    save_radiance(np.full((4, 8, 3), 0.5, np.float32), tmp_path / "it.exr")
    (tmp_path / "it.obj").write_text(
        "mtllib it.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl Red\nf 1 2 3\nusemtl BlueWall\nf 3 2 1\n"
    )
    if content.startswith("<texture"):
        textured = content.replace("<texture", '<texture name="reflectance"', 1)
        content = f'<shape type="rectangle"><bsdf type="diffuse">{textured}</bsdf></shape>'
    scene, _ = loaded(write(SPHERE + content, "0.6.0"))
    assert [(change.effect, change.name) for change in scene.changes if change.effect] == [(effect, name)]


def test_shapes_without_ids_get_stable_ones_by_material_and_order(write: Callable[..., Path], read: Read) -> None:
    bsdf = '<bsdf type="diffuse" id="OakMaterial"/>'
    shapes = '<shape type="sphere"><ref id="OakMaterial"/></shape>' * 2
    path = write(bsdf + shapes + SPHERE + '<shape type="cube"/>' + '<shape type="disk" id=""/>')
    first, second = ([shape.get("id") for shape in read(path).root.findall("shape")] for _ in (1, 2))
    assert first == second == ["Oak", "Oak_2", "Ball", "cube", "disk"]


@pytest.mark.parametrize(("kind", "width"), [("phong", '<float name="exponent" value="98"/>'), ("ward", "")])
def test_glossy_materials_of_0_6_reflect_as_much(
    write: Callable[..., Path], loaded: Loaded, kind: str, width: str
) -> None:
    for written, expected in (
        ("", 0.7),  # 0.5 diffuse and 0.2 specular, the defaults
        ('<rgb name="specularReflectance" value="0.4 0.2 0.1"/><spectrum name="diffuseReflectance" value="0.1"/>', 0.5),
        ('<spectrum name="specularReflectance" value="1"/>', 1),  # energy is conserved
    ):
        _, made = loaded(write(f'<shape type="disk"><bsdf type="{kind}">{width}{written}</bsdf></shape>', "0.6.0"))
        count = 10000
        hit = dr.zeros(mi.SurfaceInteraction3f, count)
        hit.wi = mi.Vector3f(0, 0, 1)
        random = mi.PCG32(count)
        points = mi.Point2f(random.next_float32(), random.next_float32())
        _, weight = made.shapes()[0].bsdf().sample(mi.BSDFContext(), hit, random.next_float32(), points)
        assert np.array(weight[0]).mean() == pytest.approx(expected, rel=0.02)


def test_what_looks_at_something_has_the_up_of_0_6(write: Callable[..., Path], read: Read) -> None:
    sensor = '<sensor type="perspective"><transform name="toWorld"><lookAt origin="0 0 0" target="1 0 0"/></transform>'
    assert read(write(f"{sensor}</sensor>{SPHERE}", "0.6.0")).up == (0, -1, 0)  # by 0.6's coordinateSystem


def test_what_no_shape_uses_is_no_loss(write: Callable[..., Path], loaded: Loaded) -> None:
    unused = '<bsdf type="velvet" id="Unused"><bsdf type="diffuse" id="Inner"/></bsdf><bsdf type="velvet" id="Alone"/>'
    scene, made = loaded(write('<shape type="sphere" id="Ball"><ref id="Inner"/></shape>' + unused))
    assert [shape.id() for shape in made.shapes()] == ["Ball"]
    assert not [change for change in scene.changes if change.places == ["scene.xml: line 2: <bsdf> 'Alone'"]]
    gone = (
        '<shape type="shapegroup" id="G"><shape type="ply"><string name="filename" value="gone.ply"/></shape></shape>'
    )
    assert not list(loaded(write(gone + SPHERE))[0].changes)


def test_a_shape_that_the_scene_names_twice_is_there_once(write: Callable[..., Path], loaded: Loaded) -> None:
    assert len(loaded(write(f'{SPHERE}<ref id="Ball"/>'))[1].shapes()) == 1


def test_media_are_left_out_and_named_with_shape_and_line(write: Callable[..., Path], read: Read) -> None:
    content = (
        """<medium type="homogeneous" id="fog"/>
      <bsdf type="dielectric" id="Glass"/>
      <shape type="sphere" id="Jar"><ref id="Glass"/><ref name="interior" id="fog"/></shape>
      <shape type="cube" id="Cloud"><bsdf type="null"/><medium name="interior" type="homogeneous"/></shape>"""
        + SPHERE
    )
    path = write(content)
    with pytest.raises(SpecError, match=r"line 2: <medium> 'fog'.*scene import"):
        SceneFile.read(path)
    scene = read(path)
    assert [shape.get("id") for shape in scene.root.findall("shape")] == ["Jar", "Ball"]
    assert [(change.effect, change.name, change.places) for change in scene.changes] == [
        ("colour", "medium", ["scene.xml: line 4: <shape> 'Jar'"]),
        ("geometry", "medium", ["scene.xml: line 5: <shape> 'Cloud'"]),
    ]
    assert not list(scene.root.iter("medium"))


def test_instances_beyond_the_most_are_counted(
    write: Callable[..., Path], read: Read, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mitsuba_parts, "MOST", 1)
    content = '<shape type="shapegroup" id="Group"><shape type="cube"/></shape>'
    scene = read(write(content + '<shape type="instance"><ref id="Group"/></shape>' * 4))
    assert "geometry differs: instance: 3 of 4 are missing" in " ".join(map(str, scene.changes))


def test_instances_become_shapes_where_they_stand(write: Callable[..., Path], loaded: Loaded) -> None:
    content = """<shape type="shapegroup" id="Group"><shape type="cube" id="Part">
        <transform name="to_world"><translate x="1"/></transform></shape></shape>
      <shape type="instance"><ref id="Group"/><transform name="to_world"><scale value="2"/></transform></shape>
      <shape type="instance"><ref id="Group"/></shape>"""
    _, made = loaded(write(content))
    assert [shape.id() for shape in made.shapes()] == ["Part_1", "Part_2"]
    assert [float(shape.bbox().max[0]) for shape in made.shapes()] == [4, 2]


@pytest.mark.parametrize(
    ("kind", "inside", "step"),
    [
        ("sphere", "", '<scale x="-1"/>'),
        ("sphere", '<boolean name="flip_normals" value="true"/>', '<scale value="-2"/>'),
        ("sphere", '<point name="center" x=".1" y="0" z="0"/>', '<scale value="2"/>'),
        ("cylinder", '<point name="p0" x="-1" y="0" z="0"/>', '<scale x="-1"/>'),
        ("disk", "", '<scale x="-1"/>'),
        ("rectangle", "", '<scale x="-1"/>'),
        ("cube", "", '<scale x="-1"/>'),
        ("cube", '<boolean name="face_normals" value="true"/>', '<scale x="-1"/>'),
        ("ply", "", '<scale x="-1"/>'),
        ("obj", "", '<scale x="-1"/>'),
        ("obj", '<boolean name="face_normals" value="true"/>', '<scale z="-1"/>'),
        ("obj", '<boolean name="flip_normals" value="true"/>', '<scale x="-2"/>'),
        ("ply", '<transform name="to_world"><scale y="-1"/></transform>', '<scale x="-2" y="1"/>'),
    ],
)
def test_instances_have_the_surface_and_the_front_that_mitsuba_gives_them(
    write: Callable[..., Path], loaded: Loaded, tmp_path: Path, kind: str, inside: str, step: str
) -> None:
    (tmp_path / "it.obj").write_text("v -1 -1 0\nv 1 -1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n")
    header = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property float {name}\n" for name in "xyzuv")
    header += "element face 1\nproperty list uchar int vertex_index\nend_header\n"
    (tmp_path / "it.ply").write_text(header + "-1 -1 0 0 0\n1 -1 0 1 0\n0 1 0 0 1\n3 0 1 2\n")
    named = f'<string name="filename" value="it.{kind}"/>' if kind in ("obj", "ply") else ""
    path = write(f"""<shape type="shapegroup" id="Group"><shape type="{kind}">{named}{inside}</shape></shape>
      <shape type="instance"><ref id="Group"/><transform name="to_world">{step}</transform></shape>""")
    scene, made = loaded(path)
    meant = mi.load_file(str(path))
    hit, expected = (each.ray_intersect(mi.Ray3f([-0.3, 0.2, 9], [0, 0, -1])) for each in (made, meant))
    assert not [change for change in scene.changes if change.effect]
    assert np.array(hit.p).ravel() == pytest.approx(np.array(expected.p).ravel(), abs=2e-3)
    assert np.array(hit.sh_frame.n).ravel() == pytest.approx(np.array(expected.sh_frame.n).ravel(), abs=0.02)
    assert np.array(hit.uv).ravel() == pytest.approx(np.array(expected.uv).ravel(), abs=0.02)


def test_round_shapes_stay_round_where_instances_stretch_them(write: Callable[..., Path], read: Read) -> None:
    content = '<shape type="shapegroup" id="G"><shape type="sphere" id="Ball"/></shape><shape type="instance">'
    scene = read(write(f'{content}<ref id="G"/><transform name="to_world"><scale x="2"/></transform></shape>'))
    assert [(change.effect, change.name) for change in scene.changes if change.effect] == [("geometry", "sphere")]


def test_names_values_and_paths_are_resolved_by_mitsuba(
    write: Callable[..., Path], loaded: Loaded, tmp_path: Path
) -> None:
    (tmp_path / "parts/images").mkdir(parents=True)
    Image.fromarray(np.full((4, 4, 3), 128, np.uint8)).save(tmp_path / "parts/images/grey.png")
    (tmp_path / "parts/more.xml").write_text('<scene version="2.1.0"><default name="colour" value=".3"/>\n'
        '<bsdf type="diffuse" id="first"><rgb name="reflectance" value="$colour"/></bsdf>'
        '<alias id="first" as="second"/><include filename="ball.xml"/></scene>')  # fmt: skip
    (tmp_path / "parts/ball.xml").write_text('<scene version="0.5.0"><shape type="sphere" id="Ball"><ref id="second"/>'
        '<float name="radius" value="$r"/><srgb name="wobbleIt" value=".5"/></shape></scene>')  # fmt: skip
    content = """<default name="r" value="2"/><default name="file" value="more"/><path value="parts/images"/>
      <include filename="parts/$file.xml"/>
      <shape type="disk" id="Plate"><transform name="to_world"><translate z="3"/></transform><bsdf type="diffuse">
        <texture name="reflectance" type="bitmap"><string name="filename" value="grey.png"/></texture></bsdf></shape>"""
    scene, made = loaded(write(content))
    assert sorted(shape.id() for shape in made.shapes()) == ["Ball", "Plate"]
    assert reflectance(made, 1.5, 0) == pytest.approx([0.3] * 3)
    assert reflectance(made, 0, 0) == pytest.approx([0.216] * 3, abs=1e-3)
    assert [str(change) for change in scene.changes] == [
        "geometry differs: wobbleIt: is not known to Mitsuba 3, and is left out (ball.xml: line 1: <shape> 'Ball')"
    ]


def test_what_mitsuba_does_not_know_is_left_out_or_replaced_and_named(
    write: Callable[..., Path], loaded: Loaded
) -> None:
    content = """<bsdf type="velvet" id="Velvet"><rgb name="reflectance" value=".3"/></bsdf>
      <shape type="sphere" id="Ball"><ref id="Velvet"/><float name="wobble" value="1"/></shape>
      <shape type="hair" id="Fur"><string name="filename" value="fur.hair"/></shape>
      <emitter type="laser"/><emitter type="constant"/>"""
    scene, made = loaded(write(content))
    assert [shape.id() for shape in made.shapes()] == ["Ball"]
    assert "0.3" in str(made.shapes()[0].bsdf())
    assert len(made.emitters()) == 1
    lost = {change.name: (change.effect, change.places) for change in scene.changes}
    assert lost == {
        "velvet": ("colour", ["scene.xml: line 2: <bsdf> 'Velvet'"]),
        "wobble": ("geometry", ["scene.xml: line 3: <shape> 'Ball'"]),
        "hair": ("geometry", ["scene.xml: line 4: <shape> 'Fur'"]),
        "laser": ("light", ["scene.xml: line 5: <emitter>"]),
    }


def test_the_camera_says_where_the_room_is_and_which_axis_is_up(write: Callable[..., Path], read: Read) -> None:
    sensor = '<sensor type="perspective"><transform name="to_world">'
    sensor += '<lookat origin="1, 2, 3" target="5, 2, 3" up="0, 0, 1"/></transform></sensor>'
    scene = read(write(sensor + SPHERE))
    assert scene.camera == pytest.approx((1, 2, 3))
    assert scene.up == (0, 0, 1)
    assert read(write(SPHERE)).up == (0, 1, 0)


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("<shape", "not a readable"),
        ("", "no shape"),
        ('<shape type="ply"><string name="filename" value="gone.ply"/></shape>', "line 2: file 'gone.ply'"),
        ('<include filename="gone.xml"/>', "gone.xml"),
        ('<shape type="sphere"><float name="radius" value="$r"/></shape>', r"\$r"),
        ('<shape type="sphere"><ref id="Nothing"/></shape>', "line 2: .*Nothing"),
        (
            '<bsdf type="conductor" id="C"><string name="material" value="Foo"/></bsdf>'
            '<shape type="sphere"><ref id="C"/></shape>',
            "scene.xml: line 2: <bsdf> 'C': Mitsuba cannot load it: .*Foo",
        ),
        ('<include filename="scene.xml"/>', "line 2: .* includes itself"),
        ("&gone;", "undefined entity: line 2.*gone"),
        (SPHERE * 2, "line 2: duplicate ID: .Ball"),
        (
            f'{SPHERE}<emitter type="point"><rgb name="intensity" value="1 nan 1"/></emitter>',
            "line 2: <rgb> 'intensity': nan",
        ),
        (
            f'{SPHERE}<emitter type="constant"><float name="radiance" value="1e39"/></emitter>',
            r"line 2: <float> 'radiance': 1e\+39",
        ),
        (
            '<shape type="sphere"><transform name="to_world"><scale value="inf"/></transform></shape>',
            "line 2: .*to_world",
        ),
        (
            '<shape type="sphere"/><emitter type="constant"/>\n<emitter type="sunsky"/>',
            "line 2: .* and .*line 3: .*keep one .*sunsky",
        ),
    ],
)
def test_what_is_wrong_is_named(write: Callable[..., Path], loaded: Loaded, content: str, named: str) -> None:
    with pytest.raises(SpecError, match=named):
        loaded(write(content))


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ('<bsdf type="diffuse"><texture type="scale" name="reflectance"/></bsdf>', "line 2: .*no texture to scale"),
        ('<transform name="toWorld"><lookat origin="0 0 5" target="0 0"/></transform>', "line 2: .* got 2"),
        ('<transform name="toWorld"><lookAt target="0 0 0" up="0 1 0"/></transform>', "line 2: .*origin"),
        ('<emitter type="area"/></shape><emitter type="sun"/><emitter type="sky"/><shape type="disk">',
         "line 2: .* and .*line 2: .*keep one"),
    ],
)  # fmt: skip
def test_what_is_wrong_in_0_6_is_named(write: Callable[..., Path], loaded: Loaded, content: str, named: str) -> None:
    with pytest.raises(SpecError, match=named):
        loaded(write(f'<shape type="rectangle">{content}</shape>', "0.6.0"))


def test_terms_before_0_4_are_refused(write: Callable[..., Path], read: Read) -> None:
    with pytest.raises(SpecError, match=r"is of Mitsuba 0\.3\.0"):
        read(write('<luminaire type="point"/>', "0.3.0"))


@pytest.mark.parametrize("entity", ['<shape type="&s;"/>', '<shape type="sphere">&s;</shape>'])
def test_entities_of_other_files_are_refused(tmp_path: Path, loaded: Loaded, entity: str) -> None:
    path = tmp_path / "scene.xml"
    path.write_text(f'<!DOCTYPE scene SYSTEM "s.dtd" [<!ENTITY t "cube">]><scene version="3.0.0">\n{entity}</scene>')
    with pytest.raises(SpecError, match="line 2: entity 's'"):
        loaded(path)
    path.write_text(path.read_text().replace(entity, '<shape type="&t;" id="a&gt;b"/>'))
    assert len(loaded(path)[1].shapes()) == 1


@pytest.mark.parametrize("binary", [False, True])
def test_faces_of_vertices_that_are_not_there_are_named(
    write: Callable[..., Path], loaded: Loaded, tmp_path: Path, binary: bool
) -> None:
    header = f"ply\nformat {'binary_little_endian' if binary else 'ascii'} 1.0\nelement vertex 4\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4")
    path = write('<shape type="ply"><string name="filename" value="it.ply"/></shape>')
    for last in (3, 4):
        faces = np.array([[3, 0, 1, 2], [3, 0, 1, last]])
        packed = b"".join(bytes([3]) + face[1:].astype("<i4").tobytes() for face in faces)
        body = "\n".join(" ".join(map(str, row)) for row in [*corners.tolist(), *faces.tolist()]).encode()
        (tmp_path / "it.ply").write_bytes(header.encode() + (corners.tobytes() + packed if binary else body))
        if last == 3:
            loaded(path)
    with pytest.raises(SpecError, match=r"line 2: <shape>.*it\.ply: face 1 names vertex 4, and it has 4"):
        loaded(path)


def test_settings_of_the_renderer_are_said_where_they_mean_another_picture(
    write: Callable[..., Path], read: Read
) -> None:
    content = '<integrator type="direct"><boolean name="hideEmitters" value="true"/></integrator>'
    scene = read(write(content + '<sensor type="thinlens"/>' + SPHERE, "0.6.0"))
    assert [change.name for change in scene.changes] == ["hide_emitters", "direct", "thinlens"]
    assert not list(read(write('<integrator type="path"/><sensor type="perspective"/>' + SPHERE)).changes)


def test_a_spec_of_shapes_without_ids_is_told_of_the_import(write: Callable[..., Path]) -> None:
    from photonfarm.shared.scene.spec_loading import parse_spec

    path = write('<shape type="sphere"/>')
    everywhere = {"min": [0, 0, 0], "max": [1, 1, 1]}
    described = {"name": "it", "scene": {"file": str(path)}, "view": {"origin": everywhere, "look_at": everywhere},
                 "objects": [{"name": "ball", "shapes": ["Ball"], "at": [0, 0, 0], "box": everywhere}]}  # fmt: skip
    with pytest.raises(SpecError, match=r"no ids; `photonfarm scene import`"):
        parse_spec(described, where="spec")


def test_a_phong_with_a_texture_keeps_its_texels(write: Callable[..., Path], loaded: Loaded) -> None:
    texture = '<texture name="diffuseReflectance" type="checkerboard"><rgb name="color0" value="0.8"/></texture>'
    scene, made = loaded(write(f'<shape type="rectangle"><bsdf type="phong">{texture}</bsdf></shape>', "0.6.0"))
    assert {(change.effect, change.name) for change in scene.changes} == {(None, "phong"), (None, "")}
    assert "RoughPlastic" in str(made.shapes()[0].bsdf())


def test_shapes_of_a_group_and_copied_files_keep_apart(write: Callable[..., Path], loaded: Loaded) -> None:
    group = '<shape type="shapegroup" id="g"><shape type="cube"/><shape type="sphere"/></shape>'
    instances = '<shape type="instance"><ref id="g"/></shape>' * 2
    assert len(loaded(write(f'{group}{instances}<shape type="cube" id="g_1"/>'))[1].shapes()) == 5


@pytest.mark.parametrize("kind", ["rotate", "matrix", "translate"])
def test_transforms_that_are_no_numbers_are_refused(write: Callable[..., Path], read: Read, kind: str) -> None:
    step = {"rotate": '<rotate x="1" angle="nan"/>', "translate": '<translate x="nan"/>',
            "matrix": f'<matrix value="nan {"0 " * 15}"/>'}[kind]  # fmt: skip
    with pytest.raises(SpecError, match="line 2"):
        read(write(f'<shape type="cube"><transform name="to_world">{step}</transform></shape>'))


def test_a_spectrum_that_lamps_refer_to_is_not_cut_to_what_reflects(write: Callable[..., Path], read: Read) -> None:
    spectrum = '<texture type="regular" id="L"><string name="values" value="10, 20, 30"/></texture>'
    lamp = '<shape type="sphere"><emitter type="area"><ref name="radiance" id="L"/></emitter></shape>'
    (found,) = read(write(spectrum + lamp)).root.iter("rgb")
    assert max(map(float, found.get("value", "").split(","))) > 10
