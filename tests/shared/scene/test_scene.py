import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from PIL import Image
from pydantic import ValidationError

from photonfarm.cli.main import umbrella
from photonfarm.core.errors import SpecError
from photonfarm.core.models import sentences
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import SCENES_VARIABLE, NamedSpec, find_scene, load_spec, parse_spec, scene_folder

SCENE = """<scene version="3.0.0">
  <shape type="ply" id="Floor"><string name="filename" value="meshes/floor.ply"/></shape>
  <shape type="sphere" id="Ball"/>
</scene>"""

SPEC = """
name = "small"
scene.file = "small/scene.xml"
[[objects]]
name = "ball"
shapes = ["Ball"]
at = [0, 0, 0]
box = { min = [-1, 0, -1], max = [1, 0, 1] }
[view]
origin = { min = [0, 0, 0], max = [1, 1, 1] }
look_at = { min = [0, 0, 0], max = [1, 1, 1] }
"""


@pytest.fixture
def scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "scenes"
    (folder / "small/meshes").mkdir(parents=True)
    (folder / "small/scene.xml").write_text(SCENE)
    (folder / "small/meshes/floor.ply").write_bytes(b"ply")
    monkeypatch.setenv(SCENES_VARIABLE, str(folder))
    return folder


def changed(**changes: Any) -> dict[str, Any]:
    return {**tomllib.loads(SPEC), **changes}


def ball(**changes: Any) -> dict[str, Any]:
    return changed(objects=[{**tomllib.loads(SPEC)["objects"][0], **changes}])


def test_a_spec_file_is_read_with_its_defaults(scenes: Path, tmp_path: Path) -> None:
    (tmp_path / "spec.toml").write_text(SPEC)
    spec = load_spec(tmp_path / "spec.toml")
    assert spec.objects[0].removal_probability == 0.2
    assert spec.film.width == 128
    assert [group.name for group in spec.groups] == ["ball"]


def test_scene_show_says_what_cards_do_otherwise(scenes: Path, tmp_path: Path) -> None:
    (file := tmp_path / "spec.toml").write_text(f"{SPEC}[transport]\nlight_samples = 2\n")
    assert "on a card" not in CliRunner().invoke(umbrella, ["scene", "show", str(file)]).output
    file.write_text(f"{file.read_text()}card = {{ connections = 0, rr_depth = 3 }}\n")
    (line,) = [
        line
        for line in CliRunner().invoke(umbrella, ["scene", "show", str(file)]).output.splitlines()
        if "card" in line
    ]
    assert line.split("on a card")[1].strip() == "0 connections, light ratio 1, 2 light samples, roulette from edge 3"


@pytest.mark.parametrize(
    ("described", "named"),
    [
        (ball(shapes=["Bal"]), r"ball\.shapes: 'Bal' .*; nearest: Ball"),
        (ball(box={"min": [0, 1, 0], "max": [0, 0, 0]}), r'objects "ball"\.box: .* y'),
        (ball(removal_probability=1.5), r'objects "ball"\.removal_probability = 1\.5'),
        (ball(removal_probability=-0.1), r'objects "ball"\.removal_probability = -0\.1'),
        (changed(scene={"file": "none/scene.xml"}), r"scene\.file = 'none/scene\.xml'"),
        (changed(scene={}), "scene: .*file.*builtin"),
        (changed(scene={"builtin": "castle"}), r"scene\.builtin = 'castle': .*'cornell' or 'room'"),
        (changed(exposure=0), "exposure = 0"),
        (changed(film={"width": 100, "height": 64}), r"film\.width = 100"),
        (changed(transport={"light_ratio": 0}), "transport: has connections = 1 and light_ratio = 0,"),
        (changed(transport={"card": {"light_ratio": 0}}), "transport: on cards has connections = 1 and light_ratio"),
        (
            changed(transport={"light_ratio": 0, "connections": 0, "guided_light": True}),
            "transport: has guided_light = true and light_ratio = 0",
        ),
        (changed(flm={}), "flm: .*nearest: film"),
        (ball(power={"min": 0, "max": 1}), r'objects "ball"\.power: unknown key; it belongs in \[\[lights\]\]$'),
        (ball(exposure=2), r'objects "ball"\.exposure: unknown key; it belongs above all tables$'),
        (changed(half_spp=2), r"half_spp: unknown key; it belongs in \[transport\]$"),
        (changed(objects=tomllib.loads(SPEC)["objects"] * 2), "'ball'"),
        ({k: v for k, v in changed().items() if k != "view"}, "view: "),
        (ball(at=[0, float("nan"), 0]), r'objects "ball"\.at\.1 = nan'),
    ],
)
def test_an_invalid_spec_is_refused_with_key_and_value(scenes: Path, described: dict[str, Any], named: str) -> None:
    with pytest.raises(SpecError, match=named):
        parse_spec(described, where="spec")


