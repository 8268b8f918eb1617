"""How much of what moved lamps change is explained, for real in a tiny room; and which groups are lamps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.harness import room_study
from bench.trainer import moved_lamps
from bench.trainer.moved_lamps import (
    KNOWN,
    ExplainedChange,
    PredictorGroup,
    Stage,
    Views,
    held_out,
    lamps,
    stays,
    trained_runs,
)
from photonfarm.core.errors import IncompleteError
from photonfarm.core.processes import Stop
from photonfarm.core.records import F32, ViewBuffers
from photonfarm.plan.request import Request
from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.scene.spec import Emitters, SceneSpec
from photonfarm.scene.spec_loading import load_spec
from photonfarm.store import SceneReader, Store
from photonfarm.trainer.data.batch import TrainingBatch
from photonfarm.trainer.networks.inputs import Needs
from photonfarm.trainer.predict.evaluation import Predictor, make_constant_predictor
from photonfarm.trainer.predict.trained import TrainedRun
from photonfarm.trainer.runs.settings import make_preset
from photonfarm.trainer.training.loop import Hooks, train

HOLD_OUT = 0.5
SIZE = 16


# ------------------------------------------------------------------------------------------------------------ a room


def tiny() -> SceneSpec:
    plain = load_spec("room")
    changes: dict[str, Any] = {
        "film": plain.film.model_copy(update={"width": SIZE, "height": SIZE}),
        "photons": plain.photons.model_copy(update={"paths": 64}),
        "transport": plain.transport.model_copy(update={"half_spp": 1}),
        "guides": plain.guides.model_copy(update={"light_samples": 1}),
        "points": 256,
    }
    return plain.model_copy(update=changes)


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one experiment: a network of two steps from each of two seeds, and one that was cut."""
    folder = tmp_path_factory.mktemp("work") / "tiny"
    spec = tiny()
    store = Store(folder / "store", create=True)
    scene = store.add(spec)
    scene.plan(Request(modifications=6, seed=2), shard_rows=6)  # of these, some are held out
    ShardRenderer(store, worker="test").render(spec.scene_id, 0)
    (folder / "spec.json").write_text(spec.model_dump_json())
    network = {"architecture": "guided_transport_photons", "width": 2, "points": 128, "lit_points": 16}
    for name, seed in (("guided", 0), ("guided-1", 1), ("cut", 2)):
        settings = make_preset("small", network=network, seed=seed, hold_out=HOLD_OUT, max_steps=2, minimum_samples=1)
        stop = Stop()
        if name == "cut":
            stop.set()
        train(SceneReader(store.root, spec.scene_id), settings, folder / "runs" / name, Hooks(stop=stop))
    return folder.parent


@pytest.fixture(scope="module")
def views(work: Path) -> Views:
    """Two views of it."""
    store, scene_id = Store(work / "tiny/store"), tiny().scene_id
    source = SceneReader(store.root, scene_id)
    rows = held_out(source, HOLD_OUT, 2)
    return Stage.of(store, scene_id, half_spp=8).views(source, rows)


def row(views: Views, predict: Predictor) -> ExplainedChange:
    return views.row(PredictorGroup("made up", (0,), (predict,), Needs()))


@pytest.mark.slow
def test_who_knows_the_reference_explains_all(views: Views) -> None:
    found = row(views, lambda batch: batch.target[:, 0].numpy())
    for explained in (found.whole, found.stays):
        assert explained.share == pytest.approx(1, abs=1e-6)
        assert explained.interval() == pytest.approx((1, 1), abs=1e-6)


@pytest.mark.slow
def test_a_prediction_that_does_not_change_explains_nothing(views: Views) -> None:
    found = row(views, make_constant_predictor(np.full(3, 0.4, np.float32)))
    for explained in (found.whole, found.stays):
        assert explained.share == pytest.approx(0, abs=1e-6)
        assert explained.interval() == pytest.approx((0, 0), abs=1e-6)


