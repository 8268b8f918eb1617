"""`work --ahead`: a scene that is ahead of its trainer is left for now, and holds up no other."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import pytest
import redis
from pydantic import ValidationError

from photonfarm.cli.farm_verbs import status
from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.plan.request import Request
from photonfarm.queue.connection import connect
from photonfarm.queue.rq_adapter import queue_status
from photonfarm.queue.workers import report_consumed
from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.renderer.worker import backpressure
from photonfarm.renderer.worker.backpressure import AHEAD_LOOK_S, TrainerPace
from photonfarm.renderer.worker.settings import WorkerSettings
from photonfarm.store import SceneStore, Store


class Clock:
    now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def connection(redis_server: EmbeddedRedis) -> Iterator[redis.Redis]:
    with connect(redis_server.url) as connected:
        yield connected


@pytest.fixture
def two_may_be_committed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backpressure, "AHEAD_MINIMUM", 2)


@pytest.fixture
def add(store: Store, analytic: ModuleType) -> Callable[..., SceneStore]:
    """A scene of four jobs of two samples, of which some are committed."""

    def added(name: str, width: int, committed: int) -> SceneStore:
        spec = analytic.small_spec(name=name, film={"width": width, "height": 8})
        scene = store.scene(store.plan(spec, Request(modifications=8), shard_rows=2).scene_id)
        renderer = ShardRenderer(store, worker="test", load=analytic.AnalyticScene.load)
        for job in range(committed):
            renderer.render(scene.scene_id, job)
        return scene

    return added


@pytest.mark.usefixtures("two_may_be_committed")
def test_no_more_is_committed_than_the_ratio_to_what_the_trainer_has_used(
    analytic: ModuleType, store: Store, add: Callable[..., SceneStore], connection: redis.Redis
) -> None:
    """There are 8 samples, of which 2 may be committed in any case."""
    scene, clock = add("one", 8, 0), Clock()
    pace = TrainerPace(store, connection, 1.5, clock=clock)
    renderer = ShardRenderer(store, worker="test", load=analytic.AnalyticScene.load)

    def reason_after(job: int | None = None, used: int | None = None) -> str | None:
        if job is not None:
            renderer.render(scene.scene_id, job)
        if used is not None:
            report_consumed(connection, scene.scene_id, used)
        clock.now += AHEAD_LOOK_S
        return pace.scenes_ahead().get(scene.scene_id)

    assert reason_after(job=0) is None
    assert reason_after(job=1) == "4 samples are committed, and the trainer has used 0 (--ahead 1.5)"
    assert reason_after(used=2) == "4 samples are committed, and the trainer has used 2 (--ahead 1.5)"
    assert reason_after(used=3) is None
    assert reason_after(job=2) == "6 samples are committed, and the trainer has used 3 (--ahead 1.5)"
    connection.flushall()
    assert "has used 0" in reason_after()
    assert reason_after(used=4) is None
    connection.flushall()
    assert reason_after(job=3) is None, "complete: there is nothing to hold back"


@pytest.mark.usefixtures("two_may_be_committed")
def test_each_scene_is_held_against_its_own_trainer(
    store: Store, add: Callable[..., SceneStore], connection: redis.Redis
) -> None:
    ahead, new, used = add("ahead", 8, 3), add("new", 16, 1), add("used", 24, 3)
    report_consumed(connection, used.scene_id, 6)
    assert TrainerPace(store, connection, 1.0).scenes_ahead().keys() == {ahead.scene_id}
    assert TrainerPace(store, connection, 1.0, scene_id=new.scene_id).scenes_ahead() == {}
    assert TrainerPace(store, connection, 1.0, scene_id=ahead.scene_id).scenes_ahead().keys() == {ahead.scene_id}


def test_a_ratio_below_one_is_refused_as_it_would_stop_for_good() -> None:
    told = {"store": "s", "redis_url": "redis://h/0", "name": "ada"}
    assert WorkerSettings.model_validate({**told, "ahead": 1}).ahead == 1
    with pytest.raises(ValidationError) as refused:
        WorkerSettings.model_validate({**told, "ahead": 0.99})
    assert refused.value.errors()[0]["loc"] == ("ahead",)


def test_a_worker_leaves_a_scene_that_is_ahead_says_so_and_renders_the_others(
    analytic: ModuleType,
    store: Store,
    add: Callable[..., SceneStore],
    redis_server: EmbeddedRedis,
    connection: redis.Redis,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """One scene with 6 samples that nobody has used, and a new one; 2 of each may be committed in any case."""
    code = """
import runpy, sys
from photonfarm.renderer.worker import backpressure
backpressure.AHEAD_MINIMUM, backpressure.AHEAD_LOOK_S = 2, 0
backpressure.pause_after_look = lambda took_s, usual_s: usual_s  # a look before each job, however fast they are
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""
    ahead, new = add("ahead", 8, 3), add("new", 16, 0)
    log, child = tmp_path / "log", (sys.executable, "-c", code, *analytic.command()[1:])
    with analytic.start_worker(store.root, redis_server.url, child, log, until_complete=True, ahead=1.5) as running:
        try:
            analytic.wait_for(lambda: len(new.committed_jobs()) == 2, 120)
            idle = lambda: queue_status(connection)  # noqa: E731
            analytic.wait_for(lambda: idle().skipped.keys() == {ahead.scene_id, new.scene_id}, 60)
            report_consumed(connection, new.scene_id, 8)
            analytic.wait_for(lambda: not new.missing_jobs(), 60)
            analytic.wait_for(lambda: idle().skipped.keys() == {ahead.scene_id}, 60)
            status.callback(store.root, redis_server.url, as_json=False)
            assert len(ahead.committed_jobs()) == 3
            report_consumed(connection, ahead.scene_id, 6)
            assert running.wait(120) == 0
        finally:
            running.kill()
    assert ahead.missing_jobs() == []
    reason = "6 samples are committed, and the trainer has used 0 (--ahead 1.5)"
    assert f"ahead: left by 1 of 1 workers: {reason}" in capsys.readouterr().out
    said = log.read_text()
    assert said.count(f"takes no jobs of scene {ahead.scene_id}: {reason}") == 1
    assert said.count(f"takes jobs of scene {ahead.scene_id} again") == 1
    assert queue_status(connection).skipped == {}
