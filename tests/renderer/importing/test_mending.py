"""Scenes far from the origin, tiny ones, and lights of two sides in them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonfarm.renderer.importing.imported import ImportedScene

Loaded = Callable[[Path], tuple[ImportedScene, Any]]

QUAD = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4")
FACES = np.array([[0, 1, 2], [0, 2, 3]], "<u4")


def changed(scene: ImportedScene) -> str:
    return "\n".join(map(str, scene.changes))


def test_a_lamp_far_from_the_origin_has_its_back_just_behind_it(gltf: Any, loaded: Loaded) -> None:
    glow = gltf.material("glow", emissiveFactor=[1, 1, 1], doubleSided=True)
    gltf.node("Lamp", gltf.mesh(QUAD, FACES, glow), translation=[500000, 30, -6000000])
    scene, made = loaded(gltf.write())
    assert "is moved by (-500000, -30, 6000000)" in changed(scene)
    front, back = (float(shape.bbox().min[2]) for shape in made.shapes())
    assert 0 < front - back < 1e-3


@pytest.mark.parametrize("size", [1e-5, 0.003, 0.02])
def test_a_tiny_scene_is_enlarged_and_so_are_its_lights(gltf: Any, loaded: Loaded, size: float) -> None:
    gltf.node("Quad", gltf.mesh(QUAD * np.float32(size), FACES))
    gltf.document["extensions"] = {"KHR_lights_punctual": {"lights": [{"type": "point", "intensity": size**2}]}}
    gltf.node("Bulb", translation=[0, 0, size], extensions={"KHR_lights_punctual": {"light": 0}})
    scene, made = loaded(gltf.write())
    assert "is enlarged" in changed(scene)
    extent = float(made.bbox().max[0])
    assert 0.5 < extent <= 10
    emitter = next(node for node in scene.root.iter("emitter"))
    intensity, position = (
        next(part for part in emitter if part.get("name") == name) for name in ("intensity", "position")
    )
    assert float(position.get("z", "0")) == pytest.approx(extent, rel=1e-5)
    assert float(intensity.get("value", "").split(",")[0]) == pytest.approx(extent**2, rel=1e-5)


@pytest.mark.parametrize("flips", [False, True])
def test_a_mesh_of_mitsuba_keeps_its_side_when_normals_are_mended(tmp_path: Path, loaded: Loaded, flips: bool) -> None:
    import mitsuba as mi

    bad = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(
        f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz")
    )
    corners = "0 0 0 0 0 0\n1 0 0 0 0 1\n0 1 0 0 0 1\n3 0 1 2\n"
    (tmp_path / "bad.ply").write_text(
        f"{bad}element face 1\nproperty list uchar int vertex_index\nend_header\n{corners}"
    )
    flip = '<boolean name="flip_normals" value="true"/>' if flips else ""
    flat = '<shape type="rectangle"><transform name="to_world"><scale value="0"/></transform></shape>'
    (tmp_path / "it.xml").write_text(
        f'<scene version="3.0.0">{flat}<shape type="ply" id="Bad"><string name="filename" value="bad.ply"/>{flip}'
        '</shape><emitter type="constant"/></scene>'
    )
    scene, made = loaded(tmp_path / "it.xml")
    assert "faces whose normals are zero or no numbers get their own (Bad: 1 of 1)" in changed(scene)
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
