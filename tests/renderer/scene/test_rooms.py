import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from photonfarm.core.errors import SpecError
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.scene.files import BUILTIN
from photonfarm.scene.spec import BUILTIN_ROOMS
from photonfarm.scene.spec_loading import load_spec, parse_spec


@pytest.fixture(scope="module", params=BUILTIN_ROOMS)
def room(request: pytest.FixtureRequest) -> LoadedScene:
    backend.load(1)
    return LoadedScene.load(load_spec(request.param))


def solid_faces(shape: Any) -> np.ndarray:
    vertices = np.array(shape.vertex_positions_buffer()).reshape(-1, 3)
    return vertices[np.array(shape.faces_buffer()).reshape(-1, 3)]


def test_the_listed_shape_ids_are_those_of_the_room(room: LoadedScene) -> None:
    listed = BUILTIN[str(room.spec.scene.builtin)].shape_ids
    assert {shape.id() for shape in room.scene.shapes()} == listed
    assert len(room.scene.shapes()) == len(listed)


def test_an_unknown_shape_id_of_a_built_in_room_is_refused_without_mitsuba() -> None:
    described = load_spec("room").model_dump(mode="json")
    described["objects"][0]["shapes"] = ["table-woood"]
    with pytest.raises(SpecError):
        parse_spec(described, where="test")
    code = "import sys; from photonfarm.scene.spec_loading import load_spec; "
    code += "load_spec('room'); exit('mitsuba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_nothing_leaves_the_room_through_its_walls() -> None:
    mi = backend.load(1)
    room = LoadedScene.load(load_spec("room"))
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(3, 4000)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=0)
    hit = room.scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(0.1, 1.9, 0.2), mi.Vector3f(*directions)))
    assert np.all(np.array(hit.is_valid()))


def test_solids_of_furniture_face_outwards() -> None:
    """The volume by the divergence theorem is positive where all faces do."""
    backend.load(1)
    room = LoadedScene.load(load_spec("room"))
    flat = {"floor", "ceiling", "rug", "painting", "mirror-glass"}
    for shape in room.scene.shapes():
        name = shape.id()
        if not shape.is_mesh() or name in flat or name.startswith(("wall", "ceiling")):
            continue
        a, b, c = np.moveaxis(solid_faces(shape).astype(np.float64), 1, 0)
        assert np.sum(a * np.cross(b, c)) / 6 > 1e-5, name
