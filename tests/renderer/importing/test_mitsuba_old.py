"""Mitsuba's XML of version 0.6, in the terms of Mitsuba 3."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from imported_scenes import SPHERE, Loaded, Read, from_sky, reflectance
from PIL import Image

from photonfarm.core.errors import SpecError
from photonfarm.renderer.tools.importing.images import save_radiance


def test_names_of_version_0_6_are_those_of_version_3(write_xml: Callable[..., Path], loaded: Loaded) -> None:
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
    scene, made = loaded(write_xml(content, "0.6.0"))
    red, shiny, chess = made.shapes()
    assert np.array(red.bbox().max) == pytest.approx([2, 2, 2])
    assert "eta = [1.39" in str(red.bsdf())
    assert "alpha = [0.1]" in str(shiny.bsdf())  # 1 / √(2 · 50)
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
        ('<spectrum name="reflectance" value=".1, .2, .3"/>', [0.1, 0.2, 0.3]),
        ('<spectrum name="reflectance" value="0.3" intent="reflectance"/>', [0.3] * 3),
        ('<spectrum name="reflectance" value="400:.5, 700:.5"/>', [0.6, 0.475, 0.452]),  # of no white point
        ('<xyz name="reflectance" value=".3, .3, .3"/>', [0.361, 0.285, 0.273]),
    ],
)
def test_colours_of_0_6_are_those_of_its_rgb_mode(
    write_xml: Callable[..., Path], loaded: Loaded, written: str, expected: list[float]
) -> None:
    _, made = loaded(write_xml(f'<shape type="rectangle"><bsdf type="diffuse">{written}</bsdf></shape>', "0.6.0"))
    assert reflectance(made, 0.1, 0.1) == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ("", [0.216, 0.051, 1]),
        ('<float name="gamma" value="1"/>', [0.502, 0.251, 1]),
        ('<float name="gamma" value="-1"/>', [0.216, 0.051, 1]),
        ('<string name="filterType" value="ewa"/><boolean name="cache" value="true"/>', [0.216, 0.051, 1]),
    ],
)
def test_bitmaps_of_0_6_are_read_as_they_say(
    write_xml: Callable[..., Path], loaded: Loaded, tmp_path: Path, said: str, expected: list[float]
) -> None:
    Image.fromarray(np.full((2, 2, 4), (128, 64, 255, 204), np.uint8)).save(tmp_path / "it.png")
    content = f'<texture name="reflectance" type="bitmap"><string name="filename" value="it.png"/>{said}</texture>'
    content = f'<shape type="rectangle" id="Plate"><bsdf type="diffuse">{content}</bsdf></shape>'
    scene, made = loaded(write_xml(content, "0.6.0"))
    assert reflectance(made, 0.1, 0.1) == pytest.approx(expected, abs=1e-3)
    assert not list(scene.changes)


def test_textures_of_0_6_are_moved_and_named_as_they_say(
    write_xml: Callable[..., Path], loaded: Loaded, tmp_path: Path
) -> None:
    Image.fromarray(np.array([[0, 255]], np.uint8)).save(tmp_path / "it.png")
    named = '<string name="filename" value="it.png"/><string name="filterType" value="nearest"/>'
    content = f"""<shape type="rectangle"><bsdf type="diffuse"><texture type="scale" id="S" name="reflectance">
        <texture type="bitmap">{named}<float name="voffset" value="1"/></texture></texture></bsdf></shape>
        <shape type="rectangle"><transform name="toWorld"><translate x="4"/></transform>
        <bsdf type="diffuse"><ref name="reflectance" id="S"/></bsdf></shape>"""
    scene, made = loaded(write_xml(content, "0.6.0"))
    assert [reflectance(made, x, 0)[0] for x in (-0.5, 0.5, 4.5)] == pytest.approx([0, 1, 1])
    matrix = scene.root.find("texture/transform/matrix")
    assert matrix is not None
    assert matrix.get("value", "").split()[6:8] == ["0", "1"]  # v · 1 + 1


def test_light_of_0_6_has_its_colour_and_level(write_xml: Callable[..., Path], loaded: Loaded) -> None:
    for written, expected in (
        ('<spectrum name="radiance" value="2"/>', [2, 2, 2]),  # Mitsuba 3: 2.4, 1.9, 1.8
        ('<blackbody name="radiance" temperature="3000K" scale="0.01"/>', [7.331, 3.496, 1.127]),  # Planck's law
    ):
        _, made = loaded(write_xml(f'<emitter type="constant">{written}</emitter>{SPHERE}', "0.6.0"))
        assert from_sky(made, np.array([[0, 0, 1]]))[0] == pytest.approx(expected, rel=1e-3)


def test_the_sun_of_0_6_stands_where_its_place_and_time_say(write_xml: Callable[..., Path], loaded: Loaded) -> None:
    place = '<float name="hour" value="9.5"/><float name="latitude" value="52"/><float name="longitude" value="5"/>'
    content = f'<emitter type="sun">{place}<float name="timezone" value="1"/></emitter>{SPHERE}'
    _, made = loaded(write_xml(content, "0.6.0"))
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


@pytest.mark.parametrize(
    ("written", "described", "said"),
    [
        ('<bsdf type="conductor"/>', "0.201005, 0.92375, 1.10222", None),  # copper
        ('<bsdf type="roughdielectric"><string name="distribution" value="phong"/></bsdf>', "beckmann", "distribution"),
        ('<bsdf type="roughdiffuse"><float name="alpha" value=".3"/></bsdf>', "SmoothDiffuse", "roughdiffuse"),
        (
            '<bsdf type="conductor"><spectrum name="eta" value="1.5"/><spectrum name="k" value="400:3, 700:3"/></bsdf>',
            "1.5, 1.5, 1.5",
            None,
        ),
        (
            '<texture type="checkerboard" id="T"/><texture type="scale" id="S"><float name="scale" value=".25"/>'
            '<ref id="T"/></texture><bsdf type="bumpmap"><ref id="S"/><bsdf type="diffuse"/></bsdf>',
            "scale = 0.25",
            None,
        ),
        (
            '<texture type="bitmap" id="T"><string name="filename" value="n.png"/><float name="gamma" value="1"/>'
            '</texture><bsdf type="normalmap"><ref id="T"/><bsdf type="diffuse"/></bsdf>',
            "NormalMap",
            None,
        ),
        (
            '<bsdf type="bumpmap"><texture type="scale"><float name="scale" value=".25"/><texture type="checkerboard"/>'
            '</texture><bsdf type="diffuse"/></bsdf>',
            "scale = 0.25",
            None,
        ),
    ],
)
def test_materials_of_0_6_have_its_defaults_or_are_the_nearest(
    write_xml: Callable[..., Path], loaded: Loaded, tmp_path: Path, written: str, described: str, said: str | None
) -> None:
    Image.fromarray(np.full((2, 2, 3), (128, 128, 255), np.uint8)).save(tmp_path / "n.png")
    textures, bsdf, rest = written.partition("<bsdf")
    scene, made = loaded(write_xml(f'{textures}<shape type="rectangle" id="Plate">{bsdf}{rest}</shape>', "0.6.0"))
    assert described in " ".join(str(made.shapes()[0].bsdf()).split())
    assert [change.name for change in scene.changes if change.effect is None] == ([said] if said else [])
    assert not [change for change in scene.changes if change.effect]


@pytest.mark.parametrize(
    ("content", "effect", "name"),
    [
        (
            '<texture type="bitmap"><string name="filename" value="it.exr"/><float name="gamma" value="2.2"/>'
            "</texture>",
            "colour",
            "gamma",
        ),
        (
            '<texture type="bitmap"><string name="filename" value="grey.png"/><string name="wrapModeU" value="clamp"/>'
            "</texture>",
            "colour",
            "wrapMode",
        ),
        (
            '<texture type="scale"><float name="scale" value=".5"/><texture type="checkerboard"/></texture>',
            "colour",
            "scale",
        ),
        ('<texture type="vertexcolors"/>', "colour", "vertexcolors"),
        ('<emitter type="sky"><float name="stretch" value="1.2"/></emitter>', "light", "stretch"),
        ('<emitter type="collimated"/>', "light", "collimated"),
        (
            '<emitter type="envmap"><string name="filename" value="grey.png"/><float name="gamma" value="1"/>'
            "</emitter>",
            "light",
            "gamma",
        ),
        (
            '<texture type="bitmap"><string name="filename" value="grey.png"/><string name="channel" value="a"/>'
            "</texture>",
            "colour",
            "channel",
        ),
        ('<shape type="disk"><bsdf type="ward"/></shape>', "colour", "ward"),
        ('<shape type="disk"><bsdf type="mixturebsdf"><bsdf type="diffuse"/></bsdf></shape>', "colour", "mixturebsdf"),
        ('<shape type="disk"><bsdf type="coating"><bsdf type="diffuse"/></bsdf></shape>', "colour", "coating"),
        (
            '<shape type="disk"><bsdf type="mask"><rgb name="opacity" value=".9 .1 .1"/><bsdf type="diffuse"/></bsdf>'
            "</shape>",
            "colour",
            "opacity",
        ),
        ('<shape type="heightfield"/>', "geometry", "heightfield"),
        ('<shape type="sphere"><subsurface type="dipole"/></shape>', "colour", "subsurface"),
        ('<shape type="obj"><string name="filename" value="it.obj"/></shape>', "colour", "mtllib"),
        ('<shape type="sphere"><float name="maxSmoothAngle" value="30"/></shape>', "geometry", "maxSmoothAngle"),
    ],
)
def test_what_0_6_has_and_mitsuba_3_has_not_is_a_loss_by_its_name(
    write_xml: Callable[..., Path], loaded: Loaded, tmp_path: Path, content: str, effect: str, name: str
) -> None:
    Image.fromarray(np.full((4, 8, 3), 128, np.uint8)).save(tmp_path / "grey.png")
    save_radiance(np.full((4, 8, 3), 0.5, np.float32), tmp_path / "it.exr")
    (tmp_path / "it.obj").write_text(
        "mtllib it.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl Red\nf 1 2 3\nusemtl BlueWall\nf 3 2 1\n"
    )
    if content.startswith("<texture"):
        textured = content.replace("<texture", '<texture name="reflectance"', 1)
        content = f'<shape type="rectangle"><bsdf type="diffuse">{textured}</bsdf></shape>'
    scene, _ = loaded(write_xml(SPHERE + content, "0.6.0"))
    assert [(change.effect, change.name) for change in scene.changes if change.effect] == [(effect, name)]


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ('<bsdf type="diffuse"><texture type="scale" name="reflectance"/></bsdf>', "line 2: .*no texture to scale"),
        ('<transform name="toWorld"><lookat origin="0 0 5" target="0 0"/></transform>', "line 2: .* got 2"),
        ('<transform name="toWorld"><lookAt target="0 0 0" up="0 1 0"/></transform>', "line 2: .*origin"),
        (
            '</shape><shape type="obj"><string name="filename" value="it.obj"/><bsdf type="diffuse" name="Red"/>'
            '<bsdf type="diffuse" name="BlueWall"/>',
            "line 2: <shape> .*single BSDF",
        ),
    ],
)
def test_what_is_wrong_in_0_6_is_named(
    write_xml: Callable[..., Path], loaded: Loaded, tmp_path: Path, content: str, named: str
) -> None:
    (tmp_path / "it.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(SpecError, match=named):
        loaded(write_xml(f'<shape type="rectangle">{content}</shape>', "0.6.0"))


def test_terms_before_0_4_are_refused(write_xml: Callable[..., Path], read: Read) -> None:
    with pytest.raises(SpecError, match=r"is of Mitsuba 0\.3\.0"):
        read(write_xml('<luminaire type="point"/>', "0.3.0"))


def test_a_phong_with_a_texture_keeps_its_texels(write_xml: Callable[..., Path], loaded: Loaded) -> None:
    texture = '<texture name="diffuseReflectance" type="checkerboard"><rgb name="color0" value="0.8"/></texture>'
    scene, made = loaded(write_xml(f'<shape type="rectangle"><bsdf type="phong">{texture}</bsdf></shape>', "0.6.0"))
    assert {(change.effect, change.name) for change in scene.changes} == {("colour", "phong"), (None, "")}
    assert "RoughPlastic" in str(made.shapes()[0].bsdf())
