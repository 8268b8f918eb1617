"""A farm looked at again and again, what is said of it, and a farm that announces itself."""

import io
import json
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import queue_samples
import redis
import store_samples as samples
from click.testing import CliRunner
from rich.console import Console

from photonfarm.cli.main import umbrella
from photonfarm.cli.show_farm import describe_farm, draw_farm, list_lines
from photonfarm.core.errors import QueueError
from photonfarm.farm import running_farm
from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.farm.running_farm import announce
from photonfarm.farm.training import RunFolder
from photonfarm.farm.watch import STEADY_S, FarmWatch, read_queue
from photonfarm.plan.request import Request
from photonfarm.plan.top_up import TopUp
from photonfarm.queue.failures import keep_failure, repeating_command
from photonfarm.queue.job import job_name
from photonfarm.queue.reconciliation import reconcile
from photonfarm.queue.workers import Activity, WorkerReport
from photonfarm.store import SceneStore, Store


@pytest.fixture
def scene(store: Store) -> SceneStore:
    return store.scene(store.plan(samples.small_spec(), Request(modifications=8), shard_rows=2).scene_id)


@pytest.fixture(autouse=True)
def own_folder_of_farms(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(running_farm, "_folder", lambda: tmp_path / "farms")


def status(*options: str) -> Any:
    return CliRunner().invoke(umbrella, ["status", *options])


# ---------------------------------------------------------------------------------------------------------- progress


def test_progress_pace_and_time_left_are_of_what_workers_have_in_hand_too(
    scene: SceneStore, store: Store, common_redis: EmbeddedRedis, connection: redis.Redis
) -> None:
    now = [0.0]
    watch = FarmWatch(store, common_redis.url, clock=lambda: now[0])
    (before,) = watch.look().scenes
    assert (before.samples, before.status.jobs_committed, before.rate, before.left_s) == ((0, 8), 0, None, None)
    samples.commit(scene, 0, samples.outputs(scene, 0))
    doing = Activity("renders samples", 1, 2, job_name(scene.scene_id, 1))
    stranger = Activity("renders samples", 5, 9, f"{'ab' * 16}-1")
    for worker, does in (("ada", doing), ("eve", stranger)):
        queue_samples.told(connection, worker, WorkerReport(host="elsewhere", process=1, doing=does))
    now[0] = STEADY_S * 2
    farm = watch.look()
    (found,) = farm.scenes
    assert (found.samples, found.in_hand, found.status.jobs_committed, found.missing) == ((2, 8), 1, 1, 6)
    assert found.rate == pytest.approx(3 / (2 * STEADY_S))
    assert found.left_s == pytest.approx(5 / found.rate)
    assert found.status.core_s == watch.costs(scene.scene_id)[0] == samples.FIGURES.core_s
    assert describe_farm(farm) == (
        "small: samples 2/8 (+1 in hand), 9.0 samples/min, 33 s left"
        "  (ada renders samples 1/2; eve renders samples 5/9)"
    )
    for each in scene.missing_jobs()[:-1]:
        samples.commit(scene, each, samples.outputs(scene, each))
    reported = replace(doing, done=9, total=9)
    queue_samples.told(connection, "ada", WorkerReport(host="elsewhere", process=1, doing=reported))
    assert watch.look().scenes[0].in_hand == 2, "no more than are missing, as a report may be seconds old"


def test_further_passes_are_told_apart_from_samples_and_a_repair_takes_back_what_was_seen(
    store: Store, tmp_path: Path
) -> None:
    spec = samples.small_spec()
    scene = store.scene(store.plan(spec, Request(modifications=3, passes=2), shard_rows=4).scene_id)
    store.plan(samples.small_spec(points=17), Request(modifications=1))
    watch = FarmWatch(store, f"unix://{tmp_path}/none", scene_id=scene.scene_id)
    scene.plan(TopUp.of("+24", ["views=first:2"]))  # three passes of 8 samples per pixel each
    for job in (0, 2):
        samples.commit(scene, job, samples.outputs(scene, job))
    farm = watch.look()
    (found,) = farm.scenes
    assert (found.samples, found.passes) == ((4, 6), (4, 6))
    assert describe_farm(farm).startswith("small: samples 4/6, passes 4/6")
    next((scene.folder / "committed").iterdir()).unlink()
    (found,) = watch.look().scenes
    assert (found.status.jobs_committed, found.status.core_s) == (1, samples.FIGURES.core_s)


def test_a_marker_that_could_not_be_read_is_tried_again_at_the_next_look(
    scene: SceneStore, store: Store, tmp_path: Path
) -> None:
    watch = FarmWatch(store, f"unix://{tmp_path}/none")
    for job in (0, 1):
        samples.commit(scene, job, samples.outputs(scene, job))
    file = scene.folder / "committed/000000000000.json"
    whole = file.read_bytes()
    file.write_bytes(b"{")
    (found,) = watch.look().scenes
    assert (found.status.markers_unreadable, found.status.core_s) == (1, samples.FIGURES.core_s)
    file.write_bytes(whole)
    (found,) = watch.look().scenes
    assert (found.faults, found.status.core_s) == ([], 2 * samples.FIGURES.core_s)


def test_a_scene_without_readable_plans_is_told_by_its_name(scene: SceneStore, store: Store, tmp_path: Path) -> None:
    (scene.folder / "plans/000000/zarr.json").write_text("{")
    (found,) = FarmWatch(Store(store.root), f"unix://{tmp_path}/none").look().scenes
    assert (found.status.name, bool(found.status.error)) == ("small", True)


def test_a_damaged_scene_is_told_and_the_others_are_watched(scene: SceneStore, store: Store, tmp_path: Path) -> None:
    other = store.scene(store.plan(samples.small_spec(points=17), Request(modifications=1)).scene_id)
    (other.folder / "spec.json").write_text("{")
    farm = FarmWatch(Store(store.root), f"unix://{tmp_path}/none").look()
    found = {each.status.scene_id: each for each in farm.scenes}
    assert found[scene.scene_id].samples == (0, 8)
    terminal = Console(file=io.StringIO(), width=400)
    terminal.print(draw_farm(farm, store.root))
    said = f"{other.scene_id}: cannot be read: {found[other.scene_id].status.error}"
    assert said in terminal.file.getvalue()  # type: ignore[attr-defined]


def test_status_watch_ends_with_exit_code_0_on_ctrl_c(
    scene: SceneStore, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(_: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(time, "sleep", interrupt)
    done = status("--watch", "--store", str(store.root), "--redis", "unix:///none")
    assert done.exit_code == 0
    assert "0/8" in done.stdout


# ----------------------------------------------------------------------------------------------- what waits for what


def test_reasons_and_failures_are_told_in_words_and_equal_ones_once(
    scene: SceneStore, store: Store, common_redis: EmbeddedRedis, connection: redis.Redis
) -> None:
    said = status("--store", str(store.root), "--redis", common_redis.url).stdout
    assert "8 samples without a worker" in said
    reconcile(store, connection)
    name = queue_samples.failed(connection, "ValueError: 7 is odd")
    keep_failure(store, name, "ValueError: 7 is odd", worker="ada")
    left = {scene.scene_id: "room.xml is missing"}
    idle = WorkerReport(host="elsewhere", process=1, paused="the disk is full", left=left)
    for worker in ("ada", "bob"):
        queue_samples.told(connection, worker, idle)
    farm = FarmWatch(store, common_redis.url).look()
    assert [(wait.kind, wait.count, wait.sentence) for wait in farm.waits] == [
        ("scene_left", 1, "small: left by 2 of 2 workers: room.xml is missing"),
        ("worker_paused", 2, "2 workers take no jobs: the disk is full"),
        (
            "job_failed",
            1,
            "1 job failed, 1 of them set aside until `photonfarm submit --retry`: ValueError: … is odd",
        ),
    ]
    assert farm.queue.kept == [], "a failure that Redis knows is not told twice"
    assert f"      to repeat one: {repeating_command(store.root, name)}" in list_lines(farm, store.root)


def test_failures_outlive_redis_until_their_job_is_committed(scene: SceneStore, store: Store, tmp_path: Path) -> None:
    name = job_name(scene.scene_id, 1)
    keep_failure(store, name, "ValueError: 7", worker="ada")
    found = read_queue(store, f"unix://{tmp_path}/none")
    assert found.status is None
    assert [list(cause.jobs) for cause in found.kept] == [[name]]
    samples.commit(scene, 1, samples.outputs(scene, 1))
    assert read_queue(store, f"unix://{tmp_path}/none").kept == []


def test_a_redis_that_fails_on_the_way_ends_no_watch(
    scene: SceneStore, store: Store, common_redis: EmbeddedRedis, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> None:
        raise redis.TimeoutError("Timeout reading from socket")

    monkeypatch.setattr("photonfarm.queue.workers.check_served", fail)
    farm = FarmWatch(store, common_redis.url).look()
    assert "Timeout reading from socket" in farm.describe_queue()
    assert farm.scenes[0].samples == (0, 8)


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
    queue_samples.told(connection, "ada", WorkerReport(host="elsewhere", process=1))
    with announce(store, redis_url=common_redis.url, run=tmp_path / "run", web="http://localhost:1/"):
        found = json.loads(status("--json").stdout)
        assert found["queue"]["workers"] == 1
        assert found["up"]["web"] == "http://localhost:1/"
        assert [each["run"] for each in found["trainings"]] == ["run"]
        assert json.loads(status("--json", "--redis", "unix:///none").stdout)["queue"] is None
    assert running_farm.running_farm(store) is None


def test_without_a_redis_who_named_none_hears_whether_workers_are_at_work(
    scene: SceneStore, store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise QueueError("no Redis here")

    monkeypatch.delenv("PHOTONFARM_REDIS_URL", raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("photonfarm.queue.connection.connect", refuse)
    done = status()
    assert done.exit_code == 0
    assert "no Redis" not in done.output
    assert "`photonfarm up` goes on with the missing 8 samples" in done.output
    now = [0.0]
    watch = FarmWatch(store, f"unix://{tmp_path}/none", named_redis=False, clock=lambda: now[0])
    watch.look()
    samples.commit(scene, 0, samples.outputs(scene, 0))
    now[0] = 2 * STEADY_S
    assert "workers without Redis are at work" in watch.look().describe_queue()
    samples.commit_all(scene)
    assert "queue: none is needed" in status().stdout


def test_a_farm_that_died_or_that_others_announce_is_not_believed(store: Store, tmp_path: Path) -> None:
    with announce(store, redis_url="unix:///r", run=None, web=None):
        (file,) = (tmp_path / "farms").iterdir()
        text = file.read_text()
        assert running_farm.running_farm(store) is not None
        for said in (text.replace(f'"process": {os.getpid()}', '"process": 4194399'), "[]"):
            file.write_text(said)
            assert running_farm.running_farm(store) is None
        file.write_text(text)
        file.parent.chmod(0o777)
        assert running_farm.running_farm(store) is None


# --------------------------------------------------------------------------------------------------------- a training


def validation(step: int, error: float) -> str:
    record = {"kind": "validation", "step": step, "error": error, "standard_error": 0.1, "held_out": 3}
    return json.dumps(record) + "\n"


def test_a_runs_log_is_followed_and_read_anew_where_a_trainer_has_replaced_it(tmp_path: Path) -> None:
    run, log = RunFolder(tmp_path), tmp_path / "metrics.jsonl"
    assert run.look().step == 0
    (tmp_path / "settings.json").write_text('{"max_steps": 40}')
    log.write_text(validation(10, 0.5) + validation(20, 0.4)[:-9])
    found = run.look()
    assert (found.step, found.steps, found.figures) == (10, 40, ", held-out error 0.50000 ± 0.10000 on 3 views")
    log.write_text(validation(10, 0.5) + validation(20, 0.4))
    assert run.look().step == 20
    (tmp_path / "other").write_text(json.dumps({"kind": "end", "step": 97, "reason": "steps"}) + "\n")
    (tmp_path / "other").replace(log)
    assert run.look().line == f"training {tmp_path.name}: step 97 (40 wanted), ended (steps)"
    assert len(run.records) == 1


def test_a_trainers_own_word_is_believed_while_it_is_fresh(tmp_path: Path) -> None:
    said = {"step": 7, "steps": 40, "phase": "waits for samples", "left_s": 120.0, "at_s": time.time()}
    (tmp_path / "progress.json").write_text(json.dumps(said))
    found = RunFolder(tmp_path).look()
    assert found.line == f"training {tmp_path.name}: step 7/40, waits for samples, 2 min left"
    (tmp_path / "progress.json").write_text(json.dumps(said | {"at_s": time.time() - 3600}))
    assert RunFolder(tmp_path).look().phase is None


@pytest.mark.parametrize("content", ["[]", "nonsense\n", '{"kind": 3}\n', ""])
def test_a_damaged_log_gives_no_progress_and_no_error(tmp_path: Path, content: str) -> None:
    for name in ("metrics.jsonl", "progress.json", "settings.json"):
        (tmp_path / name).write_text(content)
    assert RunFolder(tmp_path).look().step == 0
