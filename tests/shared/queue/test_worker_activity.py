"""What workers are doing, as others read it; and failures that outlive Redis."""

import json

import pytest
import store_samples as samples
from redis import Redis

from photonfarm.shared import queue
from photonfarm.shared.plan.request import Request
from photonfarm.shared.queue.worker_activity import DOING, PHASE_LETTERS
from photonfarm.shared.store import SceneStore, Store


@pytest.fixture
def scene(store: Store) -> SceneStore:
    return store.scene(store.plan(samples.small_spec(), Request(modifications=6), shard_rows=2).scene_id)


def test_an_activity_is_read_as_it_was_reported_and_is_gone_once_cleared(connection: Redis) -> None:
    doing = queue.Activity("renders samples", 3, 8, f"{'ab' * 16}-7")
    queue.report_activity(connection, "ada", doing, ttl_s=60)
    assert queue.queue_status(connection).activities == {"ada": doing}
    assert str(doing) == "renders samples 3/8"
    assert 0 < connection.pttl(DOING + "ada") <= 60_000
    queue.clear_activity(connection, "ada")
    assert queue.queue_status(connection).activities == {}


@pytest.mark.parametrize("value", ["", "1 2", "-1 2 - x", "1 9999999 - x", "\u0661 2 - x", "one two - x", b"\xff\xfe"])
def test_what_strangers_write_as_an_activity_is_left_out(connection: Redis, value: str) -> None:
    connection.set(DOING + "eve", value)
    assert queue.queue_status(connection).activities == {}


@pytest.mark.parametrize("job", ["../../etc", f"{'ab' * 16}-007", f"{'ab' * 16}-{1 << 48}"])
def test_a_strangers_activity_is_short_and_printable_and_of_no_job(connection: Redis, job: str) -> None:
    connection.set(DOING + "eve\x1b[2J", f"1 2 {job} \x1b[31m{'x' * 10_000}")
    ((name, found),) = queue.queue_status(connection).activities.items()
    assert name.isprintable()
    assert found.phase.isprintable()
    assert len(found.phase) <= PHASE_LETTERS
    assert found.job is None


def test_a_failure_is_kept_in_the_store_and_the_last_one_counts(store: Store, scene: SceneStore) -> None:
    name = queue.job_name(scene.scene_id, 1)
    queue.keep_failure(store, name, "ValueError: first", worker="ada", at_s=1000.5)
    queue.keep_failure(store, name, "ValueError: second\x1b[2J", worker="ada", at_s=2000.0)
    (found,) = queue.kept_failures(Store(store.root), lambda _: True).values()
    assert (found.reason, found.times, found.set_aside) == ("ValueError: second [2J", 2, False)
    assert queue.kept_failures(store, lambda _: False) == {}


def test_files_that_are_no_failures_do_no_harm(store: Store, scene: SceneStore) -> None:
    name = queue.job_name(scene.scene_id, 0)
    queue.keep_failure(store, name, "ValueError", worker="ada", at_s=1.0)
    folder = scene.folder.parent.parent / "failures"
    (folder / f"{scene.scene_id}-007.1.json").write_text("{}")  # no name of a job
    (folder / "notes.txt").write_text("mine")
    (kept,) = folder.glob("*-0.*.json")
    assert json.loads(kept.read_text())["job"] == name
    kept.write_text("[" * 100_000)
    assert list(queue.kept_failures(store, lambda _: True)) == [name]
