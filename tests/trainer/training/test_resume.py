"""Training runs that go on to the same weights to the bit, most of them ended by SIGKILL in processes of their own."""

import json
import multiprocessing
import os
import random
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from held_out_errors import held_out_errors
from safetensors import safe_open

from photonfarm.core.errors import SpecError
from photonfarm.plan.request import Request
from photonfarm.store import SceneReader, Store
from photonfarm.trainer.data.batch_stream import RoundSampler
from photonfarm.trainer.runs import checkpoint, run_folder
from photonfarm.trainer.runs.run_folder import CHECKPOINT, GOOD, INITIAL, METRICS
from photonfarm.trainer.runs.settings import NetworkSettings
from photonfarm.trainer.training.good_state import NEXT
from photonfarm.trainer.training.loop import Hooks, train

pytestmark = pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")


def ended_by(train_in_child: Callable[[], Any]) -> int:
    """How a process of its own ends that trains: 0, or minus the signal that ended it."""
    child = multiprocessing.get_context("fork").Process(target=train_in_child)
    child.start()
    child.join(120)
    assert child.exitcode is not None
    return child.exitcode


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def die_after(draws: int) -> Callable[[int, int], None]:
    def count(drawn: int, _samples: int) -> None:
        if drawn == draws:
            die()

    return count


def content(file: Path) -> dict[str, torch.Tensor]:
    """Every tensor of a checkpoint: weights, the optimiser's memory, what was drawn, and when it had arrived."""
    with safe_open(file, framework="pt") as tensors:
        return {name: tensors.get_tensor(name) for name in tensors.keys()}  # noqa: SIM118 - no mapping


def assert_same(one: Path, other: Path) -> None:
    for file in (CHECKPOINT, GOOD):
        a, b = content(one / file), content(other / file)
        assert a.keys() == b.keys()
        others = [name for name in a if name != "following.growth"]  # the same by each draw, perhaps in fewer looks
        assert [name for name in others if not torch.equal(a[name], b[name])] == []
    states = [checkpoint.load(run / CHECKPOINT) for run in (one, other)]
    for name in ("joined", "shuffles"):
        assert states[0]["following"]["sampler"][name] == states[1]["following"]["sampler"][name]
    assert states[0]["following"]["asked"] == states[1]["following"]["asked"]
    assert states[0]["store"] == states[1]["store"]
    tensors = ("best", "least")
    recovered = [{key: value for key, value in state["recovery"].items() if key not in tensors} for state in states]
    assert recovered[0] == recovered[1]


@pytest.mark.parametrize(
    "recipe",
    [
        {"optimiser": "adam"},
        pytest.param({"optimiser": "rmsprop"}, marks=pytest.mark.slow),
        {"schedule": "cosine", "average": 0.99, "learning_rate": 0.3, "layer_rates": "scaled"},
    ],
    ids=["adam", "rmsprop", "averaged, recovering"],
)
def test_a_run_killed_at_any_steps_ends_in_the_same_weights_to_the_bit(
    make_source, tiny, run, tmp_path, recipe: dict[str, Any]
) -> None:
    """One run has so high a rate that it goes back to good weights again and again."""
    settings, killed = tiny(max_steps=24, **recipe), tmp_path / "killed"
    train(make_source(24), settings, run)
    for step in sorted(random.Random(7).sample(range(1, 24), 4)):
        how = {"on_draws": die_after(3 * step)}
        assert ended_by(lambda how=how: train(make_source(24), settings, killed, Hooks(**how))) == -signal.SIGKILL
    train(make_source(24), settings, killed)
    assert_same(run, killed)
    logs = [[(r["kind"], r["step"]) for r in run_folder.read_log(folder / METRICS)] for folder in (run, killed)]
    assert logs[0] == logs[1]
    assert ("recovered" in [kind for kind, _ in logs[0]]) == ("learning_rate" in recipe)
    assert not (killed / NEXT).exists()


