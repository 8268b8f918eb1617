"""Mitsuba's XML as it is imported: old versions upgraded, what cannot be rendered left out and named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonfarm.renderer.importing.elements import child
from photonfarm.renderer.importing.imported import ImportedScene
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
    assert "alpha = [0.2]" in str(shiny.bsdf())  # √(2 / 50)
    assert "0.1, 0.2, 0.3" in str(shiny.bsdf())
    assert "0.5" in str(chess.bsdf())
    assert made.emitters()[0].class_name() == "SunskyEmitter"
    notes = " ".join(scene.notes)
    for said in ("'phong'", "'sky'", "'unknown_thing'", "3 of 3 shapes"):
        assert said in notes


def test_shapes_without_ids_get_stable_ones_by_material_and_order(write: Callable[..., Path], read: Read) -> None:
    bsdf = '<bsdf type="diffuse" id="OakMaterial"/>'
    shapes = '<shape type="sphere"><ref id="OakMaterial"/></shape>' * 2
    path = write(bsdf + shapes + SPHERE + '<shape type="cube"/>' + '<shape type="disk" id="Ball"/>')
    first, second = ([shape.get("id") for shape in read(path).root.findall("shape")] for _ in (1, 2))
    assert first == second == ["Oak", "Oak_2", "Ball", "cube", "disk"]


def test_media_are_left_out_and_named_with_shape_and_line(write: Callable[..., Path], read: Read) -> None:
    content = (
        """<medium type="homogeneous" id="fog"/>
      <bsdf type="dielectric" id="Glass"/>
      <shape type="sphere" id="Jar"><ref id="Glass"/><ref name="interior" id="fog"/></shape>
      <shape type="cube" id="Cloud"><medium name="interior" type="homogeneous"/></shape>"""
        + SPHERE
    )
    path = write(content)
    with pytest.raises(SpecError, match=r"line 2: <medium> 'fog'.*scene import"):
        SceneFile.read(path)
    scene = read(path)
    assert [shape.get("id") for shape in scene.root.findall("shape")] == ["Jar", "Ball"]
    assert [note.split(":")[0] for note in scene.notes] == ["line 4", "line 5"]
    assert not list(scene.root.iter("medium"))


def test_instances_become_shapes_where_they_stand(write: Callable[..., Path], loaded: Loaded) -> None:
    content = """<shape type="shapegroup" id="Group"><shape type="cube" id="Part">
        <transform name="to_world"><translate x="1"/></transform></shape></shape>
      <shape type="instance"><ref id="Group"/><transform name="to_world"><scale value="2"/></transform></shape>
      <shape type="instance"><ref id="Group"/></shape>"""
    _, made = loaded(write(content))
    assert [shape.id() for shape in made.shapes()] == ["Part_1", "Part_2"]
    assert [float(shape.bbox().max[0]) for shape in made.shapes()] == [4, 2]


def test_included_files_and_values_are_put_in_their_places(
    write: Callable[..., Path], read: Read, tmp_path: Path
) -> None:
    (tmp_path / "more.xml").write_text(f'<scene version="3.0.0">{SPHERE}</scene>')
    path = write('<default name="r" value="3"/><include filename="more.xml"/>'
                 '<shape type="disk" id="Plate"><float name="radius" value="$r"/></shape>')  # fmt: skip
    shapes = read(path).root.findall("shape")
    assert [shape.get("id") for shape in shapes] == ["Ball", "Plate"]
    radius = child(shapes[1], "radius")
    assert radius is not None
    assert radius.get("value") == "3"


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
    assert len(scene.notes) == 4
    for note, named in zip(sorted(scene.notes), ("velvet", "wobble", "hair", "laser"), strict=True):
        assert named in note


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
        ('<shape type="sphere"><ref id="Nothing"/></shape>', "Nothing"),
    ],
)
def test_what_is_wrong_is_named(write: Callable[..., Path], loaded: Loaded, content: str, named: str) -> None:
    with pytest.raises(SpecError, match=named):
        loaded(write(content))


def test_a_spec_of_shapes_without_ids_is_told_of_the_import(write: Callable[..., Path]) -> None:
    from photonfarm.shared.scene.spec_loading import parse_spec

    path = write('<shape type="sphere"/>')
    everywhere = {"min": [0, 0, 0], "max": [1, 1, 1]}
    described = {"name": "it", "scene": {"file": str(path)}, "view": {"origin": everywhere, "look_at": everywhere},
                 "objects": [{"name": "ball", "shapes": ["Ball"], "at": [0, 0, 0], "box": everywhere}]}  # fmt: skip
    with pytest.raises(SpecError, match=r"no ids; `photonfarm scene import`"):
        parse_spec(described, where="spec")
