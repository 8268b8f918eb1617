"""`photonfarm render`: a stored sample is made again to the bit, and one that is not is said to be off."""

import json
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from photonfarm.core.errors import SceneNotHereError, StoreError
from photonfarm.plan.request import Request
from photonfarm.renderer.cli import sample_verbs
from photonfarm.renderer.jobs.render import SceneLoader, ShardRenderer
from photonfarm.renderer.jobs.repeat import Repeated, repeat
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.scene.spec_loading import load_spec
from photonfarm.store import SceneReader, SceneStore, Store


def again(scene: SceneStore, row: int, pass_number: int | None = None, *, load: SceneLoader) -> Repeated:
    return repeat(scene.folder.parent.parent, scene.scene_id, row, pass_number, lambda _: None, load)


@pytest.fixture
def room(store: Store, small: Any) -> SceneStore:
    """Two configurations of the built-in room, one view of each and two passes of that, the first job rendered."""
    spec = small(load_spec("room"))
    scene = store.scene(
        store.plan(spec, Request(modifications=2, views_per_modification=1, passes=2), shard_rows=2).scene_id
    )
    assert ShardRenderer(store, worker="test", load=LoadedScene.load).render(scene.scene_id, 0)
    return scene


def test_a_stored_pass_is_made_again_to_the_bit_and_one_that_is_not_stored_is_rendered_all_the_same(
    room: SceneStore,
) -> None:
    for row, pass_number, found_in in ((0, None, 0), (1, None, 1), (1, 0, 0)):
        found = again(room, row, pass_number, load=LoadedScene.load)
        assert (found.row, found.comparison and found.comparison.is_equal, found.exit_code) == (found_in, True, 0)
    not_complete, not_planned = again(room, 3, load=LoadedScene.load), again(room, 0, 7, load=LoadedScene.load)
    assert (not_complete.row, not_complete.comparison, not_complete.exit_code) == (3, None, 0)
    assert (not_planned.row, not_planned.comparison, not_planned.exit_code) == (None, None, 0)
    assert not np.array_equal(not_planned.halves, found.halves)
    with pytest.raises(StoreError):
        again(room, 4, load=LoadedScene.load)


def rendered(analytic: ModuleType, store: Store, **changes: Any) -> SceneStore:
    """One job of the analytic scene, rendered."""
    spec = analytic.small_spec(film={"width": 32, "height": 32}, **changes)
    scene = store.scene(store.plan(spec, Request(modifications=2), shard_rows=4).scene_id)
    ShardRenderer(store, worker="test", load=analytic.AnalyticScene).render(scene.scene_id, 0)
    return scene


@pytest.fixture
def analytic_store(analytic: ModuleType, store: Store) -> SceneStore:
    """One job of it."""
    return rendered(analytic, store)


@pytest.mark.parametrize("exposure", [1e-3, 1e5])
def test_what_is_rendered_is_rounded_as_the_store_rounds(analytic: ModuleType, store: Store, exposure: float) -> None:
    scene = rendered(analytic, store, exposure=exposure)
    wide = list(scene.folder.glob("plans/000000/radiance_wide/c.*"))
    assert bool(wide) == (exposure > 1)
    assert again(scene, 1, load=analytic.AnalyticScene).exit_code == 0


@pytest.mark.parametrize(("factor", "exit_code"), [(1.0, 0), (1 + 1e-3, 1), (1.5, 4)])
def test_what_differs_by_rounding_and_what_differs_by_more_have_their_exit_codes(
    analytic: ModuleType, analytic_store: SceneStore, factor: float, exit_code: int
) -> None:
    class Other(analytic.AnalyticScene):  # type: ignore[name-defined, misc]
        """The scene as another machine might render it."""

        def render_halves(self, view: Any, seeds: Any) -> Any:
            return super().render_halves(view, seeds) * np.float32(factor)

    found = again(analytic_store, 1, load=Other)
    assert found.exit_code == exit_code
    assert found.comparison is not None
    assert found.comparison.relative == pytest.approx(factor - 1, rel=0.2)
    assert found.comparison.is_equal == (factor == 1)


