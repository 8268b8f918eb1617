"""Files of chosen samples: cameras of transforms.json, and configurations by the names of groups."""

import json
import re
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import store_samples as samples
from click.testing import CliRunner

from photonfarm.cli.main import umbrella
from photonfarm.core.errors import SpecError
from photonfarm.export.snapshot import camera_to_world
from photonfarm.farm import renderer_verbs
from photonfarm.plan.chosen import Chosen
from photonfarm.scene.arrangement import Arrangement, find_doubts
from photonfarm.scene.camera_path import CameraPath, Cameras
from photonfarm.scene.modification import rest
from photonfarm.scene.shot_files import read_cameras, read_configurations, read_shots
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec
from photonfarm.scene.view import View, sample_view
from photonfarm.store import Store

SPEC = samples.small_spec()
VIEW = View(np.float32([1, 1, 1]), np.float32([0, 0.5, 0]))


@pytest.fixture(autouse=True)
def without_renderer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing looks closer: the renderer's own tests do."""
    monkeypatch.setattr(renderer_verbs, "can_render", lambda: False)


def views(count: int, spec: SceneSpec = SPEC) -> list[View]:
    return [sample_view(spec, b"0" * 16, 5, i) for i in range(count)]


def transforms(folder: Path, **changes: Any) -> Path:
    """Three cameras as nerfstudio writes them: a matrix, a focal length and a width."""
    frames = [{"transform_matrix": camera_to_world(view, SPEC).tolist()} for view in views(3)]
    focal = 4 / np.tan(np.radians(SPEC.view.fov_deg / 2))
    document = {"w": 8, "h": 8, "fl_x": focal, "fl_y": focal, "frames": frames, **changes}
    (file := folder / "transforms.json").write_text(json.dumps(document))
    return file


def test_cameras_of_a_transforms_json_see_what_they_saw(tmp_path: Path) -> None:
    for found, view in zip(read_cameras(transforms(tmp_path), SPEC), views(3), strict=True):
        np.testing.assert_array_equal(found.origin, view.origin)
        np.testing.assert_allclose(camera_to_world(found, SPEC), camera_to_world(view, SPEC), atol=1e-5)
    exact = [{"transform_matrix": camera_to_world(v, SPEC).tolist(), "look_at": v.target.tolist()} for v in views(3)]
    for found, view in zip(read_cameras(transforms(tmp_path, frames=exact), SPEC), views(3), strict=True):
        np.testing.assert_array_equal(found.vector, view.vector)


def test_each_camera_has_its_own_field_of_view_which_is_planned_where_the_spec_has_a_range(tmp_path: Path) -> None:
    """The second frame says an angle, the others a focal length."""
    lenses = {"fl_x": 4}, {"camera_angle_x": np.radians(50)}, {"fl_x": 6}
    frames = [
        {"transform_matrix": camera_to_world(view, SPEC).tolist(), **lens}
        for view, lens in zip(views(3), lenses, strict=True)
    ]
    (file := tmp_path / "transforms.json").write_text(json.dumps({"w": 8, "h": 8, "frames": frames}))
    wanted = [float(np.degrees(2 * np.arctan(4 / 4))), 50.0, float(np.degrees(2 * np.arctan(4 / 6)))]
    found = read_cameras(file, SPEC)
    np.testing.assert_allclose([view.fov for view in found], wanted, rtol=1e-6)
    with pytest.raises(SpecError, match="fov = 90: samples of this spec have 60"):
        Chosen.of(SPEC, rest(SPEC), found[0])
    ranged = samples.small_spec(view=SPEC.view.model_dump() | {"fov": {"min": 45, "max": 75}})
    (shot,) = Chosen.of(ranged, rest(ranged), read_cameras(file, ranged)[1]).shots
    np.testing.assert_array_equal(shot.view(ranged).vector, found[1].vector)
    doubts = [find_doubts(ranged, rest(ranged), view) for view in read_cameras(file, ranged)]
    assert [any("the field of view is" in doubt for doubt in each) for each in doubts] == [True, False, False]
    (cells := tmp_path / "rooms.csv").write_text("fov\n50\n60\n\n")
    own = [camera.fov if camera else None for _, camera in read_configurations(cells, SPEC)]
    assert own == [50, None]


def test_a_transforms_json_is_a_camera_path_of_its_cameras(tmp_path: Path) -> None:
    path = CameraPath.load(transforms(tmp_path))
    assert isinstance(path, Cameras)
    for found, view in zip(path.sample(SPEC), read_cameras(tmp_path / "transforms.json", SPEC), strict=True):
        np.testing.assert_array_equal(found.vector, view.vector)


