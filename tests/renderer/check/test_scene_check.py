"""`scene check` and `scene shapes` on a small room: a closed box, a lamp under its ceiling, and a block that moves."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from photonfarm.cli.main import umbrella
from photonfarm.farm import renderer_verbs
from photonfarm.plan.request import PlannedContent, Request, expand
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.renderer.tools.check import samples
from photonfarm.renderer.tools.check.scene_check import SceneCheck, check
from photonfarm.renderer.tools.check.shape_pictures import PAPER, Projection, draw_scene
from photonfarm.scene.spec_loading import NamedSpec, load_spec

ROOM = """<scene version="3.0.0">
<shape type="cube" id="walls"><transform name="to_world"><scale x="2" y="1.5" z="2"/><translate y="1.5"/></transform>
  <bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>
<shape type="rectangle" id="lamp"><transform name="to_world"><rotate x="1" angle="90"/><translate y="2.9"/></transform>
  <emitter type="area"><rgb name="radiance" value="4"/></emitter></shape>
<shape type="cube" id="block"><transform name="to_world"><scale value="0.4"/><translate y="0.4"/></transform></shape>
<shape type="sphere"><float name="radius" value="0.1"/><point name="center" x="1.8" y="0.1" z="1.8"/></shape>
</scene>"""

SPEC = """name = "small"
scene.file = "scene.xml"
exposure = 1.0
points = 512

[[objects]]
name = "block"
shapes = ["block"]
at = [0, 0, 0]
box = { min = [-1.2, 0, -1.2], max = [1.2, 0, 1.2] }

[view]
origin = { min = [-1.8, 1.2, -1.8], max = [1.8, 2, 1.8] }
look_at = { min = [-1.5, 0.1, -1.5], max = [1.5, 1.5, 1.5] }

[film]
width = 16
height = 16

[transport]
max_depth = 5
"""

Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Write:
    """Function (texts and what replaces them …) → the spec's file, beside its scene; checks of it are short."""
    monkeypatch.setattr(samples, "COUNT", 4)
    monkeypatch.setattr(samples, "VIEWS", 16)

    def written(*changes: tuple[str, str]) -> Path:
        text = SPEC
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "scene.xml").write_text(ROOM)
        (tmp_path / "mine.toml").write_text(text)
        return tmp_path / "mine.toml"

    return written


def checked(spec: Path) -> SceneCheck:
    return check(NamedSpec.load(str(spec)), lambda _: None)


AT, BOX = "at = [0, 0, 0]", "box = { min = [-1.2, 0, -1.2], max = [1.2, 0, 1.2] }"
ORIGIN = "origin = { min = [-1.8, 1.2, -1.8], max = [1.8, 2, 1.8] }"


@pytest.mark.parametrize(
    ("changes", "serious", "notes"),
    [
        ((), [], []),
        ([(ORIGIN, "origin = { min = [230, 1, 0], max = [231, 2, 1] }")], ["view.origin"], []),
        ([(ORIGIN, "origin = { min = [-6, 1.2, -1], max = [0, 2, 1] }")], ["view.origin"], []),
        (
            [
                (ORIGIN, "origin = { min = [-0.3, 0.1, -0.3], max = [0.3, 0.7, 0.3] }"),
                (BOX, "box.min = [0, 0, 0]\nbox.max = [0.1, 0, 0.1]"),
            ],
            ["view.origin"],
            [],
        ),
        ([(AT, "at = [5, 0, 0]")], ["objects.0.at"], []),
        ([(BOX, "box = { min = [-120, 0, -120], max = [120, 0, 120] }")], ["objects.0.box"], []),
        ([(BOX, "box = { min = [-3, 0, -3], max = [3, 0, 3] }")], ["objects.0.box"], []),
        ([(BOX, "box = { min = [-1.75, 0, 0], max = [-1.4, 0, 0.1] }")], ["objects.0.box"], []),
        ([(BOX, "box = { min = [-1.2, 0.35, -1.2], max = [1.2, 0.35, 1.2] }")], [], ["objects.0.box.min"]),
        ([("exposure = 1.0", "exposure = 100.0")], ["exposure"], []),
        ([("max_depth = 5", "max_depth = 0")], ["transport.max_depth"], []),
        ([("[view]", "[emitters]\nall = 0\n[view]")], ["emitters"], []),
        ([("[film]", "fov_deg = 1.2\n[film]")], ["view.fov_deg"], []),
    ],
)
def test_each_fault_has_its_own_finding_and_no_other(
    write: Write, changes: list[tuple[str, str]], serious: list[str], notes: list[str]
) -> None:
    found = checked(write(*changes)).findings
    assert [finding.key for finding in found if finding.serious] == serious
    assert [finding.key for finding in found if not finding.serious] == notes


