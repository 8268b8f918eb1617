"""A trainer leaves its scene to whoever takes its lease, waits for what was set aside, and trains as if nothing was."""

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from click.testing import CliRunner

from photonfarm.cli.main import umbrella
from photonfarm.core.errors import IncompleteError, StoreError
from photonfarm.core.processes import stop_on_signals
from photonfarm.plan.request import Request
from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.model.lease import hold_lease
from photonfarm.store.model.withdrawal import forget
from photonfarm.trainer.runs import checkpoint
from photonfarm.trainer.runs.devices import join_ranks
from photonfarm.trainer.runs.run_folder import CHECKPOINT
from photonfarm.trainer.runs.settings import TrainSettings
from photonfarm.trainer.training import other_ranks
from photonfarm.trainer.training.loop import Hooks, train
from photonfarm.trainer.training.other_ranks import assist

pytestmark = pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")

FORK = multiprocessing.get_context("fork")


@pytest.fixture
def committed(scene: SceneStore, commit, monkeypatch: pytest.MonkeyPatch) -> SceneStore:
    """Eight jobs of two samples, all there; and trainers that look for a lease at every step."""
    monkeypatch.setattr(other_ranks, "LOOK_S", 0.01)
    scene.plan(Request(modifications=4, views_per_modification=4), shard_rows=2)
    for job in range(scene.jobs()):
        commit(scene, job)
    return scene


@pytest.fixture
def settings(tiny) -> TrainSettings:
    return tiny(max_steps=24, hold_out=0.3, validate_every=8, checkpoint_every=1)


class Trainer:
    """A training in a process of its own, or in two that share each batch, slow enough for others to come by."""

    def __init__(self, scene: SceneStore, settings: TrainSettings, run: Path, *, size: int = 1) -> None:
        self._scene, self._settings, self._run, self._said = scene, settings, run, run.with_suffix(".said")
        self.processes = [FORK.Process(target=self._train, args=(rank, size)) for rank in range(size)]
        for process in self.processes:
            process.start()

    def _train(self, rank: int, size: int) -> None:
        torch.set_num_threads(1)
        told = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": size, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": 29641}
        os.environ.update({name: str(value) for name, value in told.items()})
        source = SceneReader(self._scene.storage.root, self._scene.scene_id)
        with join_ranks("cpu", self._settings.batch) as group, stop_on_signals() as stop:
            hooks = Hooks(stop=stop, on_wait=self._note, on_draws=lambda *_: time.sleep(0.05), ranks=group)
            if group.rank:
                assist(lambda *_: source, self._settings, self._run, group)
            else:
                with group.lead():
                    train(source, self._settings, self._run, hooks)

    def _note(self, sentence: str) -> None:
        with self._said.open("a") as file:
            file.write(f"{sentence}\n")

    def said(self, what: str) -> bool:
        return self._said.exists() and what in self._said.read_text()

    @property
    def step(self) -> int:
        """The step of the checkpoint; 0 without one."""
        with contextlib.suppress(StoreError):
            return int(checkpoint.load(self._run / CHECKPOINT)["step"])
        return 0

    def codes(self) -> list[int | None]:
        for process in self.processes:
            process.join(120)
        return [process.exitcode for process in self.processes]


def until(is_so: Callable[[], Any]) -> None:
    deadline = time.monotonic() + 60
    while not is_so():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def weights(run: Path) -> torch.Tensor:
    return torch.cat([w.flatten() for w in checkpoint.load(run / CHECKPOINT)["network"].values()])


def repair(scene: SceneStore, job: int) -> str:
    """Damage a job, and have it repaired by the verb."""
    path = next((scene.folder / "plans/000000/radiance").glob(f"c.{job}.*"))
    path.write_bytes(path.read_bytes()[:-1])
    ended = CliRunner().invoke(umbrella, ["store", "check", "--repair", "--store", str(scene.storage.root)])
    assert ended.exit_code == IncompleteError.exit_code, ended.output
    assert scene.missing_jobs() == [job]
    return ended.stderr


def test_training_waits_for_a_repair_and_for_what_it_set_aside_and_ends_in_the_same_weights(
    committed: SceneStore, commit, settings: TrainSettings, run: Path, tmp_path: Path
) -> None:
    train(SceneReader(committed.storage.root, committed.scene_id), settings, tmp_path / "undisturbed")
    trainer = Trainer(committed, settings, run)
    until(lambda: trainer.step > 1)
    assert f"waits for trainer of run {run}" in repair(committed, 0)
    assert trainer.said("store check --repair")
    until(lambda: trainer.said("training waits: 4 samples set aside, for workers to render again"))
    stands = trainer.step
    time.sleep(0.5)
    assert trainer.step == stands < settings.max_steps
    commit(committed, 0)
    assert trainer.codes() == [0]
    assert trainer.step == settings.max_steps
    assert torch.equal(weights(run), weights(tmp_path / "undisturbed"))


def test_a_run_that_is_stopped_while_it_waits_goes_on_to_the_same_weights(
    committed: SceneStore, commit, settings: TrainSettings, run: Path, tmp_path: Path
) -> None:
    train(SceneReader(committed.storage.root, committed.scene_id), settings, tmp_path / "undisturbed")
    trainer = Trainer(committed, settings, run)
    until(lambda: trainer.step > 1)
    with hold_lease(committed.storage, committed.scene_id, "store join", lambda _: None):
        until(lambda: trainer.said("store join"))
        os.kill(trainer.processes[0].pid, signal.SIGTERM)
        assert trainer.codes() == [0]
    repair(committed, 0)
    again = Trainer(committed, settings, run)
    until(lambda: again.said("4 samples set aside"))
    os.kill(again.processes[0].pid, signal.SIGTERM)
    assert again.codes() == [0]
    commit(committed, 0)
    assert Trainer(committed, settings, run).codes() == [0]
    assert torch.equal(weights(run), weights(tmp_path / "undisturbed"))


def test_two_processes_have_both_ended_their_reading_when_the_lease_begins(
    committed: SceneStore, settings: TrainSettings, run: Path, tmp_path: Path
) -> None:
    assert Trainer(committed, settings, tmp_path / "undisturbed", size=2).codes() == [0, 0]
    trainer = Trainer(committed, settings, run, size=2)
    until(lambda: trainer.step > 1)
    with hold_lease(committed.storage, committed.scene_id, "store join", lambda _: None):
        stands = trainer.step
        (moved := committed.folder.with_name("elsewhere")).mkdir()
        committed.folder.rename(moved / "scene")  # whoever reads now fails
        time.sleep(0.5)
        assert trainer.step == stands
        (moved / "scene").rename(committed.folder)
    assert trainer.codes() == [0, 0]
    assert torch.equal(weights(run), weights(tmp_path / "undisturbed"))


def test_a_scene_that_was_forgotten_ends_training(committed: SceneStore, settings: TrainSettings, run: Path) -> None:
    ended: list[BaseException] = []

    def training() -> None:
        try:
            source = SceneReader(committed.storage.root, committed.scene_id)
            train(source, settings, run, Hooks(on_draws=lambda *_: time.sleep(0.05)))
        except IncompleteError as error:
            ended.append(error)

    thread = threading.Thread(target=training)
    thread.start()
    until(lambda: (run / CHECKPOINT).exists())
    forget(Store(committed.storage.root), committed.scene_id)
    thread.join(60)
    assert "was forgotten" in str(ended[0])