ROLLED = np.array([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"frames": [{"transform_matrix": ROLLED.tolist()}]}, "frame 1 of 1: is turned by 90.0°"),
        ({"camera_angle_x": 1.0, "fl_x": None, "w": 8}, "no camera"),
        ({"h": 4}, "2.000 times as wide"),
        ({"k1": 0.1}, "distorts"),
        ({"frames": []}, "no frames"),
        ({"frames": [{}]}, "frame 1 of [13]: is no camera"),
        ({"frames": [{"transform_matrix": [[1, 2], [3, 4]]}]}, "4 × 4"),
        ({"frames": [{"transform_matrix": [[0] * 4] * 4}]}, "4 × 4 finite numbers are required, of a rotation"),
        ({"frames": [1]}, "frame 1 of [13]: is no camera"),
        ({"look_at": [float("nan"), 0, 0]}, r"frame 1 of [13]: look_at = \[nan, 0, 0\]: a finite number"),
        ({"frames": [{"transform_matrix": np.diag([1, 1, 1, 0]).tolist()}], "look_at": [0, 0, 0]}, "where it looks at"),
        ({"frames": [{"transform_matrix": (np.eye(4) + np.diag([1e39], 3)).tolist()}]}, r"camera = \[1e\+39"),
    ],
)
def test_cameras_that_the_spec_cannot_have_are_refused(tmp_path: Path, changes: dict[str, Any], says: str) -> None:
    with pytest.raises(SpecError, match=says):
        read_cameras(transforms(tmp_path, **changes), SPEC)


def test_configurations_are_read_by_names_from_json_and_csv_alike(tmp_path: Path) -> None:
    entries: list[dict[str, Any]] = [
        {"place": {"object": [0.5, 0, 0.25]}, "camera": [1, 0.5, 0], "look_at": [0, 0, 0], "fov": SPEC.view.fov_deg},
        {"without": ["object"]},
        {},
    ]
    (tables := tmp_path / "rooms.json").write_text(json.dumps(entries))
    (cells := tmp_path / "rooms.csv").write_text(
        "object.x, object.z, object.present, camera.x, camera.y, camera.z, look_at.x, look_at.y, look_at.z\n"
        "0.5, 0.25, 1, 1, 0.5, 0, 0, 0, 0\n, , 0,,,,,,\n\n, , 1,,,,,,\n"
    )
    for file in (tables, cells):
        (first, camera), (second, none), (third, _) = read_configurations(file, SPEC)
        np.testing.assert_array_equal(first.vector, np.float32([[0.5, 0, 0.25, 1]]))
        assert camera is not None
        np.testing.assert_array_equal(camera.vector, np.float32([1, 0.5, 0, 0, 0, 0]))
        assert none is None
        assert not second.present.any()
        np.testing.assert_array_equal(third.vector, rest(SPEC).vector)
    assert len(read_shots(SPEC, transforms(tmp_path), tables)) == 1 + 3 + 3
    assert len(read_shots(SPEC, None, tables, views=2)) == 1 + 2 + 2


def test_what_a_row_leaves_empty_is_as_at_the_start(tmp_path: Path) -> None:
    (file := tmp_path / "rooms.csv").write_text("object.x, object.present\n0.5,\n, 1\n")
    moved = Arrangement.of(place={"object": (0, 0, 0.25)}).apply(SPEC)
    (first, _), (second, _) = read_configurations(file, SPEC, moved)
    np.testing.assert_array_equal(first.vector, np.float32([[0.5, 0, 0.25, 1]]))
    np.testing.assert_array_equal(second.vector, moved.vector)
    (_, _), (back, _) = read_configurations(file, SPEC, rest(SPEC).without_groups())
    assert back.present.all(), "it is said to be there"


def test_a_row_that_says_where_to_look_alone_is_seen_from_the_first_camera(tmp_path: Path) -> None:
    (file := tmp_path / "rooms.csv").write_text("look_at.x, look_at.y, look_at.z\n0, 0.25, 0\n")
    ((_, camera),) = read_configurations(file, SPEC)
    assert camera is not None
    np.testing.assert_array_equal(camera.target, np.float32([0, 0.25, 0]))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('[{"place": {"sofa": [0, 0, 0]}}]', "configuration 1 of 1: 'sofa' is no movable group of small; its groups"),
        ('[{"fov": 0}]', "fov = 0"),
        ('[{"plaice": {}}]', "plaice"),
        ("[1]", "list of tables"),
        ("[]", "no configurations"),
        ("{", "not valid JSON"),
    ],
)
def test_a_configuration_that_the_scene_cannot_have_is_refused(tmp_path: Path, text: str, says: str) -> None:
    (file := tmp_path / "rooms.json").write_text(text)
    with pytest.raises(SpecError, match=says):
        read_configurations(file, SPEC)