@pytest.mark.parametrize(
    ("added", "named"),
    [
        ('<medium type="homogeneous" id="fog"/>', "fog"),
        ('<bsdf type="polarizer" id="foil"/>', "foil"),
        ('<shape type="obj" id="x"><string name="filename" value="gone.obj"/></shape>', r"gone\.obj"),
        ("<shape>", r"scene\.xml"),
    ],
)
def test_a_scene_that_cannot_be_rendered_is_refused(scenes: Path, added: str, named: str) -> None:
    (scenes / "small/scene.xml").write_text(SCENE.replace("</scene>", added + "</scene>"))
    with pytest.raises(SpecError, match=named):
        parse_spec(changed(), where="spec")


@pytest.mark.parametrize(
    ("changes", "differ"),
    [
        ({"name": "other"}, set()),
        ({"exposure": 2.0}, set()),
        ({"transport": {"connections": 0, "light_ratio": 0.5, "guided_light": True, "light_samples": 2}}, set()),
        ({"transport": {"card": {"connections": 0}}}, set()),
        ({"transport": {"rr_depth": 9}}, set()),
        ({"points": 7}, {"inputs_id"}),
        ({"guides": {"light_samples": 1}}, {"inputs_id"}),
        ({"photons": {"paths": 7}}, {"inputs_id"}),
        ({"transport": {"max_depth": 3}}, {"radiance_id"}),
        ({"transport": {"half_spp": 3}}, {"radiance_id"}),
        ({"film": {"width": 64}}, {"radiance_id"}),
        ({"points": 7, "film": {"width": 64}}, {"inputs_id", "radiance_id"}),
        ({"objects": ball(removal_probability=0.3)["objects"]}, {"radiance_id"}),
    ],
)
def test_each_id_follows_what_it_is_of(scenes: Path, changes: dict[str, object], differ: set[str]) -> None:
    plain, other = (parse_spec(changed(**each), where="spec") for each in ({}, changes))
    found = {name for name in ("radiance_id", "inputs_id") if getattr(plain, name) != getattr(other, name)}
    assert found == differ
    assert (plain.scene_id != other.scene_id) == bool(differ)
    assert (plain.identity() != other.identity()) == bool(differ)
    assert SceneSpec.model_validate_json(other.model_dump_json()) == other


def test_a_folder_does_not_hide_the_spec_of_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "room").mkdir()
    assert load_spec("room").scene.builtin == "room"
    (tmp_path / "hall").mkdir()
    with pytest.raises(SpecError, match="hall: no such spec"):
        load_spec("hall")


def test_an_unknown_name_is_answered_with_all_that_are_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes/attic.toml").write_text("")
    with pytest.raises(SpecError, match="nearest: cornell"):
        load_spec("cornel")
    with pytest.raises(SpecError, match=r"castle: no such spec; give a \.toml file or one of attic, cornell, room$"):
        load_spec("castle")
    (tmp_path / "spec.toml").write_text("name = ")
    with pytest.raises(SpecError, match="is not valid TOML"):
        load_spec(tmp_path / "spec.toml")