@pytest.mark.slow
def test_a_run_killed_on_either_side_of_a_return_to_a_snapshot_does_too(make_source, tiny, run, tmp_path) -> None:
    """The snapshot is older than most checkpoints, which hold it then; the rate rises until the run diverges."""
    rising = {"learning_rate": 0.04, "seed": 1, "schedule": "cosine", "warm_up": 0.99}
    settings, killed = tiny(max_steps=130, validate_every=1000, checkpoint_every=15, **rising), tmp_path / "killed"
    train(make_source(48), settings, run)
    logs = [run_folder.read_log(run / METRICS)]
    back = [(record["step"], record["back_to"]) for record in logs[0] if record["kind"] == "recovered"]
    assert any(step - to > 15 and to > 0 for step, to in back)
    for step in sorted({17, *(step + by for step, _ in back for by in (-2, 2))}):
        how = {"on_draws": die_after(3 * step)}
        assert ended_by(lambda how=how: train(make_source(48), settings, killed, Hooks(**how))) == -signal.SIGKILL
    train(make_source(48), settings, killed)
    assert_same(run, killed)
    logs.append(run_folder.read_log(killed / METRICS))
    told = [[(r["kind"], r["step"], r.get("back_to"), r.get("losses")) for r in log] for log in logs]
    assert told[0] == told[1]


@pytest.mark.parametrize(
    ("call", "last", "step"),
    [
        # an fsync of the file and one of the folder each: the good state of step 0 is written…
        pytest.param("fsync", 3, None, marks=pytest.mark.slow),
        pytest.param("fsync", 5, None, marks=pytest.mark.slow),  # …and the checkpoint of step 4
        pytest.param("fsync", 7, 4, marks=pytest.mark.slow),  # the good state of step 5…
        ("fsync", 9, 4),  # …and the checkpoint of step 8
        pytest.param("replace", 5, 4, marks=pytest.mark.slow),  # the good state is there, the checkpoint is not
        ("replace", 6, 8),  # both are, and the good state does not yet replace the one before
        pytest.param("replace", 7, 8, marks=pytest.mark.slow),
    ],
)
def test_a_run_killed_while_it_writes_a_checkpoint_does_too(
    make_source, tiny, run, tmp_path, call: str, last: int, step: int | None
) -> None:
    """The old checkpoint is there before the rename, the new one after it, and never half of one."""
    train(make_source(24), tiny(), run)
    killed = tmp_path / "killed"

    def train_and_die() -> None:
        calls = {"fsync": (os, os.fsync), "replace": (Path, Path.replace)}
        owner, plain = calls[call]
        done: list[Any] = []

        def counted(*arguments: Any) -> Any:
            done.append(plain(*arguments))
            if len(done) == last:
                die()
            return done[-1]

        setattr(owner, call, counted)
        train(make_source(24), tiny(), killed)

    assert ended_by(train_and_die) == -signal.SIGKILL
    assert (checkpoint.load(killed / CHECKPOINT)["step"] if (killed / CHECKPOINT).exists() else None) == step
    if step is not None:
        stop = threading.Event()
        stop.set()
        assert train(make_source(24), tiny(), killed, Hooks(stop=stop)).step == step
        good = checkpoint.load(killed / CHECKPOINT)["recovery"]["good"]
        assert checkpoint.load(killed / GOOD)["step"] == good == (0 if step == 4 else 5)
    train(make_source(24), tiny(), killed)
    assert_same(run, killed)


def test_a_run_on_a_store_that_begins_empty_and_grows_trains_on_all_of_it_however_often_it_was_killed(
    tmp_path, tiny, commit, analytic
) -> None:
    """Neither store nor scene is there when training begins; it is killed three times while jobs are committed."""
    root, killed, scene_id = tmp_path / "store", tmp_path / "killed", analytic.spec.scene_id
    how = {"max_steps": 40, "replay_ratio": 2.0, "replay_buffer": 0, "poll_seconds": 0.02, "checkpoint_every": 3}
    arrived = multiprocessing.Value("i", 0)  # samples that the run has trained with

    def grow() -> None:
        time.sleep(0.3)
        scene = Store(root, create=True).add(analytic.spec)
        scene.write_base(*analytic.base)
        for seed in range(2):
            scene.plan(Request(modifications=20, seed=seed), shard_rows=4)
        for job in range(scene.jobs()):
            commit(scene, job)
            end = time.monotonic() + 1.0  # for no run may be alive
            while arrived.value < 4 * (job + 1) and time.monotonic() < end:
                time.sleep(0.01)

    def die_later(draws: int) -> Callable[[int, int], None]:
        die_then = die_after(draws)

        def count(drawn: int, samples: int) -> None:
            arrived.value = samples
            die_then(drawn, samples)

        return count

    growing = threading.Thread(target=grow)
    growing.start()
    for step in sorted(random.Random(3).sample(range(5, 30), 3)):
        last = {"on_draws": die_later(3 * step)}
        source = SceneReader(root, scene_id)
        assert ended_by(lambda s=source, k=last: train(s, tiny(**how), killed, Hooks(**k))) == -signal.SIGKILL
    growing.join()
    train(SceneReader(root, scene_id), tiny(**how), killed)

    first = run_folder.read_log(killed / METRICS)[0]
    state = checkpoint.load(killed / CHECKPOINT)
    assert first["samples"] < 40 == state["store"]["samples"]
    assert len(state["store"]["plans"]) == 2
    assert state["step"] == 40
    assert len(state["following"]["growth"]) > 3
    assert len(set(state["following"]["arrived"].tolist())) == 40