def test_a_scene_far_from_the_origin_is_found_before_all_else(write: Write, tmp_path: Path) -> None:
    group = SPEC[SPEC.index("[[objects]]") : SPEC.index("[view]")]
    ends = [
        (f"{end} = [{sign}{x}", f"{end} = [{10000 + float(f'{sign}{x}')}")
        for x in ("1.8", "1.5")
        for end, sign in (("min", "-"), ("max", ""))
    ]
    spec = write((group, ""), *ends)
    moved = ROOM.replace("</transform>", '<translate x="10000"/></transform>').replace('x="1.8"', 'x="10001.8"')
    (tmp_path / "scene.xml").write_text(moved)
    (found, *_) = checked(spec).findings
    assert found.key == "scene.file"
    assert "photonfarm scene import scene.xml" in found.sentence


def test_a_carpet_is_in_the_way_of_nothing(write: Write, tmp_path: Path) -> None:
    spec = write()
    rug = '<shape type="cube" id="rug"><transform name="to_world"><scale x="0.4" y="0.02" z="2"/><translate x="0.9" '
    (tmp_path / "scene.xml").write_text(ROOM.replace("</scene>", f'{rug} y="0.02"/></transform></shape></scene>'))
    assert not checked(spec).findings


@pytest.mark.parametrize("static", [False, True])
def test_the_pictures_are_the_samples_that_submit_plans_first(write: Write, static: bool) -> None:
    group = SPEC[SPEC.index("[[objects]]") : SPEC.index("[view]")]
    path = write((group, "")) if static else write()
    spec = load_spec(path)
    planned = expand(spec, Request(modifications=4), PlannedContent(), first_job=0, shard_rows=4).rows
    assert planned is not None
    shown = checked(path).measured.samples.shown
    np.testing.assert_array_equal([each.view.vector for each in shown], planned.view[planned.sample_view])
    configurations = planned.modification[planned.sample_modification]
    np.testing.assert_array_equal([each.modification.vector for each in shown], configurations)


def test_the_page_is_written_and_findings_name_their_lines(write: Write) -> None:
    spec = write(("exposure = 1.0", "exposure = 100.0"))
    out = spec.with_name("check.html")
    told = CliRunner().invoke(umbrella, ["scene", "check", str(spec), "--out", str(out), "--json"])
    assert told.exit_code == 0, told.output
    (finding,) = json.loads(told.stdout)
    assert (finding["key"], finding["line"], finding["file"]) == ("exposure", 3, str(spec))
    page = out.read_text()
    assert page.count("<img") == samples.COUNT + 4  # and a picture of each shape
    assert page.count('<svg class="plan"') == page.count("<image") == 2
    assert "mine.toml line 3" in page


def test_a_page_under_the_name_of_a_picture_is_refused_before_anything_is_rendered(write: Write) -> None:
    told = CliRunner().invoke(umbrella, ["scene", "check", str(write()), "--out", "check.png"])
    assert told.exit_code == 2


def test_a_spec_that_cannot_be_used_has_the_exit_code_of_a_wrong_spec(write: Write) -> None:
    spec = write(('shapes = ["block"]', 'shapes = ["blok"]'))
    told = CliRunner().invoke(umbrella, ["scene", "check", str(spec), "--out", str(spec.with_name("no.html"))])
    assert told.exception.exit_code == 3  # type: ignore[union-attr]
    assert not spec.with_name("no.html").exists()


