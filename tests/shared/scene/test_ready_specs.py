import os
from pathlib import Path

import pytest

from photonfarm.core.errors import SpecError
from photonfarm.scene.groups import Light
from photonfarm.scene.spec import BUILTIN_ROOMS, Emitters
from photonfarm.scene.spec_loading import SCENES_VARIABLE, load_spec

ROOT = Path(__file__).parents[3]
READY = sorted((ROOT / "scenes").glob("*.toml"))
STATIC = {"bathroom", "kitchen"}
NIGHT = {"living-room-night", "living-room-2-night", "dining-room-night"}


@pytest.fixture
def real_rooms(monkeypatch: pytest.MonkeyPatch) -> None:
    folder = Path(os.environ.get(SCENES_VARIABLE) or ROOT.parent / "shared/scenes")
    if not (folder / "kitchen/scene.xml").is_file():
        pytest.skip(f"the real rooms are not here; set {SCENES_VARIABLE} to their folder")
    monkeypatch.setenv(SCENES_VARIABLE, str(folder))


def test_all_ready_specs_are_there() -> None:
    moving = {"living-room", "living-room-2", "dining-room", "veach-ajar"}
    assert {path.stem for path in READY} == STATIC | moving | NIGHT


@pytest.mark.parametrize("path", READY, ids=lambda path: path.stem)
def test_a_ready_spec_loads_and_keeps_its_objects_on_the_floor(path: Path, real_rooms: None) -> None:
    spec = load_spec(path)
    assert spec.name == path.stem
    assert bool(spec.groups) == (path.stem not in STATIC)
    for group in spec.groups:
        assert group.box.min[1] == group.box.max[1] == group.at[1], group.name


def test_a_real_room_has_movable_lights_that_its_spec_adds(real_rooms: None) -> None:
    lights = load_spec(ROOT / "scenes/living-room-2.toml").lights
    assert len(lights) == 2
    assert all(isinstance(light, Light) and light.rectangle for light in lights)


@pytest.mark.parametrize("name", sorted(NIGHT))
def test_a_room_at_night_is_the_room_with_its_own_lights_off_and_lamps_that_move(name: str, real_rooms: None) -> None:
    night, day = (load_spec(ROOT / f"scenes/{stem}.toml") for stem in (name, name.removesuffix("-night")))
    assert night.emitters == Emitters(all=0)
    assert len(night.lights) == 2
    assert night.lights == (day.lights or night.lights)
    same = {"emitters", "exposure", "guides", "lights", "name", "photons", "transport"}
    assert night.model_dump(exclude=same) == day.model_dump(exclude=same)


def test_without_the_folder_of_scenes_the_message_says_what_to_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(SCENES_VARIABLE, str(tmp_path))
    with pytest.raises(SpecError, match=rf"{READY[0].stem}/scene\.xml.*{SCENES_VARIABLE}"):
        load_spec(READY[0])


@pytest.mark.parametrize("name", BUILTIN_ROOMS)
def test_built_in_specs_load_by_name_anywhere(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv(SCENES_VARIABLE, raising=False)
    spec = load_spec(name)
    assert (spec.name, spec.scene.builtin, spec.film.width, spec.film.height) == (name, name, 64, 64)
