"""OBJ as it is imported: statements, faces, normals and colours of vertices."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from imported_scenes import FOUR_V, Loaded, Obj, Read, Write, area, emission, hit, lost, meets, reflectance, said

from photonfarm.core.errors import SpecError


def test_objects_and_materials_name_shapes_and_images_stand_upright(write_obj: Write, loaded: Loaded) -> None:
    faces = (
        "o Picture\nusemtl paint\nf 1/1 2/2 3/3 4/4\no Frame\nusemtl wood\nf 1/1 2/2 3/3\nusemtl paint\nf 1/1 3/3 4/4"
    )
    scene, made = loaded(
        write_obj(faces, "newmtl paint\nKd 0 0 0\nmap_Kd -s 1 1 1 four.png\nnewmtl wood\nKd .5 .25 .1")
    )
    assert [shape.id() for shape in made.shapes()] == ["Frame_paint", "Frame_wood", "Picture_paint"]
    assert set(scene.objects.values()) == {"Frame", "Picture"}
    (picture,) = (shape for shape in made.shapes() if shape.id() == "Picture_paint")
    si = mi.load_dict({"type": "scene", "it": picture}).ray_intersect(
        mi.Ray3f(mi.Point3f(0.25, 0.75, 1), mi.Vector3f(0, 0, -1))
    )
    assert np.array(si.bsdf().eval_diffuse_reflectance(si)).ravel() == pytest.approx([1, 0, 0], abs=1e-6)


def test_what_emits_is_a_light_with_flat_normals(write_obj: Write, loaded: Loaded) -> None:
    _, made = loaded(write_obj("vn 0 1 1\nusemtl it\nf 1//1 2//1 3//1 4//1", "newmtl it\nKe 5 4 3"))
    for shape in made.shapes():
        assert shape.is_emitter()
        assert not shape.has_vertex_normals()
    for side in (5, -5):
        assert emission(made, 0.5, 0.4, side) == pytest.approx([5, 4, 3])


@pytest.mark.parametrize(
    ("faces", "materials", "name", "file"),
    [
        ("usemtl it\nf 1 2 3", "newmtl it\nmap_Kd gone.png", "map_Kd", "it.mtl: line 2: gone.png"),
        ("mtllib gone.mtl\nf 1 2 3", "newmtl it\nKd 1 1 1", "mtllib", "gone.mtl"),
    ],
)
def test_files_that_are_missing_change_the_picture(
    write_obj: Write, loaded: Loaded, faces: str, materials: str, name: str, file: str
) -> None:
    scene, made = loaded(write_obj(faces, materials))
    (lost,) = [change for change in scene.changes if change.effect == "colour"]
    assert (lost.name, lost.places) == (name, [file])
    assert len(made.shapes()) == 1


def test_relative_indices_count_from_their_line(case: Callable[[str], Path], obj: Obj, loaded: Loaded) -> None:
    _, made = loaded(case("obj-negative-indices/two.obj"))
    assert area(made) == pytest.approx(2)
    assert np.ravel(made.bbox().max).tolist() == [4, 1, 0]
    assert [meets(made, x, 0.5) for x in (0.5, 2.5, 3.5)] == [True, False, True]
    first = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nvn 0 0 1\nf -3/-3/-1 -2/2/-1 3/-1/1\n"
    _, made = loaded(obj(first + "v 9 9 9\nvt 0.5 0.5\nvn 1 0 0\n"))
    si = hit(made, 0.25, 0.5)
    assert np.ravel(si.uv) == pytest.approx([0.25, 0.5])  # v is downwards
    assert np.ravel(si.sh_frame.n) == pytest.approx([0, 0, 1])


def test_concave_polygons_keep_their_shape(case: Callable[[str], Path], obj: Obj, loaded: Loaded) -> None:
    _, made = loaded(case("obj-concave/it.obj"))
    assert area(made) == pytest.approx(7)
    assert [meets(made, *at) for at in ((1.5, 2), (0.5, 2), (1.5, 0.5))] == [False, True, True]
    for first in range(4):  # of a quadrangle
        indices = " ".join(str((first + k) % 4 + 1) for k in range(4))
        _, made = loaded(obj(f"v 0 0 0\nv 2 2 0\nv 0 1 0\nv -2 2 0\nf {indices}"))
        assert area(made) == pytest.approx(2)
        assert not meets(made, 0, 1.5)


@pytest.mark.parametrize(("slope", "turn"), [((0, 0), 1), ((0, 0), -1), ((1, 2), 1), ((-3, 0.1), -1)])
def test_a_wall_with_an_opening_keeps_it_and_its_side(
    obj: Obj, loaded: Loaded, slope: tuple[float, float], turn: int
) -> None:
    corners = [(0, 0), (4, 0), (4, 3), (0, 3), (0, 0), (1, 1), (1, 2), (3, 2), (3, 1), (1, 1)][::turn]
    points = "".join(f"v {x} {y} {x * slope[0] + y * slope[1]}\n" for x, y in corners)
    _, made = loaded(obj(points + "f " + " ".join(str(k + 1) for k in range(len(corners)))))
    assert area(made) == pytest.approx(10 * np.linalg.norm([*slope, 1]))
    assert [meets(made, *at) for at in ((2, 1.5), (0.5, 0.5), (3.5, 2.5))] == [False, True, True]
    assert np.sign(np.ravel(hit(made, 0.5, 0.6, 50).n)[2]) == turn


def test_faces_that_cross_themselves_and_what_has_no_surface_are_said(obj: Obj, read: Read) -> None:
    scene = read(obj("v 0 0 0\nv 1 1 0\nv 1 0 0\nv 0 1 0\nf 1 2 3 4\nf 1 2 3\nf 1 2\np 1\nl 1 2"))
    for text in ("cross themselves", "(line 5)", "fewer than three corners", "(line 7)", "line 8", "line 9"):
        assert text in said(scene)
    assert not lost(scene)


def test_normals_that_are_no_numbers_are_those_of_the_faces(case: Callable[[str], Path], loaded: Loaded) -> None:
    _, made = loaded(case("obj-normals-nan/it.obj"))
    assert np.abs(np.ravel(hit(made, 0.5, 0.4).sh_frame.n)).tolist() == [0, 0, 1]
    assert reflectance(made, 0.5, 0.4) == pytest.approx([0.7] * 3)


@pytest.mark.parametrize("normal", ["-nan(ind) 0 1", "-1.#IND 0 0", "1.#QNAN0 0 1", "0 0 0", "inf 0 0", "0 0"])
def test_normals_in_every_form_that_cannot_be_used_are_those_of_the_faces(
    obj: Obj, loaded: Loaded, normal: str
) -> None:
    _, made = loaded(obj(f"{FOUR_V}vn {normal}\nvn 0 0 1\nf 1//1 2//1 3//2 4//2"))
    assert np.ravel(hit(made, 0.5, 0.4).sh_frame.n).tolist() == [0, 0, 1]


def test_a_scene_in_national_coordinates_keeps_its_size(case: Callable[[str], Path], loaded: Loaded) -> None:
    scene, made = loaded(case("obj-national-grid/it.obj"))
    extent = np.array(made.bbox().max) - np.array(made.bbox().min)
    assert np.ravel(extent) == pytest.approx([4, 3, 2.5], abs=1e-3)
    assert "moved" in said(scene)


@pytest.mark.parametrize(
    "text",
    [
        b"\xef\xbb\xbf" + FOUR_V.replace("\n", "\r\n").encode() + b"o St\xc3\xbchl\r\nf 1 2 3 4\r\n",
        (FOUR_V + "o Stühl\nf 1 2 3 4").encode("latin-1"),
        (FOUR_V + "o Stühl\nf 1 2 3 4").encode("utf-16"),
        (FOUR_V.replace(" ", "\t") + "# C:\\\no Stühl\nf\t1 2 \\\n 3/ 4// # four").encode(),
    ],
)
def test_texts_of_all_kinds_are_read(obj: Obj, loaded: Loaded, text: bytes) -> None:
    scene, made = loaded(obj(text))
    assert area(made) == pytest.approx(1)
    assert set(scene.objects.values()) == {"Stühl"}


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (FOUR_V, "has no faces"),
        (FOUR_V + "f 1 2 5", "line 5: f names v 5, and there are 4"),
        (FOUR_V + "f 0 1 2", "line 5: f names v 0"),
        ("f -1 1 2\n" + FOUR_V, "line 1: f names v -1"),
        (FOUR_V + "vt 0 0\nf 1/1 2/2 3/1", "line 6: f names vt 2"),
        (FOUR_V + "f 1//1 2//1 3//1", "line 5: f names vn 1, and there are 0"),
        (FOUR_V + "f 1/1/1/1 2 3", "line 5: f has a corner"),
        (FOUR_V + "f 1.5 2 3", "line 5: f has a corner"),
        (FOUR_V + "f 1 2 99999999999999999999", "line 5: f has a corner"),
        (FOUR_V + "f 1 2 999999999999999999", "line 5: f names v 999999999999999999"),
        ("v 0 0 x\nf 1 1 1", "line 1: v has 'x'"),
        ("v 0 0 0\nv nan 0 0\nf 1 1 2", "line 2: v has no three finite"),
        ("v 0 0\nf 1 1 1", "line 1: v has no three finite"),
        (b"v 0 0 0\0", "is no text"),
    ],
)
def test_what_cannot_be_read_is_refused_with_its_line(obj: Obj, read: Read, text: str | bytes, fault: str) -> None:
    with pytest.raises(SpecError, match=fault):
        read(obj(text))


def test_statements_that_are_not_carried_over_are_said(obj: Obj, read: Read) -> None:
    others = "surf 0 1 0 1 1 2 3 4\nend\ncall x.obj\ntrace_obj y\nusemap z\nlod 1\nbogus 1\nusemtl gone\n"
    scene = read(obj(f"{FOUR_V}{others}f 1 2 3 4"))
    assert lost(scene) == {
        "surf": "geometry",
        "call": "geometry",
        "trace_obj": "geometry",
        "usemap": "geometry",
        "bogus": "geometry",
        "usemtl": "colour",
    }
    assert "are in no material file, and their surfaces are grey ('gone', line 12)" in said(scene)


def test_groups_are_owners_where_there_are_no_objects(obj: Obj, read: Read) -> None:
    assert set(read(obj(f"{FOUR_V}g a b\nf 1 2 3\ng c\nf 1 3 4")).objects.values()) == {"a b", "c"}
    assert set(read(obj(f"{FOUR_V}o A B\ng c\nf 1 2 3\ng d\nf 1 3 4")).objects.values()) == {"A B"}


@pytest.mark.parametrize(
    ("state", "normal"), [("s 1", (0, 0.5**0.5, 0.5**0.5)), ("s off", (0, 0, 1)), ("s 0", (0, 0, 1)), ("", (0, 0, 1))]
)
def test_smoothing_groups_make_the_normals_that_are_missing(
    obj: Obj, loaded: Loaded, state: str, normal: tuple[float, ...]
) -> None:
    _, made = loaded(obj(f"{FOUR_V}v 0 0 1\nv 1 0 1\n{state}\nf 1 2 3 4\nf 2 1 5 6"))
    assert np.ravel(hit(made, 0.5, 1e-4).sh_frame.n) == pytest.approx(normal, abs=1e-3)


@pytest.mark.parametrize(
    ("colour", "material", "expected"),
    [
        ("0.5 0 0", "", (0.214, 0, 0)),  # colours are sRGB
        ("255 0 0", "", (1, 0, 0)),
        ("1 1 1", "newmtl it\nKd .5 .2 .1\nTr 1", (0.5, 0.2, 0.1)),
        ("0.5 1 1", "newmtl it\nKd .5 .5 .5\nKs .5 .5 .5", (0.107, 0.5, 0.5)),
        ("1 0 0", "newmtl it\nmap_Kd four.png", (0, 0, 1)),
        ("1", "", (0.7, 0.7, 0.7)),  # a weight of free-form surfaces
    ],
)
def test_colours_of_vertices_are_those_of_the_surface(
    write_obj: Write, obj: Obj, loaded: Loaded, colour: str, material: str, expected: tuple[float, ...]
) -> None:
    write_obj("", material or "newmtl no")
    points = "".join(f"v {x} {y} 0 {colour}\nvt {x} {y}\n" for x, y in ((0, 0), (1, 0), (1, 1), (0, 1)))
    scene, made = loaded(obj(f"mtllib it.mtl\n{points}{'usemtl it' if material else ''}\nf 1/1 2/2 3/3 4/4"))
    assert reflectance(made, 0.25, 0.25) == pytest.approx(expected, abs=1e-3)
    assert not lost(scene)


@pytest.mark.parametrize(
    ("text", "name"), [("v 0 0 0 1 0", "v"), ("#MRGB ff00ff00\nv 0 0 0", "#MRGB"), ("#MRGB ffffffff\nv 0 0 0", "")]
)
def test_colours_of_vertices_that_are_not_read_are_said(obj: Obj, read: Read, text: str, name: str) -> None:
    assert lost(read(obj(f"{text}\nv 1 0 0\nv 0 1 0\nf 1 2 3"))) == ({name: "colour"} if name else {})
