"""What can hardly be meant in a spec, and the lines that say it."""

from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from photonfarm.cli.main import umbrella
from photonfarm.scene.plausibility import doubts, warnings
from photonfarm.scene.spec_loading import NamedSpec, find_spec, lines_of, parse_with_lights

ROOM: dict[str, Any] = {
    "name": "checked",
    "scene": {"builtin": "room"},
    "view": {
        "origin": {"min": [-2, 1, -2], "max": [2, 2, 2]},
        "look_at": {"min": [-2, 0, -2], "max": [2, 2, 2]},
    },
}
TABLE = {"name": "table", "shapes": ["table-wood"], "at": [0, 0, 0], "box": {"min": [-1, 0, -1], "max": [1, 0, 1]}}


def keys(**changes: Any) -> list[str]:
    """The keys that are doubted in a spec of the built-in room."""
    changes["view"] = ROOM["view"] | changes.get("view", {})
    return [key for key, _ in doubts(*parse_with_lights(ROOM | changes, where="test"))]


def origin(*at: float) -> dict[str, Any]:
    return {"origin": {"min": [at[0] - 2, at[1], at[2] - 2], "max": [at[0] + 2, at[1] + 1, at[2] + 2]}}


@pytest.mark.parametrize("name", ["room", "cornell"])
def test_nothing_is_said_of_the_built_in_specs(name: str) -> None:
    assert warnings(NamedSpec.load(name)) == []


@pytest.mark.parametrize(
    ("changes", "doubted"),
    [
        ({}, []),
        ({"view": {"fov_deg": 1.2}}, ["view.fov_deg"]),
        ({"view": {"fov_deg": 169}}, ["view.fov_deg"]),
        ({"view": origin(230, 1, 0)}, ["view.origin"]),
        ({"view": origin(230, 1, 0) | {"far": 200}}, ["view.far"]),
        ({"view": {"near": 3}}, ["view.near"]),
        ({"transport": {"max_depth": 0}}, ["transport.max_depth"]),
        ({"transport": {"max_depth": 1}}, ["transport.max_depth"]),
        ({"transport": {"max_depth": -1}}, []),
        ({"emitters": {"all": 0}}, ["emitters"]),
        ({"emitters": {"all": 0, "by_id": {"lamp-shade": 1}}}, []),
        ({"objects": [TABLE]}, []),
        ({"objects": [TABLE | {"box": {"min": [-100, 0, -100], "max": [100, 0, 100]}}]}, ["objects.0.box"]),
        ({"objects": [TABLE | {"at": [30, 0, 0]}]}, ["objects.0.at"]),
        ({"objects": [TABLE | {"removal_probability": 1}]}, ["objects.0.removal_probability"]),
    ],
)
def test_what_can_hardly_be_meant_is_named_by_its_key(changes: dict[str, Any], doubted: list[str]) -> None:
    assert keys(**changes) == doubted


@pytest.mark.parametrize(
    ("lights", "is_dark"),
    [
        ("", True),
        ('<emitter type="constant"/>', False),
        ('<emitter type="point"/>', False),
        ('<shape type="sphere"><emitter type="area"/></shape>', False),  # a light without an id
    ],
)
def test_a_scene_file_without_any_light_is_doubted(tmp_path: Path, lights: str, is_dark: bool) -> None:
    (tmp_path / "scene.xml").write_text(f'<scene version="3.0.0"><shape type="cube"/>{lights}</scene>')
    described = ROOM | {"scene": {"file": "scene.xml"}}
    found = doubts(*parse_with_lights(described, where="test", beside=tmp_path))
    assert [key for key, _ in found] == (["scene"] if is_dark else [])


def test_a_key_is_found_on_the_line_where_it_stands() -> None:
    lines = lines_of(
        'name = "a"\nscene.file = "b.xml"  # beside\n\n[[objects]]\nname = "[c]"\nshapes = [\n  "d",\n  "e",\n]\n'
        "at = [0, 0, 0]\n[[lights]]\n[[lights]]\nbox = { min = [0, 0, 0], max = [1, 1, 1] }\n[lights.rectangle]\n"
        "size = [1, 1]\n[view]\n"
    )
    assert lines == {
        "name": 1,
        "scene.file": 2,
        "objects.0": 4,
        "objects.0.name": 5,
        "objects.0.shapes": 6,
        "objects.0.at": 10,
        "lights.0": 11,
        "lights.1": 12,
        "lights.1.box": 13,
        "lights.1.rectangle": 14,
        "lights.1.rectangle.size": 15,
        "view": 16,
    }


def test_submit_says_what_is_doubted_with_its_line_and_plans_nevertheless(tmp_path: Path) -> None:
    spec = tmp_path / "mine.toml"
    spec.write_text(find_spec("room").read_text().replace("fov_deg = 70", "fov_deg = 1.2"))
    place = f"{spec} line {1 + spec.read_text().splitlines().index('fov_deg = 1.2')}"
    command = ["submit", str(spec), "--modifications", "2", "--no-queue", "--store", str(tmp_path / "store")]
    told = CliRunner().invoke(umbrella, command)
    assert told.exit_code == 0
    assert told.stderr.startswith(f"warning: {place}: fov_deg = 1.2")
