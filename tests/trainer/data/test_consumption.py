"""The trainer tells Redis how many samples it has used; whether there is one is none of its trouble."""

import threading
import time
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from photonfarm.core.errors import IncompleteError, SpecError, StoreError
from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.plan.request import Request
from photonfarm.queue.connection import connect
from photonfarm.queue.workers import read_consumed, serve
from photonfarm.store import Store
from photonfarm.trainer import service, train
from photonfarm.trainer.runs import devices
from photonfarm.trainer.runs.run_folder import CHECKPOINT
from photonfarm.trainer.runs.settings import TrainSettings, make_preset
from photonfarm.trainer.training import loop
from photonfarm.trainer.training.loop import Hooks

SCENE_ID = "0123456789abcdef" * 2


def made(folder: Path) -> Path:
    Store(folder / "store", create=True)
    return folder / "store"


def test_what_is_used_is_told_again_and_again_each_sample_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service, "REPORT_S", 0.01)
    with EmbeddedRedis(tmp_path / "redis") as server:
        connection = connect(server.url)

        def wait_for(samples: int) -> None:
            deadline = time.monotonic() + 60
            while read_consumed(connection, [SCENE_ID]) != {SCENE_ID: samples}:
                assert time.monotonic() < deadline
                time.sleep(0.01)

        connection.set(f"rq:photonfarm:consumed:{SCENE_ID}", 7)
        with service._report_use(server.url, made(tmp_path), SCENE_ID, print) as count:
            time.sleep(0.3)
            wait_for(7)  # of the session before: this one knows nothing yet
            count(40, 100)
            wait_for(40)
            connection.flushall()
            wait_for(40)
            count(400, 100)
            wait_for(100)


def test_every_step_is_counted_and_what_a_run_had_that_goes_on(
    make_source: Callable[..., Any], tiny: Callable[..., TrainSettings], run: Path
) -> None:
    counts: list[tuple[int, int]] = []
    settings = tiny(validate_every=100, checkpoint_every=3, max_steps=4)
    loop.train(make_source(20), settings, run, Hooks(on_draws=lambda *told: counts.append(told)))
    assert counts == [(0, 0), (3, 20), (6, 20), (9, 20), (12, 20)]
    counts.clear()
    loop.train(make_source(20), settings, run, Hooks(on_draws=lambda *told: counts.append(told)))
    assert counts == [(12, 20)]


def test_a_redis_that_serves_another_store_is_told_nothing_and_that_is_said_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    monkeypatch.setattr(service, "REPORT_S", 0.01)
    with EmbeddedRedis(tmp_path / "redis") as server:
        connection = connect(server.url)
        serve(connection, Store(tmp_path / "other", create=True))
        with service._report_use(server.url, made(tmp_path), SCENE_ID, said.append) as count:
            count(40, 100)
            time.sleep(0.3)
        assert read_consumed(connection, [SCENE_ID]) == {SCENE_ID: 0}
    (line,) = said
    assert "this Redis serves the store" in line


@pytest.mark.parametrize("url", [None, "redis://127.0.0.1:1/0", "nonsense"])
def test_without_a_redis_training_goes_on(url: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service, "REPORT_S", 0.01)
    with service._report_use(url, made(tmp_path), SCENE_ID, print) as count:
        count(1, 1)
        time.sleep(0.1)


def test_a_store_that_is_not_there_yet_is_waited_for_also_with_a_spec(tmp_path: Path, run: Path) -> None:
    said: list[str] = []
    with EmbeddedRedis(tmp_path / "redis") as server:
        asked = ("cornell", tmp_path / "none", run, "small", {"max_seconds": 0.3}, server.url)
        with pytest.raises(IncompleteError, match="nothing was trained"):
            service.run(*asked, log=said.append, on_record=print)
    assert any("waiting for a store" in line for line in said)
    assert any("step 0" in line for line in said)
    assert not (tmp_path / "none").exists()


def test_training_in_one_call_is_told_of_and_alive_as_by_the_command_line(scene, commit, run: Path) -> None:
    store, said = Path(scene.storage.where), []
    settings = {"architecture": "cnn", "width": 4, "batch": 2, "hold_out": 0.4, "minimum_samples": 1, "max_steps": 3}
    with EmbeddedRedis(run.parent / "redis") as server:
        call = partial(train, store, scene.scene_id, run, redis_url=server.url, log=said.append, **settings)
        thread = threading.Thread(target=call, daemon=True)
        thread.start()
        deadline = time.monotonic() + 60
        while not (run / service.ALIVE_FILE).exists():
            assert time.monotonic() < deadline
            time.sleep(0.01)
        service.check(run)
        scene.plan(Request(modifications=12), shard_rows=6)
        for job in range(scene.jobs()):
            commit(scene, job)
        thread.join(60)
        assert read_consumed(connect(server.url), [scene.scene_id]) == {scene.scene_id: 6}
    assert said[-1] == "ended at step 3: steps"
    assert said[-2].startswith("step 3/3, ")
    assert not any("continues" in line for line in said)
    train(store, scene.scene_id, run, redis_url=server.url, log=said.append, **settings)
    assert not any("continues" in line for line in said), "it has ended"
    train(store, scene.scene_id, run, redis_url=server.url, log=said.append, **{**settings, "max_steps": 4})
    assert f"{run}: continues at step 3" in said
    assert (run / "tensorboard").is_dir() == (find_spec("tensorboard") is not None)
    with pytest.raises(IncompleteError):
        service.check(run)


def test_a_run_goes_on_as_it_was_begun_and_ends_where_it_ended(
    scene, commit, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wherever that is: as a run that began on a card and goes on here does."""
    settings = {"architecture": "cnn", "width": 4, "hold_out": 0.4, "minimum_samples": 1, "device": "cpu"}
    scene.plan(Request(modifications=12), shard_rows=6)
    for job in range(scene.jobs()):
        commit(scene, job)
    store, said = Path(scene.storage.where), []
    call = partial(train, store, scene.scene_id, run, log=said.append)
    monkeypatch.setattr(devices, "choose_preset", lambda _device: "card")
    begun = call(max_steps=2, **settings).settings
    monkeypatch.undo()
    left = {file: file.read_bytes() for file in run.iterdir() if file.is_file()}
    assert (
        call().settings
        == begun
        == make_preset(
            "card",
            network={"architecture": "cnn", "width": 4},
            hold_out=0.4,
            minimum_samples=1,
            device="cpu",
            max_steps=2,
        )
    )
    assert {file: file.read_bytes() for file in run.iterdir() if file.is_file()} == left
    assert any("has ended at step 2 (steps); with --steps N it goes on" in line for line in said)
    with pytest.raises(SpecError, match="batch = 8, and 2"):
        call(max_steps=3, preset="small", **settings)
    assert call(max_steps=3).settings == begun.model_copy(update={"max_steps": 3})
    (run / CHECKPOINT).unlink()  # as if it had been killed before its first one
    assert call().settings == begun.model_copy(update={"max_steps": 3})
    with pytest.raises(StoreError, match="on which run"):
        service.run(None, store.with_name("moved"), run, None, {}, log=print)