def test_what_a_card_rendered_is_not_said_to_be_repeatable_to_the_bit(
    analytic: ModuleType, analytic_store: SceneStore
) -> None:
    class Other(analytic.AnalyticScene):  # type: ignore[name-defined, misc]
        """The scene as a processor renders it."""

        def render_halves(self, view: Any, seeds: Any) -> Any:
            return super().render_halves(view, seeds) * np.float32(1 + 1e-3)

    (marker,) = analytic_store.folder.glob("committed/*.json")
    content = json.loads(marker.read_text())
    assert (content["figures"]["device"], content["figures"]["driver"]) == ("cpu", "")
    for figures, on_card in (
        ({"device": "NVIDIA H100", "driver": "550.54"}, True),
        ({"device": "cpu", "driver": ""}, False),
        ({}, False),  # as an older photonfarm wrote it
    ):
        rest = {name: value for name, value in content["figures"].items() if name not in ("device", "driver")}
        marker.write_text(json.dumps({**content, "figures": {**rest, **figures}}))
        found = again(analytic_store, 1, load=Other)
        assert found.comparison is not None
        assert found.exit_code == 1
        assert ("rendered on NVIDIA H100, here on cpu" in found.line()) == on_card


def test_a_pass_is_written_as_an_archive_an_image_with_layers_or_a_picture(
    analytic: ModuleType, analytic_store: SceneStore, tmp_path: Path
) -> None:
    import OpenEXR

    found = again(analytic_store, 0, load=analytic.AnalyticScene)
    for suffix in ("npz", "exr", "png"):
        found.write(tmp_path / f"pass.{suffix}")
    with np.load(tmp_path / "pass.npz") as archive:
        np.testing.assert_array_equal([archive["A"], archive["B"]], found.halves)
        assert str(archive["key"]) == found.key
    with OpenEXR.File(str(tmp_path / "pass.exr")) as image:
        layers = {name: channel.pixels for name, channel in image.channels().items()}
    np.testing.assert_array_equal([layers["A"], layers["B"]], found.halves)
    np.testing.assert_array_equal(layers["RGB"], found.halves.mean(axis=0, dtype=np.float32))
    with Image.open(tmp_path / "pass.png") as picture:
        assert picture.size == found.halves.shape[2:0:-1]


def test_the_verb_says_that_the_sample_is_equal_and_leaves_the_store_as_it_is(room: SceneStore) -> None:
    store = room.folder.parent.parent
    before = {file: file.stat().st_mtime_ns for file in store.rglob("*")}
    arguments = ["room", "--store", str(store), "--row", "0", "--json"]
    done = CliRunner().invoke(sample_verbs.render, arguments)
    assert done.exit_code == 0, done.output
    said = json.loads(done.stdout)
    assert (said["row"], said["pass"], said["stored"]["equal"]) == (0, 0, True)
    assert {file: file.stat().st_mtime_ns for file in store.rglob("*")} == before
    reader = SceneReader(store, room.scene_id)
    reader.refresh()
    assert said["stored"]["values"] == reader.read(0).radiance.size


def test_a_scene_is_found_beside_its_spec_and_below_the_current_folder(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    ball = '<shape type="sphere" id="ball"><emitter type="area"/></shape>'
    (folder / "ball.xml").write_text(f'<scene version="3.0.0">{ball}</scene>')
    (folder / "ball.toml").write_text(
        'name = "ball"\nscene.file = "ball.xml"\nfilm = { width = 16, height = 16 }\n'
        "[view]\norigin = { min = [0, 0, 3], max = [1, 1, 4] }\nlook_at = { min = [0, 0, 0], max = [1, 1, 1] }\n"
    )
    scene = store.scene(store.plan(load_spec(folder / "ball.toml"), Request(modifications=1)).scene_id)
    monkeypatch.delenv("PHOTONFARM_SCENES", raising=False)
    with pytest.raises(SceneNotHereError):
        repeat(store.storage.where, "ball", 0, None, lambda _: None, LoadedScene.load)
    with monkeypatch.context() as here:
        here.chdir(folder)
        ShardRenderer(store, worker="test", load=LoadedScene.load).render(scene.scene_id, 0)
        by_name = repeat(store.storage.where, "ball", 0, None, lambda _: None, LoadedScene.load)
    by_file = repeat(store.storage.where, str(folder / "ball.toml"), 0, None, lambda _: None, LoadedScene.load)
    assert by_name.exit_code == by_file.exit_code == 0
    assert by_name.comparison
    assert by_name.comparison.is_equal
    assert by_file.comparison
    assert by_file.comparison.is_equal