def test_a_checkpoint_is_safetensors_with_what_it_has_seen_beside(scene, commit, tiny, run) -> None:
    scene.plan(Request(modifications=10, seed=5), shard_rows=8)
    commit(scene, 0)
    train(SceneReader(scene.storage.root, scene.scene_id), tiny(max_seconds=3.0, hold_out=0.3, max_steps=3), run)
    with safe_open(run / CHECKPOINT, framework="np") as file:
        told = json.loads(file.metadata()["photonfarm"])
        weights = [name for name in file.keys() if name.startswith("network.")]  # noqa: SIM118 - no mapping
        assert file.get_tensor(weights[0]).dtype == "float32"
    (plan,) = told["store"]["plans"]
    assert told["store"]["scene_id"] == scene.scene_id
    assert (told["store"]["samples"], plan["samples"], plan["request"]["seed"]) == (8, 10, 5)
    assert told["settings"]["hold_out"] == 0.3
    assert told["versions"]["torch"] == torch.__version__
    with safe_open(run / INITIAL, framework="np") as file:
        assert set(weights) == set(file.keys())


def test_a_checkpoint_of_a_million_samples_is_small_and_saved_at_once(tmp_path) -> None:
    """Three numbers for each sample, 8 bytes each; as JSON they would be 27 MB, and half a minute's work."""
    sampler = RoundSampler(0, 2)
    sampler.add(range(1_000_000))
    sampler.draw(4)
    began = time.process_time()
    checkpoint.save(tmp_path / CHECKPOINT, {"sampler": sampler.state()})
    restored = RoundSampler(0, 2)
    restored.restore(checkpoint.load(tmp_path / CHECKPOINT)["sampler"])
    assert time.process_time() - began < 5
    assert (tmp_path / CHECKPOINT).stat().st_size < 3 * 8 * 1_000_000 + 1000
    assert restored.draw(4) == sampler.draw(4)


def test_a_run_is_not_continued_on_a_store_of_other_plans(scene, analytic, commit, tiny, run) -> None:
    scene.plan(Request(modifications=8), shard_rows=8)
    commit(scene, 0)
    source = SceneReader(scene.storage.root, scene.scene_id)
    train(source, tiny(max_steps=2, hold_out=0.3), run)
    other = Store(scene.storage.root.parent / "other", create=True).add(scene.spec)
    other.write_base(*analytic.base)
    other.plan(Request(modifications=8, seed=1), shard_rows=8)
    commit(other, 0)
    with pytest.raises(SpecError):
        train(SceneReader(other.storage.root, scene.scene_id), tiny(max_steps=4, hold_out=0.3), run)
    other_seed = SceneReader(scene.storage.root, scene.scene_id)
    scene.plan(Request(modifications=8, seed=1), shard_rows=8)
    commit(scene, 1)
    assert train(other_seed, tiny(max_steps=4, hold_out=0.3), run).step == 4


@pytest.mark.parametrize(
    "architecture",
    [
        "light_transport_photons",
        "guided_transport_photons",
        "denoise_4",
    ],
)
def test_a_run_of_any_architecture_goes_on_to_the_same_weights_to_the_bit(
    make_source, tiny, tmp_path: Path, architecture: str
) -> None:
    def weights(name: str, *stops: int) -> dict[str, Any]:
        for stop in stops:
            settings = tiny(network=NetworkSettings(width=4, architecture=architecture), max_steps=stop)
            train(make_source(24, photons=16), settings, tmp_path / name)
        return checkpoint.load(tmp_path / name / CHECKPOINT)["network"]

    straight, resumed = weights("straight", 7), weights("resumed", 3, 7)
    assert all(torch.equal(straight[name], resumed[name]) for name in straight)
    assert np.isfinite(held_out_errors(lambda: make_source(24, photons=16), tmp_path / "straight").last)