@pytest.mark.slow
def test_objects_stay_and_lamps_move(views: Views) -> None:
    shines = lamps(views.spec)
    for first, second in views.pairs:
        before, after = first.modification.vector, second.modification.vector
        np.testing.assert_array_equal(before[~shines], after[~shines])
        assert (before[shines] != after[shines]).any(axis=1).all()
        np.testing.assert_array_equal(first.view.vector, second.view.vector)
    assert 0 < views.change.stays.mean() < 1
    assert all(errors.values.min() > 0 for errors in views.change.there())


@pytest.mark.slow
def test_a_network_is_told_of_a_view_as_it_is_what_the_store_holds_of_it(work: Path, views: Views) -> None:
    run = TrainedRun.load(work / "tiny/runs/guided")
    looked, source = (SceneReader(work / "tiny/store", run.scene_id) for _ in range(2))
    stored = room_study.images(run, source, held_out(looked, HOLD_OUT, 2))
    made: list[F32] = []

    def predict(batch: TrainingBatch) -> F32:
        made.append(network(batch).copy())
        return made[-1]

    network = run.predictor(views.spec, views.base, "cpu")
    views.predicted(predict, PredictorGroup("recorded", (0,), (predict,), run.needs, run.settings.network.points))
    as_they_are = np.concatenate(made[::2])
    np.testing.assert_allclose(as_they_are, stored, rtol=0.01, atol=0.003)  # what is stored is rounded to 8 bits
    assert np.abs(np.concatenate(made[1::2]) - stored).mean() > 0.01


@pytest.mark.slow
def test_networks_of_several_seeds_are_one_row_beside_what_is_known(
    work: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = ["--work", str(work), "--out", str(tmp_path), "--views", "2", "--half-spp", "8"]
    monkeypatch.setattr("sys.argv", ["moved_lamps.py", *told])
    assert moved_lamps.main() == 0
    room = json.loads((tmp_path / "moved_lamps.json").read_text())["rooms"]["tiny"]
    assert room["lamps"] == ["lamp", "ceiling-light-1", "ceiling-light-2"]
    known, guided = room["rows"]
    assert (known["name"], known["seeds"]) == (KNOWN, [])
    assert (guided["name"], guided["seeds"]) == ("guided", [0, 1])
    assert np.shape(guided["whole"]["left"]) == (2, 2)
    assert 0.1 < known["whole"]["r2"] < 1
    assert guided["whole"]["r2"] == pytest.approx(np.mean(guided["whole"]["r2_of_seeds"]), abs=1e-4)
    assert f"| guided | {guided['whole']['r2']:.3f} (" in (tmp_path / "moved_lamps.md").read_text()


def test_a_room_that_has_not_run_is_refused(tmp_path: Path) -> None:
    (tmp_path / "bare").mkdir()
    with pytest.raises(IncompleteError):
        trained_runs(tmp_path / "bare")


# ------------------------------------------------------------------------------------------------------------- lamps


def test_an_object_that_takes_a_light_along_is_a_lamp_unless_it_is_off() -> None:
    spec = load_spec("room")

    def named(spec: SceneSpec) -> list[str]:
        return [group.name for group, shines in zip(spec.groups, lamps(spec), strict=True) if shines]

    assert named(spec) == ["lamp", "ceiling-light-1", "ceiling-light-2"]
    assert named(spec.model_copy(update={"emitters": Emitters(all=0)})) == ["ceiling-light-1", "ceiling-light-2"]


def test_a_pixel_stays_where_depth_normal_and_albedo_do() -> None:
    rng = np.random.default_rng(0)
    depth, (albedo, normal) = 1 + rng.random((8, 8), np.float32), rng.random((2, 8, 8, 3), np.float32)
    first, second = (ViewBuffers(depth.copy(), albedo.copy(), normal.copy()) for _ in range(2))
    second.depth[0] += 0.1
    second.albedo[1, :, 2] += 0.1
    second.normal[2, :, 0] += 0.1
    same = stays(first, second)
    assert not same[:3].any()
    assert same[3:].all()