def test_the_table_of_the_page_is_of_the_room(tmp_path: Path) -> None:
    page = (Path(__file__).parents[3] / "docs/what-if.md").read_text()
    (table,) = re.findall(r"(?:^    [-\w.]+(?:,[-\w.]*)+\n)+", page, re.MULTILINE)
    (file := tmp_path / "rooms.csv").write_text(textwrap.dedent(table))
    room = load_spec("room")
    (first, none), (second, view) = read_configurations(file, room)
    assert none is None
    assert Arrangement.from_modification(room, first).describe() == "--place sofa=0.5,0,-1"
    assert view is not None
    assert Arrangement.from_modification(room, second).describe() == "--place sofa=1.2,0,0 --without lamp"
    assert not find_doubts(room, second, view)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("object.x\nfar", "line 2: column 'object.x': 'far'"),
        ("object.x,object\n0,1", r"line 1: column 'object': is none of NAME\.x"),
        ("object.x;object.z\n0,5;1", "line 1: semicolons .* commas are required"),
        ("", "no conf"),
        ("object.x,object.z\n\n0,0\n0,5,0,5", "line 4: has 4 cells, and the first line has 2 names"),
        ("object.x,object.z\n0", "line 2: has 1 cell,"),
        ("object.x, object.z,object.x \n0,0,1", r"line 1: column 'object\.x': is there twice"),
        ("camera.x,camera.y,camera.z\n2,,", r"line 2: camera\.y and camera\.z are empty"),
        ("look_at.x,look_at.z\n2,0", r"line 2: look_at\.y is empty"),
        ("lamp.present\n1", "'lamp' is no"),
    ],
)
def test_a_table_that_cannot_be_meant_is_refused(tmp_path: Path, text: str, says: str) -> None:
    (file := tmp_path / "rooms.csv").write_text(text)
    with pytest.raises(SpecError, match=says):
        read_configurations(file, SPEC)


def test_submit_plans_the_samples_of_files_and_says_what_no_random_one_shows(tmp_path: Path) -> None:
    (tmp_path / "rooms.csv").write_text("table.x, table.z\n0.5, 0.5\n9, 0\n")
    room = ["submit", "room", "--store", str(tmp_path / "store"), "--no-queue"]
    done = CliRunner().invoke(umbrella, [*room, "--configurations", str(tmp_path / "rooms.csv"), "--views", "3"])
    assert done.exit_code == 0, done.output
    assert "6 samples planned" in done.stdout
    assert "warning: frame-0001: table stands at 9,0,0, outside its box" in done.stderr
    again = CliRunner().invoke(umbrella, [*room, "--configurations", str(tmp_path / "rooms.csv"), "--views", "3"])
    assert "0 samples planned" in again.stdout
    refused = CliRunner().invoke(umbrella, [*room, "--cameras", str(transforms(tmp_path)), "--views", "3"])
    assert refused.exit_code == 2
    assert "--views: is of random views" in refused.stderr


def test_options_say_where_cameras_of_a_file_look(tmp_path: Path) -> None:
    spec = load_spec("room")
    frame = {"transform_matrix": camera_to_world(VIEW, spec).tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    room = ["submit", "room", "--store", str(tmp_path / "store"), "--no-queue"]
    asked = ["--cameras", str(tmp_path / "transforms.json"), "--without", "vase", "--passes", "2"]
    assert "2 samples planned" in CliRunner().invoke(umbrella, [*room, *asked]).stdout
    store = Store(tmp_path / "store")
    (rows,) = (plan.rows for plan in store.scene(store.scene_ids()[0]).plans())
    assert rows.modification[0, [group.name for group in spec.groups].index("vase"), 3] == 0
    np.testing.assert_array_equal(rows.view[0, :3], VIEW.origin)
    refused = CliRunner().invoke(umbrella, [*room, *asked, "--camera", "0,1,0"])
    assert (refused.exit_code, "--camera: files say" in refused.stderr) == (2, True)
    alone = CliRunner().invoke(umbrella, [*room, "--place", "table=9,0,0"])
    assert "warning: table stands at 9,0,0, outside its box" in alone.stderr


def test_a_table_turns_dims_and_colours(tmp_path: Path) -> None:
    turning = samples.small_spec(
        objects=[{**samples.ALWAYS["objects"][0], "turn": {"min": -90, "max": 90}}],
        lights=[{"name": "lamp", "shapes": ["ceiling-light"], "power": {"min": 0, "max": 2}, "colour": [[1, 0.5, 0]]}],
    )
    (file := tmp_path / "rooms.csv").write_text(
        "object.turn,lamp.power,lamp.green,lamp.present\n30,0.5,0.25,1\n,,2,0\n"
    )
    (first, _), (second, _) = read_configurations(file, turning)
    expected = np.float32([[0, 0, 0, 1, 30, 1, 1, 1, 1], [0, 0, 0, 1, 0, 0.5, 1, 0.25, 1]])
    np.testing.assert_array_equal(first.vector, expected)
    np.testing.assert_array_equal(second.vector[1], np.float32([0, 0, 0, 0, 0, 1, 1, 1, 1]))