def test_the_scene_id_follows_the_content_and_not_the_place(scenes: Path, tmp_path: Path) -> None:
    here = parse_spec(changed(), where="spec").scene_id
    moved = tmp_path / "elsewhere"
    scenes.rename(moved)
    assert parse_spec(changed(), where="spec", beside=moved).scene_id == here
    (moved / "small/meshes/floor.ply").write_bytes(b"another")
    assert parse_spec(changed(), where="spec", beside=moved).scene_id != here


@pytest.mark.parametrize("name", ["wood.jpg", "wood.png"])
def test_a_texture_that_is_cut_short_is_refused_before_anything_is_planned(
    scenes: Path, tmp_path: Path, name: str
) -> None:
    texture, spec = scenes / "small" / name, tmp_path / "spec.toml"
    spec.write_text(SPEC)
    (scenes / "small/scene.xml").write_text(SCENE.replace("meshes/floor.ply", name))
    Image.effect_noise((64, 64), 80).save(texture)
    assert NamedSpec.load(str(spec)).spec.name == "small"
    texture.write_bytes(texture.read_bytes()[:-400])
    with pytest.raises(SpecError, match=f"{name} cannot be read"):
        NamedSpec.load(str(spec))


def test_a_changed_copy_has_an_id_of_its_own(scenes: Path) -> None:
    spec = parse_spec(changed(), where="spec")
    before = spec.scene_id
    copied = spec.model_copy(update={"points": spec.points + 1})
    assert copied.scene_id != before
    assert copied.scene_id == SceneSpec.model_validate(copied.model_dump()).scene_id
    assert copied.model_copy(update={"points": spec.points}).scene_id == spec.scene_id == before


def test_a_light_is_shapes_or_a_rectangle_and_not_both(scenes: Path) -> None:
    light = {"name": "lamp", "at": [0, 2, 0], "box": {"min": [0, 2, 0], "max": [1, 2, 1]}}
    lit = {**light, "rectangle": {"size": [1, 1], "radiance": [3, 3, 3]}}
    assert parse_spec(changed(lights=[lit]), where="spec").lights[0].removal_probability == 0
    dark = {**light, "rectangle": {"size": [1, 1], "radiance": [0, 0, 0]}}
    floor = {**light, "shapes": ["Floor"]}
    for refused, named in ((light, 'lights "lamp"'), (floor, r"lamp\.shapes"), (dark, "radiance")):
        with pytest.raises(SpecError, match=named):
            parse_spec(changed(lights=[refused]), where="spec")


def test_a_file_that_is_no_json_is_told_in_a_short_line_and_so_is_a_long_value() -> None:
    with pytest.raises(ValidationError) as caught:
        SceneSpec.model_validate_json(b"garbage\n" * 1000)
    (said,) = sentences(caught.value)
    assert said.startswith("Invalid JSON")
    with pytest.raises(SpecError) as refused:
        parse_spec(changed(points="many" * 1000), where="spec")
    for line in (said, str(refused.value)):
        assert len(line) < 400
        assert "\n" not in line


def test_the_folder_of_a_scene_file_is_found_also_beside_and_above_the_spec(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PHOTONFARM_SCENES", raising=False)
    (tmp_path / "specs").mkdir()
    (tmp_path / "ball.xml").write_text('<scene version="3.0.0"><shape type="sphere" id="Ball"/></scene>')
    text = SPEC.replace(tomllib.loads(SPEC)["scene"]["file"], "../ball.xml")
    (tmp_path / "specs/a.toml").write_text(text.partition("[[objects]]")[0] + "[view]" + text.partition("[view]")[2])
    name = str(tmp_path / "specs/a.toml")
    assert scene_folder(name, load_spec(name)) == tmp_path / "specs"
    assert scene_folder("room", load_spec("room")) is None
    monkeypatch.chdir(tmp_path / "specs")
    monkeypatch.setenv("PHOTONFARM_SCENES", str(tmp_path / "specs"))
    with pytest.raises(SpecError, match=re.escape(f"(looked in: {tmp_path / 'specs'}); set")):
        find_scene("none.xml", "a", tmp_path / "specs")
