"""Mitsuba's XML as it is imported: what cannot be rendered is left out and named, and instances become shapes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from imported_scenes import SPHERE, Loaded, Read, reflectance
from PIL import Image

from photonfarm.core.errors import SpecError
from photonfarm.renderer.tools.importing.readers import mitsuba_parts
from photonfarm.scene.files import SceneFile


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
    with pytest.raises(SpecError, match=r'entity .header. of file .header\.xml.*<include filename="header\.xml"/>'):
        loaded(case("mi06-entity/scene.xml"))


def test_shapes_without_ids_get_stable_ones_by_material_and_order(write_xml: Callable[..., Path], read: Read) -> None:
    bsdf = '<bsdf type="diffuse" id="OakMaterial"/>'
    shapes = '<shape type="sphere"><ref id="OakMaterial"/></shape>' * 2
    path = write_xml(bsdf + shapes + SPHERE + '<shape type="cube"/>' + '<shape type="disk" id=""/>')
    first, second = ([shape.get("id") for shape in read(path).root.findall("shape")] for _ in (1, 2))
    assert first == second == ["Oak", "Oak_2", "Ball", "cube", "disk"]


def test_what_no_shape_uses_is_no_loss(write_xml: Callable[..., Path], loaded: Loaded) -> None:
    unused = '<bsdf type="velvet" id="Unused"><bsdf type="diffuse" id="Inner"/></bsdf><bsdf type="velvet" id="Alone"/>'
    scene, made = loaded(write_xml('<shape type="sphere" id="Ball"><ref id="Inner"/></shape>' + unused))
    assert [shape.id() for shape in made.shapes()] == ["Ball"]
    assert not [change for change in scene.changes if change.places == ["scene.xml: line 2: <bsdf> 'Alone'"]]
    gone = (
        '<shape type="shapegroup" id="G"><shape type="ply"><string name="filename" value="gone.ply"/></shape></shape>'
    )
    assert not list(loaded(write_xml(gone + SPHERE))[0].changes)


def test_media_and_what_only_bounds_one_are_left_out_and_named(write_xml: Callable[..., Path], read: Read) -> None:
    content = (
        """<medium type="homogeneous" id="fog"/>
      <bsdf type="dielectric" id="Glass"/>
      <shape type="sphere" id="Jar"><ref id="Glass"/><ref name="interior" id="fog"/></shape>
      <shape type="cube" id="Cloud"><bsdf type="null"/><medium name="interior" type="homogeneous"/></shape>"""
        + SPHERE
    )
    path = write_xml(content)
    with pytest.raises(SpecError, match=r"line 2: <medium> 'fog'.*scene import"):
        SceneFile.read(path)
    scene = read(path)
    assert [shape.get("id") for shape in scene.root.findall("shape")] == ["Jar", "Ball"]
    assert [(change.effect, change.name, change.places) for change in scene.changes] == [
        ("colour", "medium", ["scene.xml: line 2: <medium> 'fog'", "scene.xml: line 5: <medium> 'interior'"]),
        (None, "null", ["scene.xml: line 5: <shape> 'Cloud'"]),
    ]
    assert not list(scene.root.iter("medium"))


def test_instances_beyond_the_most_are_counted(
    write_xml: Callable[..., Path], read: Read, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mitsuba_parts, "MOST", 1)
    content = '<shape type="shapegroup" id="Group"><shape type="cube"/></shape>'
    scene = read(write_xml(content + '<shape type="instance"><ref id="Group"/></shape>' * 4))
    assert "geometry differs: instance: 3 of 4 are missing" in " ".join(map(str, scene.changes))


@pytest.mark.parametrize(
    ("kind", "inside", "step"),
    [
        ("sphere", "", '<scale x="-1"/>'),
        ("sphere", '<boolean name="flip_normals" value="true"/>', '<scale value="-2"/>'),
        ("disk", "", '<scale x="-1"/>'),
        ("rectangle", "", '<scale x="-1"/>'),
        ("cube", "", '<scale x="-1" y="-1"/>'),
        ("ply", "", '<scale x="-1"/>'),
        ("obj", '<boolean name="face_normals" value="true"/>', '<scale z="-1"/>'),
        ("obj", '<boolean name="flip_normals" value="true"/>', '<scale x="-2"/>'),
        ("ply", '<transform name="to_world"><scale y="-1"/></transform>', '<scale x="-2" y="1"/>'),
    ],
)
def test_instances_have_the_surface_and_the_front_that_mitsuba_gives_them(
    write_xml: Callable[..., Path], loaded: Loaded, tmp_path: Path, kind: str, inside: str, step: str
) -> None:
    (tmp_path / "it.obj").write_text("v -1 -1 0\nv 1 -1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n")
    header = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property float {name}\n" for name in "xyzuv")
    header += "element face 1\nproperty list uchar int vertex_index\nend_header\n"
    (tmp_path / "it.ply").write_text(header + "-1 -1 0 0 0\n1 -1 0 1 0\n0 1 0 0 1\n3 0 1 2\n")
    named = f'<string name="filename" value="it.{kind}"/>' if kind in ("obj", "ply") else ""
    path = write_xml(f"""<shape type="shapegroup" id="Group"><shape type="{kind}">{named}{inside}</shape></shape>
      <shape type="instance"><ref id="Group"/><transform name="to_world">{step}</transform></shape>""")
    scene, made = loaded(path)
    meant = mi.load_file(str(path))
    hit, expected = (each.ray_intersect(mi.Ray3f([-0.3, 0.2, 9], [0, 0, -1])) for each in (made, meant))
    assert not [change for change in scene.changes if change.effect]
    assert np.array(hit.p).ravel() == pytest.approx(np.array(expected.p).ravel(), abs=2e-3)
    assert np.array(hit.sh_frame.n).ravel() == pytest.approx(np.array(expected.sh_frame.n).ravel(), abs=0.02)
    assert np.array(hit.uv).ravel() == pytest.approx(np.array(expected.uv).ravel(), abs=0.02)


@pytest.mark.parametrize(("kind", "by"), [("sphere", 2), ("cube", -1)])
def test_shapes_that_mitsuba_cannot_stretch_or_mirror_are_a_loss(
    write_xml: Callable[..., Path], read: Read, kind: str, by: int
) -> None:
    content = f'<shape type="shapegroup" id="G"><shape type="{kind}" id="Ball"/></shape><shape type="instance">'
    scene = read(write_xml(f'{content}<ref id="G"/><transform name="to_world"><scale x="{by}"/></transform></shape>'))
    assert [(change.effect, change.name) for change in scene.changes if change.effect] == [("geometry", kind)]


def test_names_values_and_paths_are_resolved_by_mitsuba(
    write_xml: Callable[..., Path], loaded: Loaded, tmp_path: Path
) -> None:
    (tmp_path / "parts/images").mkdir(parents=True)
    Image.fromarray(np.full((4, 4, 3), 128, np.uint8)).save(tmp_path / "parts/images/grey.png")
    (tmp_path / "parts/more.xml").write_text(
        '<scene version="2.1.0"><default name="colour" value=".3"/>\n'
        '<bsdf type="diffuse" id="first"><rgb name="reflectance" value="$colour"/></bsdf>'
        '<alias id="first" as="second"/><include filename="ball.xml"/></scene>'
    )
    (tmp_path / "parts/ball.xml").write_text(
        '<scene version="0.5.0"><shape type="sphere" id="Ball"><ref id="second"/>'
        '<float name="radius" value="$r"/><srgb name="wobbleIt" value=".5"/></shape></scene>'
    )
    content = """<default name="r" value="2"/><default name="file" value="more"/><path value="parts/images"/>
      <include filename="parts/$file.xml"/>
      <shape type="disk" id="Plate"><transform name="to_world"><translate z="3"/></transform><bsdf type="diffuse">
        <texture name="reflectance" type="bitmap"><string name="filename" value="grey.png"/></texture></bsdf></shape>"""
    scene, made = loaded(write_xml(content))
    assert sorted(shape.id() for shape in made.shapes()) == ["Ball", "Plate"]
    assert reflectance(made, 1.5, 0) == pytest.approx([0.3] * 3)
    assert reflectance(made, 0, 0) == pytest.approx([0.216] * 3, abs=1e-3)
    assert [str(change) for change in scene.changes] == [
        "geometry differs: wobbleIt: is not known to Mitsuba 3, and is left out (ball.xml: line 1: <shape> 'Ball')"
    ]


def test_what_mitsuba_does_not_know_is_left_out_or_replaced_and_named(
    write_xml: Callable[..., Path], loaded: Loaded
) -> None:
    content = """<bsdf type="velvet" id="Velvet"><rgb name="reflectance" value=".3"/></bsdf>
      <shape type="sphere" id="Ball"><ref id="Velvet"/><float name="wobble" value="1"/></shape>
      <shape type="hair" id="Fur"><string name="filename" value="fur.hair"/></shape>
      <emitter type="laser"/><emitter type="constant"><texture name="radiance" type="blackbody"/></emitter>"""
    scene, made = loaded(write_xml(content))
    assert [shape.id() for shape in made.shapes()] == ["Ball"]
    assert "0.3" in str(made.shapes()[0].bsdf())
    assert len(made.emitters()) == 1
    lost = {change.name: (change.effect, change.places) for change in scene.changes}
    assert lost == {
        "velvet": ("colour", ["scene.xml: line 2: <bsdf> 'Velvet'"]),
        "wobble": ("geometry", ["scene.xml: line 3: <shape> 'Ball'"]),
        "hair": ("geometry", ["scene.xml: line 4: <shape> 'Fur'"]),
        "laser": ("light", ["scene.xml: line 5: <emitter>"]),
        "blackbody": ("light", ["scene.xml: line 5: <texture> 'radiance'"]),
    }


def test_the_camera_says_where_the_room_is_and_which_axis_is_up(write_xml: Callable[..., Path], read: Read) -> None:
    sensor = '<sensor type="perspective"><transform name="to_world">'
    sensor += '<lookat origin="1, 2, 3" target="5, 2, 3" up="0, 0, 1"/></transform></sensor>'
    scene = read(write_xml(sensor + SPHERE))
    assert scene.camera == pytest.approx((1, 2, 3))
    assert scene.up == (0, 0, 1)
    assert read(write_xml(SPHERE)).up == (0, 1, 0)


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
            "Mitsuba cannot load it: scene.xml: line 2: <bsdf> 'C': .*Foo",
        ),
        ('<include filename="scene.xml"/>', "line 2: .* includes itself"),
        ("&gone;", "undefined entity: line 2"),
        (SPHERE * 2, "line 2: .* duplicate ID: .Ball"),
        (
            f'{SPHERE}<emitter type="point"><rgb name="intensity" value="1 nan 1"/></emitter>',
            "line 2: <rgb> 'intensity': nan",
        ),
        (
            f'{SPHERE}<emitter type="constant"><float name="radiance" value="1e39"/></emitter>',
            r"line 2: <float> 'radiance': 1e\+39",
        ),
        *(
            (f'<shape type="cube"><transform name="to_world"><{step}/></transform></shape>', "line 2: ")
            for step in ('scale value="inf"', 'rotate x="1" angle="nan"', 'translate x="nan"', 'matrix value="nan"')
        ),
        (
            '<shape type="sphere"/><emitter type="constant"/>\n<emitter type="sunsky"/>',
            "scene.xml: line 1: .*one environment emitter",
        ),
    ],
)
def test_what_is_wrong_is_named(write_xml: Callable[..., Path], loaded: Loaded, content: str, named: str) -> None:
    with pytest.raises(SpecError, match=named):
        loaded(write_xml(content))


@pytest.mark.parametrize("binary", [False, True])
def test_faces_of_vertices_that_are_not_there_are_named(
    write_xml: Callable[..., Path], loaded: Loaded, tmp_path: Path, binary: bool
) -> None:
    header = f"ply\nformat {'binary_little_endian' if binary else 'ascii'} 1.0\nelement vertex 4\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4")
    path = write_xml('<shape type="ply"><string name="filename" value="it.ply"/></shape>')
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
    write_xml: Callable[..., Path], read: Read
) -> None:
    content = '<integrator type="direct"><boolean name="hideEmitters" value="true"/></integrator>'
    scene = read(write_xml(content + '<sensor type="thinlens"/>' + SPHERE, "0.6.0"))
    assert [change.name for change in scene.changes] == ["hide_emitters", "direct", "thinlens"]
    assert not list(read(write_xml('<integrator type="path"/><sensor type="perspective"/>' + SPHERE)).changes)


def test_a_spec_of_shapes_without_ids_is_told_of_the_import(write_xml: Callable[..., Path]) -> None:
    from photonfarm.scene.spec_loading import parse_spec

    path = write_xml('<shape type="sphere"/>')
    everywhere = {"min": [0, 0, 0], "max": [1, 1, 1]}
    described = {
        "name": "it",
        "scene": {"file": str(path)},
        "view": {"origin": everywhere, "look_at": everywhere},
        "objects": [{"name": "ball", "shapes": ["Ball"], "at": [0, 0, 0], "box": everywhere}],
    }
    with pytest.raises(SpecError, match=r"no ids; `photonfarm scene import`"):
        parse_spec(described, where="spec")


def test_shapes_of_a_group_and_copied_files_keep_apart(write_xml: Callable[..., Path], loaded: Loaded) -> None:
    group = '<shape type="shapegroup" id="g"><shape type="cube"/><shape type="sphere"/></shape>'
    instances = '<shape type="instance"><ref id="g"/></shape>' * 2
    assert len(loaded(write_xml(f'{group}{instances}<shape type="cube" id="g_1"/>'))[1].shapes()) == 5
