"""Factors on the radiance of a scene's own lights: what a spec may say of them, and what follows for its id."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from photonfarm.cli.main import umbrella
from photonfarm.core.errors import SpecError
from photonfarm.scene.spec import Emitters, SceneSpec
from photonfarm.scene.spec_loading import find_spec, load_spec, parse_spec
from photonfarm.store import Store

ROOT = Path(__file__).parents[3]

SCENE = """<scene version="3.0.0">
  <emitter type="area" id="Panel"/>
  <shape type="rectangle" id="Window_0001"><emitter type="area"/></shape>
  <shape type="rectangle" id="Window_0002"><ref id="Panel"/></shape>
  <shape type="rectangle" id="Window_0003"><emitter type="area"/></shape>
  <shape type="rectangle" id="Lamp"><emitter type="area"/></shape>
  <shape type="sphere" id="Ball"/>
  <emitter type="envmap" id="Sky"/>
  <emitter type="point" id="Bulb"/>
  <emitter type="point"/>
</scene>"""

INSIDE = {"min": [0, 0, 0], "max": [1, 1, 1]}
LAMP = {"name": "lamp", "shapes": ["Lamp", "Ball"], "at": [0, 2, 0], "box": INSIDE}
ADDED = {"name": "added", "at": [0, 2, 0], "box": INSIDE, "rectangle": {"size": [1, 1], "radiance": [3, 3, 3]}}


@pytest.fixture
def beside(tmp_path: Path) -> Path:
    (tmp_path / "scene.xml").write_text(SCENE)
    return tmp_path


def spec(beside: Path, emitters: Any = None, **changes: Any) -> SceneSpec:
    described = {"name": "small", "scene": {"file": "scene.xml"}, "view": {"origin": INSIDE, "look_at": INSIDE}}
    said = {} if emitters is None else {"emitters": emitters}
    return parse_spec({**described, "lights": [LAMP, ADDED], **said, **changes}, where="spec", beside=beside)


def test_a_factor_is_that_of_the_light_or_else_that_of_all(beside: Path) -> None:
    said = "[emitters]\nall = 0.5\nby_id = { Window_0003 = 0, environment = 2, Bulb = 0.1 }"
    emitters = spec(beside, **tomllib.loads(said)).emitters
    names = ("Window_0001", "Window_0003", "environment", "Bulb", "")
    assert [emitters.factor(name) for name in names] == [0.5, 0, 2, 0.1, 0.5]
    assert str(emitters) == "Window_0003 × 0, environment × 2, Bulb × 0.1, all others × 0.5"
    assert spec(beside).emitters.factor("Window_0001") == 1


@pytest.mark.parametrize(
    ("emitters", "named"),
    [
        ({"all": -0.5}, r"emitters\.all = -0\.5"),
        ({"all": float("inf")}, r"emitters\.all = inf"),
        ({"by_id": {"Window_0001": float("nan")}}, r"emitters\.by_id\.Window_0001 = nan"),
        ({"by_id": {"Window_0001": -1}}, r"emitters\.by_id\.Window_0001 = -1"),
        ({"Window_0001": 0}, r"'Window_0001'.*by_id = \{"),
        ({"by_id": {"Window_0004": 0}}, "nearest light: Window_000"),
        ({"by_id": {"environmnt": 0}}, "nearest light: environment"),
        ({"by_id": {"Panel": 0}}, "'Panel'"),
        ({"by_id": {"Lamp": 0}}, r"'Lamp'.*take it out of \[\[lights\]\]"),
        ({"by_id": {"added": 0}}, r"'added'.*radiance"),
    ],
)
def test_factors_that_cannot_be_are_refused_with_the_reason(beside: Path, emitters: Any, named: str) -> None:
    with pytest.raises(SpecError, match=named):
        spec(beside, emitters)


def test_a_factor_of_what_does_not_emit_is_refused(beside: Path) -> None:
    with pytest.raises(SpecError):
        spec(beside, {"by_id": {"Ball": 0}}, lights=[])
    described = tomllib.loads(find_spec("room").read_text())
    with pytest.raises(SpecError, match=r"nearest light: lamp-shade$"):
        parse_spec({**described, "emitters": {"by_id": {"lamp-stand": 0}}}, where="room")


# ---------------------------------------------------------------------------------------------------------- the id

CONTENT = {
    "bathroom": "782fd24414c061331ba08f915c5485c49820485c28aa53ce91e7e5f4dd8b25c4",
    "dining-room": "5c06702aaf3355c7a39410de49b47c82620e4cfb698bbcd484cf6f55513c25ca",
    "kitchen": "bc3d9b7a9ca18794ecb19bf52c4a821935f205549f00c82c8ff4f22a1893d20b",
    "living-room": "da61e433b6aeff3965079d8eec1c375683e86e8563b7e21621a10ad344b359c0",
    "living-room-2": "e430bca21afdf8f12d794aac5b4cf92a31215b0128036640a05d38d5aff50f47",
    "veach-ajar": "38cabe83bf383cde61b5229c9d6475eab7bd8ac931ec817bf7666f8c3d336662",
}
"""Digests of the scene files that the ready specs were written for."""

IDS = {
    "bathroom": "72ed517684da36e07c11cd7c810dedb9",
    "dining-room": "de9006e8e59cce8f4ad7c525169519cc",
    "kitchen": "0aba70adc39be58b76362b7e5c3a20d6",
    "living-room": "3e558b92d031298d3fc69ddeaaf08465",
    "living-room-2": "15487555efc6e0dd8cc007dd3883ec99",
    "veach-ajar": "f5cd1a43460653ffed147fee2e76250d",
}
"""Their scene ids."""

BUILT_IN = {"room": "33980aa53a26441682c704d27a135e01", "cornell": "b9bde84b7983cda0ba4f8a93cd0db9b7"}


@pytest.mark.parametrize("name", IDS)
def test_ready_specs_keep_the_ids_that_stores_have(name: str) -> None:
    described = tomllib.loads((ROOT / f"scenes/{name}.toml").read_text())
    assert SceneSpec.model_validate({**described, "content": CONTENT[name]}).scene_id == IDS[name]


@pytest.mark.parametrize("name", BUILT_IN)
def test_built_in_specs_keep_the_ids_that_stores_have(name: str) -> None:
    assert load_spec(name).scene_id == BUILT_IN[name]


def test_factors_of_1_for_all_are_the_same_scene_and_any_others_another(beside: Path) -> None:
    plain = spec(beside)
    assert spec(beside, {}).scene_id == spec(beside, {"all": 1}).scene_id == plain.scene_id
    others = [{"all": 0}, {"all": 0.5}, {"by_id": {"Bulb": 0}}, {"by_id": {"Window_0001": 0}}]
    assert len({plain.scene_id, *(spec(beside, said).scene_id for said in others)}) == 5
    dimmed = plain.model_copy(update={"emitters": Emitters(all=0)})
    assert dimmed.scene_id == spec(beside, {"all": 0}).scene_id
    several = {"Bulb": 0.5, "environment": 0.25}
    turned = dict(reversed(several.items()))
    assert spec(beside, {"by_id": several}).scene_id == spec(beside, {"by_id": turned}).scene_id


def test_a_store_says_factors_only_where_there_are_some_and_both_are_read_back(beside: Path, store: Store) -> None:
    for said, written in ((None, None), ({"all": 0.0}, {"all": 0.0, "by_id": {}})):
        given = spec(beside, said)
        stored = store.add(given)
        file = Path(store.root) / "scenes" / given.scene_id / "spec.json"
        assert json.loads(file.read_text()).get("emitters") == written
        assert Store(store.root).scene(given.scene_id).spec.emitters == given.emitters
        assert stored.spec.scene_id == given.scene_id


def test_scene_show_says_the_factors(beside: Path) -> None:
    described = spec(beside, {"all": 0.0, "by_id": {"environment": 0.25}}).model_dump(mode="json")
    (beside / "spec.json").write_text(json.dumps({key: described[key] for key in described if key != "content"}))
    shown = CliRunner().invoke(umbrella, ["scene", "show", str(beside / "spec.json")])
    assert shown.output.endswith("the scene's own lights: environment × 0.25, all others × 0\n")
    told = CliRunner().invoke(umbrella, ["scene", "show", str(beside / "spec.json"), "--json"])
    assert json.loads(told.output)["emitters"] == {"all": 0.0, "by_id": {"environment": 0.25}}
    assert "own lights" not in CliRunner().invoke(umbrella, ["scene", "show", "room"]).output