def test_what_files_say_is_looked_at_alone_and_submit_says_the_same_before_it_plans(
    write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    spec, wall = str(write()), "block reaches outside the room (all that never moves)"
    (rooms := tmp_path / "rooms.csv").write_text(
        "block.x,camera.x,camera.y,camera.z\n2,1.5,1.5,0\n,0,0.4,0\n2,1.5,1.5,0.5\n"
    )
    from_file = ["--configurations", str(rooms)]
    told = CliRunner().invoke(umbrella, ["scene", "check", spec, *from_file, "--json"])
    expected = [
        "frame-0000 and 1 more: block stands at 2,0,0, outside its box from -1.2,0,-1.2 to 1.2,0,1.2",
        f"frame-0000 and 1 more: {wall}",
        "frame-0001: the camera stands at 0,0.4,0, outside the spec's box from -1.8,1.2,-1.8 to 1.8,2,1.8",
        "frame-0001: the camera is inside 'block'",
    ]
    assert json.loads(told.stdout) == expected
    assert not list(tmp_path.glob("*.html"))
    planned = CliRunner().invoke(umbrella, ["submit", spec, *from_file, "--store", str(tmp_path / "s"), "--no-queue"])
    assert "3 samples planned" in planned.stdout
    assert {f"warning: {doubt}" for doubt in expected} <= {*planned.stderr.splitlines()}
    assert "looking at what stands where in small" in capfd.readouterr().err
    monkeypatch.setattr(renderer_verbs, "can_render", lambda: False)
    lacking = CliRunner().invoke(umbrella, ["submit", spec, *from_file, "--store", str(tmp_path / "t"), "--no-queue"])
    assert "is not known: the renderer is not installed here" in lacking.stderr


def shapes_of(name: str | Path) -> list[dict[str, Any]]:
    told = CliRunner().invoke(umbrella, ["scene", "shapes", str(name), "--json"])
    assert told.exit_code == 0, told.output
    return json.loads(told.stdout)


def test_shapes_are_listed_with_their_group_material_and_box(write: Write) -> None:
    walls, lamp, block, ball = shapes_of(write())
    assert (walls["id"], walls["material"], walls["triangles"]) == ("walls", "twosided/diffuse", 12)
    assert [shape["emits"] for shape in (walls, lamp, block)] == [False, True, False]
    assert [shape["group"] for shape in (walls, lamp, block)] == [None, None, "block"]
    np.testing.assert_allclose([block["min"], block["max"]], [[-0.4, 0, -0.4], [0.4, 0.8, 0.4]], atol=1e-6)
    assert (ball["id"], ball["triangles"]) == ("", None)


def test_shapes_of_a_bare_scene_file_are_listed(write: Write) -> None:
    assert shapes_of(write().with_name("scene.xml"))[2] == shapes_of(write())[2] | {"group": None}


def test_a_drawing_shows_a_shape_where_points_of_it_are_projected_to(write: Write) -> None:
    spec = write()
    scene = LoadedScene.load(load_spec(spec), spec.parent).scene
    right, down, below = np.array([1.0, 0, 0]), np.array([0, 0, 1.0]), np.array([0, -1.0, 0])
    plan = Projection(right, down, below, np.array([-3.0, -3]), np.array([3.0, 3]), -1.0)  # cut at a height of 1
    red = np.where(np.arange(4)[:, None] == 2, [1, 0, 0], [0, 0, 1]).astype(np.float32)  # the block, all else blue
    picture = draw_scene(scene, plan, 120, red)
    for place, colour in (([0.3, 0.5, -0.3], "block"), ([1.0, 0.5, -0.3], "floor"), ([2.5, 0, 2.5], "paper")):
        x, y = (120 * plan.flat(np.array(place))).astype(int)
        expected = {"block": [True, False], "floor": [False, True]}.get(colour)
        pixel = picture[y, x]
        assert [*(pixel[[0, 2]] > 100)] == expected if expected else [*pixel] == [PAPER] * 3
