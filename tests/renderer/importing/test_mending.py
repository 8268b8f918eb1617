"""Scenes far from the origin, tiny ones, and lights of two sides in them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from imported_scenes import Loaded, said

from photonfarm.renderer.tools.importing.imported import Mesh, read_mesh, write_ply

QUAD = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4")
FACES = np.array([[0, 1, 2], [0, 2, 3]], "<u4")


def test_a_part_of_a_mesh_has_the_attributes_of_its_vertices_and_faces(tmp_path: Path) -> None:
    tints = {"vertex_tint": np.linspace(0, 1, 12).reshape(4, 3), "face_tint": np.array([[0.25, 0, 0], [0.5, 1, 0]])}
    part = Mesh(QUAD.astype(np.float64), FACES, attributes=tints).part(np.array([False, True]))
    file = write_ply(part, tmp_path / "part.ply")
    read = read_mesh(mi.load_dict({"type": "ply", "filename": str(file), "face_normals": True}))
    assert sorted(read.attributes) == ["face_tint", "vertex_tint"]
    assert read.attributes["face_tint"] == pytest.approx(tints["face_tint"][1:])
    assert read.attributes["vertex_tint"] == pytest.approx(tints["vertex_tint"][[0, 2, 3]])


def test_a_lamp_far_from_the_origin_has_its_back_just_behind_it(gltf: Any, loaded: Loaded) -> None:
    glow = gltf.material("glow", emissiveFactor=[1, 1, 1], doubleSided=True)
    gltf.node("Lamp", gltf.mesh(QUAD, FACES, glow), translation=[500000, 0, -6000000])
    scene, made = loaded(gltf.write())
    assert "is moved by (-500000, 0, 6000000)" in said(scene)
    front, back = (float(shape.bbox().min[2]) for shape in made.shapes())
    assert 0 < front - back < 1e-3


def test_a_tiny_scene_is_a_loss(gltf: Any, loaded: Loaded) -> None:
    gltf.node("Quad", gltf.mesh(QUAD * np.float32(0.02), FACES))
    assert "geometry differs: size: the scene is 0.028 across" in said(loaded(gltf.write())[0])


@pytest.mark.parametrize("flips", [False, True])
def test_a_mesh_of_mitsuba_keeps_its_side_when_normals_are_mended(tmp_path: Path, loaded: Loaded, flips: bool) -> None:
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    head = f"ply\nformat ascii 1.0\nelement vertex 3\n{names}element face 1\nproperty list uchar int vertex_index\n"
    corners = "0 0 0 0 0 0\n1 0 0 0 0 1\n0 1 0 0 0 1\n3 0 1 2\n"
    (tmp_path / "bad.ply").write_text(f"{head}end_header\n{corners}")
    flip = '<boolean name="flip_normals" value="true"/>' if flips else ""
    flat = '<shape type="rectangle"><transform name="to_world"><scale value="0"/></transform></shape>'
    (tmp_path / "it.xml").write_text(
        f'<scene version="3.0.0">{flat}<shape type="ply" id="Bad"><string name="filename" value="bad.ply"/>{flip}'
        '</shape><emitter type="constant"/></scene>'
    )
    scene, made = loaded(tmp_path / "it.xml")
    assert "faces whose normals are zero or no numbers get their own (Bad: 1 of 1)" in said(scene)
    assert [shape.id() for shape in made.shapes()] == ["Bad"]
    hit = made.ray_intersect(mi.Ray3f(mi.Point3f(0.2, 0.2, 5), mi.Vector3f(0, 0, -1)))
    assert float(np.array(hit.sh_frame.n).ravel()[2]) == (-1 if flips else 1)


def test_what_lies_far_from_the_rest_is_a_loss_of_the_rest_which_is_rounded(tmp_path: Path, loaded: Loaded) -> None:
    far = "\n".join(f"v {x + 85227.4} {y + 446522.1} 17" for x, y in ((0, 0), (4, 0), (4, 3), (0, 3)))
    file = tmp_path / "it.obj"
    file.write_text(f"o Room\n{far}\nf 1 2 3 4\no Stray\nv 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nf 5 6 7\n")
    scene, _ = loaded(file)
    (lost,) = [change for change in scene.changes if change.effect == "geometry"]
    assert lost.name == "coordinates"
    assert lost.places == ["shape 'Room' by up to 0.031"]
