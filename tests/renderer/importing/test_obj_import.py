"""OBJ with MTL as it is imported."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from photonfarm.renderer.importing.imported import ImportedScene
from photonfarm.shared.core.errors import SpecError

Loaded = Callable[[Path], tuple[ImportedScene, Any]]

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str, str], Path]:
    """Function (faces, materials) → an OBJ file, with four.png beside it."""
    pixels = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
    Image.fromarray(pixels).save(tmp_path / "four.png")

    def make(faces: str, materials: str) -> Path:
        (tmp_path / "it.mtl").write_text(materials)
        (tmp_path / "it.obj").write_text(f"mtllib it.mtl\n{SQUARE}{faces}\n")
        return tmp_path / "it.obj"

    return make


def test_objects_and_materials_name_shapes_and_images_stand_upright(
    write: Callable[[str, str], Path], loaded: Loaded
) -> None:
    faces = (
        "o Picture\nusemtl paint\nf 1/1 2/2 3/3 4/4\no Frame\nusemtl wood\nf 1/1 2/2 3/3\nusemtl paint\nf 1/1 3/3 4/4"
    )
    scene, made = loaded(write(faces, "newmtl paint\nKd 0 0 0\nmap_Kd -s 1 1 1 four.png\nnewmtl wood\nKd .5 .25 .1"))
    assert [shape.id() for shape in made.shapes()] == ["Frame_paint", "Frame_wood", "Picture_paint"]
    assert set(scene.objects.values()) == {"Frame", "Picture"}
    (picture,) = (shape for shape in made.shapes() if shape.id() == "Picture_paint")
    si = mi.load_dict({"type": "scene", "it": picture}).ray_intersect(
        mi.Ray3f(mi.Point3f(0.25, 0.75, 1), mi.Vector3f(0, 0, -1))
    )
    assert np.array(si.bsdf().eval_diffuse_reflectance(si)).ravel() == pytest.approx([1, 0, 0], abs=1e-6)


@pytest.mark.parametrize(
    ("lines", "kinds"),
    [
        ("Kd .5 .5 .5", ["TwoSided", "SmoothDiffuse"]),
        ("Kd .5 .5 .5\nKs .5 .5 .5\nNs 98\nillum 2", ["RoughPlastic", "alpha = [0.141"]),
        ("Kd 1 1 1\nd 0.1\nNi 1.4\nillum 4", ["ThinDielectric", "eta = [1.39"]),
        ("Kd .5 .5 .5\nd 0.8", ["Mask", "0.8"]),
        ("Kd .5 .5 .5\nPr .3\nPm 1", ["Principled"]),
        ("Kd .5 .5 .5\nmap_d four.png", ["Mask", "Bitmap"]),
    ],
)
def test_materials_become_what_is_nearest(
    write: Callable[[str, str], Path], loaded: Loaded, lines: str, kinds: list[str]
) -> None:
    _, made = loaded(write("usemtl it\nf 1/1 2/2 3/3 4/4", f"newmtl it\n{lines}"))
    for kind in kinds:
        assert kind in str(made.shapes()[0].bsdf())


def test_what_emits_is_a_light_with_flat_normals(write: Callable[[str, str], Path], loaded: Loaded) -> None:
    _, made = loaded(write("vn 0 1 1\nusemtl it\nf 1//1 2//1 3//1 4//1", "newmtl it\nKe 5 4 3"))
    (shape,) = made.shapes()
    assert shape.is_emitter()
    assert not shape.has_vertex_normals()


def test_polygons_of_all_kinds_are_read(write: Callable[[str, str], Path], loaded: Loaded) -> None:
    _, made = loaded(write("usemtl it\nf 1 2 3\nf 1 3 4\nf 1 2 3 4", "newmtl it\nKd 1 1 1"))
    assert float(np.array(made.shapes()[0].surface_area())[0]) == pytest.approx(2)


@pytest.mark.parametrize(
    ("faces", "materials", "named"),
    [
        ("usemtl it\nf 1 2 3", "newmtl it\nmap_Kd gone.png", "gone.png"),
        ("usemtl it\nf 1 2 3", "newmtl it\nKd red", "Kd|kd"),
        ("", "newmtl it\nKd 1 1 1", "no faces"),
        ("mtllib gone.mtl\nf 1 2 3", "newmtl it\nKd 1 1 1", "gone.mtl"),
    ],
)
def test_what_is_missing_is_named(
    write: Callable[[str, str], Path], loaded: Loaded, faces: str, materials: str, named: str
) -> None:
    with pytest.raises(SpecError, match=named):
        loaded(write(faces, materials))
