"""A farm looked at again and again, and a farm that announces itself."""

import io
import json
import os
import re
import time
from pathlib import Path
from typing import Any

import pytest
import queue_samples
import redis
import store_samples as samples
from click.testing import CliRunner
from rich.console import Console

from photonfarm import queue
from photonfarm.cli.main import umbrella
from photonfarm.cli.show_watch import draw_farm, lines
from photonfarm.core.errors import QueueError
from photonfarm.farm import running_farm, status
from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.farm.running_farm import announce
from photonfarm.farm.status import RECENT_S, NoQueue, StoreQueue, queue_of, since_commit_s
from photonfarm.farm.training import RunFolder
from photonfarm.farm.watch import STEADY_S, FarmWatch
from photonfarm.plan.request import Request
from photonfarm.store import SceneStore, Store


@pytest.fixture
def scene(store: Store) -> SceneStore:
    return store.scene(store.plan(samples.small_spec(), Request(modifications=8), shard_rows=2).scene_id)


@pytest.fixture(autouse=True)
def own_folder_of_farms(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(running_farm, "_folder", lambda: tmp_path / "farms")


def validation(step: int, error: float) -> dict[str, Any]:
    return {"kind": "validation", "step": step, "error": error, "standard_error": 0.1, "held_out": 3}


# --------------------------------------------------------------------------------------------------------- the watch


def test_progress_pace_and_time_left_are_of_what_workers_have_in_hand_too(
    scene: SceneStore, store: Store, common_redis: EmbeddedRedis, connection: redis.Redis
) -> None:
    now = [0.0]
    watch = FarmWatch(store, common_redis.url, clock=lambda: now[0])
    (before,) = watch.look().scenes
    assert (before.samples, before.jobs, before.rate, before.left_s) == ((0, 8), (0, 4), None, None)
    samples.commit(scene, 0, samples.outputs(scene, 0))
    doing = queue.Activity("renders samples", 1, 2, queue.job_name(scene.scene_id, 1))
    stranger = queue.Activity("renders samples", 5, 9, f"{'ab' * 16}-1")
    for worker, does in (("ada", doing), ("eve", stranger)):
        queue_samples.told(connection, worker, queue.WorkerReport(host="elsewhere", process=1, doing=does))
    now[0] = STEADY_S * 2
    view = watch.look()
    (found,) = view.scenes
    assert (found.samples, found.in_hand, found.jobs) == ((2, 8), 1, (1, 4))
    assert found.rate == pytest.approx(3 / (2 * STEADY_S))
    assert found.left_s == pytest.approx(5 / found.rate)
    assert found.core_s == samples.FIGURES.core_s
    assert watch.costs(scene.scene_id)[0] == samples.FIGURES.core_s
    assert any("renders samples 1/2" in line for line in lines(view))


def test_a_repair_takes_back_what_was_seen(scene: SceneStore, store: Store, tmp_path: Path) -> None:
    watch = FarmWatch(store, f"unix://{tmp_path}/none")
    samples.commit_all(scene)
    assert watch.look().scenes[0].jobs == (4, 4)
    next((scene.folder / "committed").iterdir()).unlink()
    (found,) = watch.look().scenes
    assert (found.jobs, found.core_s) == ((3, 4), 3 * samples.FIGURES.core_s)


def test_a_damaged_scene_is_told_and_the_others_are_watched(scene: SceneStore, store: Store, tmp_path: Path) -> None:
    other = store.scene(store.plan(samples.small_spec(points=17), Request(modifications=1)).scene_id)
    (other.folder / "spec.json").write_text("{")
    view = FarmWatch(Store(store.root), f"unix://{tmp_path}/none").look()
    found = {each.scene_id: each for each in view.scenes}
    assert found[other.scene_id].error
    assert found[scene.scene_id].samples == (0, 8)
    terminal = Console(file=io.StringIO(), width=400)
    terminal.print(draw_farm(view))
    for shown in ("\n".join(lines(view)), terminal.file.getvalue()):
        assert f"scene {other.scene_id} cannot be read: {found[other.scene_id].error}" in shown


def test_status_watch_ends_with_exit_code_0_on_ctrl_c(
    scene: SceneStore, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(_: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(time, "sleep", interrupt)
    done = CliRunner().invoke(umbrella, ["status", "--watch", "--store", str(store.root), "--redis", "unix:///none"])
    assert done.exit_code == 0
    assert "0/8" in done.stdout


# ----------------------------------------------------------------------------------------------- what waits for what


def test_reasons_and_failures_are_told_in_words_and_equal_ones_once(
    scene: SceneStore, store: Store, common_redis: EmbeddedRedis, connection: redis.Redis
) -> None:
    queue.reconcile(store, connection)
    queue_samples.failed(connection, "ValueError: 7 is odd")
    left = {scene.scene_id: "room.xml is missing"}
    idle = queue.WorkerReport(host="elsewhere", process=1, paused="the disk is full", left=left)
    for worker in ("ada", "bob"):
        queue_samples.told(connection, worker, idle)
    found = list(status.waits(queue_of(store, common_redis.url), {scene.scene_id: "small"}, 8))
    assert [(wait.kind, wait.count) for wait in found] == [("scene_left", 1), ("worker_paused", 2), ("job_failed", 1)]
    assert [str(wait) for wait in found] == [
        "small: left by 2 of 2 workers: room.xml is missing",
        "2 workers take no jobs: the disk is full",
        "1 job failed, 1 of them set aside until `photonfarm submit --retry`: ValueError: … is odd",
    ]


def test_samples_that_no_worker_renders_wait_for_one(store: Store, connection: redis.Redis, common_redis: Any) -> None:
    assert len(list(status.waits(queue_of(store, common_redis.url), {}, 8))) == 1
    assert list(status.waits(queue_of(store, common_redis.url), {}, 0)) == []


def test_status_says_that_missing_samples_wait_for_a_worker(
    scene: SceneStore, store: Store, connection: redis.Redis, common_redis: EmbeddedRedis
) -> None:
    words = ["status", "--store", str(store.root), "--redis", common_redis.url]
    assert "8 samples wait for a worker" in CliRunner().invoke(umbrella, words).stdout
    samples.commit_all(scene)
    assert "wait for a worker" not in CliRunner().invoke(umbrella, words).stdout


def test_failures_outlive_redis_until_their_job_is_committed(scene: SceneStore, store: Store, tmp_path: Path) -> None:
    name = queue.job_name(scene.scene_id, 1)
    queue.keep_failure(store, name, "ValueError: 7", worker="ada")
    found = queue_of(store, f"unix://{tmp_path}/none")
    assert isinstance(found, NoQueue)
    assert [list(cause.jobs) for cause in found.kept] == [[name]]
    samples.commit(scene, 1, samples.outputs(scene, 1))
    assert queue_of(store, f"unix://{tmp_path}/none").kept == []


def test_a_failure_that_redis_knows_is_not_told_twice(
    scene: SceneStore, store: Store, common_redis: EmbeddedRedis, connection: redis.Redis
) -> None:
    queue.reconcile(store, connection)
    name = queue_samples.failed(connection, "ValueError: 7")
    queue.keep_failure(store, name, "ValueError: 7", worker="ada")
    found = queue_of(store, common_redis.url)
    assert isinstance(found, StoreQueue)
    assert (len(found.causes), found.kept) == (1, [])


def test_a_redis_that_fails_on_the_way_ends_no_watch(
    scene: SceneStore, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> None:
        raise redis.TimeoutError("Timeout reading from socket")

    monkeypatch.setattr("photonfarm.farm.status.queue_of", fail)
    view = FarmWatch(store, "unix:///none").look()
    assert isinstance(view.queue, NoQueue)
    assert view.scenes[0].samples == (0, 8)


# ---------------------------------------------------------------------------------------------------- without a Redis


def test_status_finds_the_redis_of_an_up_that_is_at_work_here(
    scene: SceneStore,
    store: Store,
    common_redis: EmbeddedRedis,
    connection: redis.Redis,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("PHOTONFARM_REDIS_URL", raising=False)
    monkeypatch.chdir(tmp_path)
    queue_samples.told(connection, "ada", queue.WorkerReport(host="elsewhere", process=1))
    with announce(store, redis_url=common_redis.url, run=tmp_path / "run", web="http://localhost:1/"):
        found = json.loads(CliRunner().invoke(umbrella, ["status", "--json"]).stdout)
        assert found["queue"]["workers"] == 1
        assert found["up"]["web"] == "http://localhost:1/"
        assert FarmWatch(store, "redis://localhost:1", named_redis=False).look().trainings[0].run == "run"
        named = json.loads(CliRunner().invoke(umbrella, ["status", "--json", "--redis", "unix:///none"]).stdout)
        assert named["queue"] is None
    assert running_farm.running_farm(store) is None


def test_status_without_a_redis_is_no_error_for_who_named_none(
    scene: SceneStore, store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PHOTONFARM_REDIS_URL", raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("photonfarm.queue.connect", _refuses)
    done = CliRunner().invoke(umbrella, ["status"])
    assert done.exit_code == 0
    assert "no Redis" not in done.output
    assert "`photonfarm up` goes on with the 8 samples" in done.output


def test_what_workers_without_redis_commit_shows_that_they_are_at_work(
    scene: SceneStore, store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PHOTONFARM_REDIS_URL", raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("photonfarm.queue.connect", _refuses)
    assert since_commit_s(store) is None
    now = [0.0]
    watch = FarmWatch(store, f"unix://{tmp_path}/none", named_redis=False, clock=lambda: now[0])
    assert "  no farm is at work here" in lines(watch.look())
    samples.commit(scene, 0, samples.outputs(scene, 0))
    now[0] = 2 * STEADY_S
    assert any("workers without Redis are at work" in line for line in lines(watch.look()))
    said = CliRunner().invoke(umbrella, ["status"]).stdout
    assert re.search(r"a job was committed \d s ago, so workers without Redis may be at work .*; 6 samples are", said)
    os.utime(scene.folder / "committed", (time.time() - 2 * RECENT_S,) * 2)
    assert since_commit_s(store) == pytest.approx(2 * RECENT_S, abs=60)
    assert "`photonfarm up` goes on with the 6 samples" in CliRunner().invoke(umbrella, ["status"]).stdout


def _refuses(*_: Any, **__: Any) -> None:
    raise QueueError("no Redis here")


def test_a_farm_that_died_or_that_others_announce_is_not_believed(store: Store, tmp_path: Path) -> None:
    with announce(store, redis_url="unix:///r", run=None, web=None):
        (file,) = (tmp_path / "farms").iterdir()
        text = file.read_text()
        assert running_farm.running_farm(store) is not None
        file.write_text(text.replace(f'"process": {os.getpid()}', '"process": 4194399'))
        assert running_farm.running_farm(store) is None
        file.write_text("[]")
        assert running_farm.running_farm(store) is None
        file.write_text(text)
        file.parent.chmod(0o777)
        assert running_farm.running_farm(store) is None


# --------------------------------------------------------------------------------------------------------- a training


def test_a_runs_log_is_followed_and_read_anew_where_a_trainer_has_replaced_it(tmp_path: Path) -> None:
    run, log = RunFolder(tmp_path), tmp_path / "metrics.jsonl"
    assert run.look().step == 0
    (tmp_path / "settings.json").write_text('{"max_steps": 40}')
    log.write_text(json.dumps(validation(10, 0.5)) + "\n" + json.dumps(validation(20, 0.4))[:-9])
    found = run.look()
    assert (found.step, found.steps, found.note) == (10, 40, ", held-out error 0.50000 ± 0.10000 on 3 samples")
    log.write_text(json.dumps(validation(10, 0.5)) + "\n" + json.dumps(validation(20, 0.4)) + "\n")
    assert run.look().step == 20
    other = tmp_path / "other"
    other.write_text(json.dumps(validation(5, 0.7)) + "\n")
    other.replace(log)
    assert (run.look().step, len(run.records)) == (5, 1)


def test_a_trainers_own_word_is_believed_while_it_is_fresh(tmp_path: Path) -> None:
    said = {"step": 7, "steps": 40, "phase": "waits for samples", "left_s": 120.0, "at_s": time.time()}
    (tmp_path / "progress.json").write_text(json.dumps(said))
    found = RunFolder(tmp_path).look()
    assert (found.step, found.phase, found.note) == (7, "waits for samples", ", waits for samples, 2 min left")
    (tmp_path / "progress.json").write_text(json.dumps(said | {"at_s": time.time() - 3600}))
    assert RunFolder(tmp_path).look().phase is None


@pytest.mark.parametrize("content", ["[]", "nonsense\n", '{"kind": 3}\n', ""])
def test_a_damaged_log_gives_no_progress_and_no_error(tmp_path: Path, content: str) -> None:
    for name in ("metrics.jsonl", "progress.json", "settings.json"):
        (tmp_path / name).write_text(content)
    assert RunFolder(tmp_path).look().step == 0
