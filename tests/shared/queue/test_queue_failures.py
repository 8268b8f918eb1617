"""Jobs that failed: what they have in common, in Redis and in the store."""

import time

import queue_samples
import redis
from rq.results import Result

from photonfarm.queue.failures import (
    Failure,
    count_failures,
    group_causes,
    keep_failure,
    keep_retry,
    read_kept_failures,
)
from photonfarm.queue.job import TRIES, job_name
from photonfarm.queue.reconciliation import reconcile
from photonfarm.queue.rq_adapter import open_queue, queue_status
from photonfarm.store import SceneStore, Store

scene = queue_samples.scene
SCENE_ID = queue_samples.SCENE_ID


def test_what_was_set_aside_is_queued_again_only_when_asked_for(
    connection: redis.Redis, store: Store, scene: SceneStore
) -> None:
    assert reconcile(store, connection) == 10
    name = queue_samples.failed(connection, "broken")
    assert queue_status(connection).failed == {name: Failure("broken", TRIES)}
    assert reconcile(store, connection) == 0
    assert reconcile(store, connection, retry=True) == 1
    assert queue_status(connection).failed == {}
    assert not connection.exists(Result.get_key(name))
    assert open_queue(connection).fetch_job(name).retries_left == TRIES - 1


def test_failures_are_grouped_by_what_they_have_in_common() -> None:
    first, *others = group_causes(
        {
            f"{SCENE_ID}-1": Failure(f"IncompleteError: half A of sample {'ab' * 16} came out non-finite 3 times", 1),
            f"{SCENE_ID}-2": Failure(
                f"IncompleteError: half A of sample {'cd' * 16} came out non-finite 3 times", TRIES
            ),
            f"{SCENE_ID}-3": Failure(f"IncompleteError: half B of sample {'ab' * 16} came out non-finite 3 times", 1),
            f"{SCENE_ID}-4": Failure("ValueError: cannot reshape array of size -12 into shape (4,3.5)", 1),
            f"{SCENE_ID}-5": Failure("ValueError: cannot reshape array of size 7 into shape (4,1e-3)", 1),
            f"{SCENE_ID}-6": Failure("IncompleteError: half A of sample … came out", 2),
        }
    )
    assert first.cause == "IncompleteError: half A of sample … came out non-finite … times"
    names = [f"{SCENE_ID}-2", f"{SCENE_ID}-1"]
    assert (list(first.jobs), first.set_aside, first.example) == (names, 1, names[0])
    assert [len(cause.jobs) for cause in others] == [2, 1, 1]


def test_a_failure_is_kept_in_the_store_until_it_is_retried_and_the_last_one_counts(
    store: Store, scene: SceneStore
) -> None:
    name = job_name(scene.scene_id, 1)
    for reason in ("ValueError: first", "ValueError: second\nand more"):
        keep_failure(store, name, reason, worker="ada")
        time.sleep(0.002)  # files are named by milliseconds
    assert read_kept_failures(Store(store.root)) == {name: Failure("ValueError: second and more", 2)}
    assert read_kept_failures(store, lambda _: False) == {}
    assert count_failures(store) == {name: 2}
    keep_retry(store)
    time.sleep(0.002)
    assert read_kept_failures(store) == count_failures(store) == {}
    keep_failure(store, name, "ValueError: third", worker="ada")
    assert count_failures(store) == {name: 1}
