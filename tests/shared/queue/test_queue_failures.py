"""Jobs that fail: how often, what they have in common, and when they are set aside."""

import pytest
import queue_samples
import redis
from redis.connection import AbstractConnection as Connection

from photonfarm.shared import queue
from photonfarm.shared.queue import FAILED, Failure, job_name, open_queue, queue_status, reconcile
from photonfarm.shared.store import SceneStore, Store

scene = queue_samples.scene
SCENE_ID, NAME = queue_samples.SCENE_ID, queue_samples.NAME


def test_a_job_that_fails_three_times_is_set_aside_until_asked_for(
    connection: redis.Redis, store: Store, scene: SceneStore
) -> None:
    name = job_name(scene.scene_id, 4)
    for times in (1, 2):
        assert queue.record_failure(connection, name, "broken") == Failure("broken", times, set_aside=False)
        assert 0 < connection.ttl(FAILED + name) <= 3600
        assert reconcile(store, connection, limit=100, retry_failed=True) == (10 if times == 1 else 0)
        open_queue(connection).delete(delete_jobs=False)
        assert reconcile(store, connection) == 10
    assert queue.record_failure(connection, name, "broken").set_aside
    open_queue(connection).delete(delete_jobs=False)
    assert connection.ttl(FAILED + name) == -1
    assert queue_status(connection).failed == {name: Failure("broken", 3, set_aside=True)}
    assert reconcile(store, connection, retry_failed=True) == 9
    assert reconcile(store, connection, retry_set_aside=True) == 1
    assert queue_status(connection).failed == {}
    assert queue.record_failure(connection, name, "broken").times == 1


def test_many_failures_are_read_in_a_few_requests(connection: redis.Redis) -> None:
    for i in range(1500):
        connection.set(f"{FAILED}{SCENE_ID}-{i}", f"why {i}", ex=None if i % 2 else 3600)
    requests, plain = [], Connection.send_packed_command
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Connection, "send_packed_command", lambda *args, **how: (requests.append(1), plain(*args, **how)))
        failed = queue_status(connection).failed
        assert len(requests) < 40
        requests.clear()
        queue.forget_failures(connection, set_aside=False)
        assert len(requests) < 40
    assert len(failed) == 1500
    assert failed[f"{SCENE_ID}-1499"] == Failure("why 1499", 1, set_aside=True)
    assert failed[f"{SCENE_ID}-1498"] == Failure("why 1498", 1, set_aside=False)
    assert len(connection.keys(f"{FAILED}*")) == 750


def test_a_job_that_has_ended_well_has_nothing_counted_against_it(connection: redis.Redis) -> None:
    for _ in range(3):
        queue.record_failure(connection, NAME, "broken")
    queue.forget_failures_of(connection, NAME)
    assert not connection.keys("rq:photonfarm:*")


def test_failures_are_grouped_by_what_they_have_in_common() -> None:
    def failed(reason: str, times: int = 1) -> Failure:
        return Failure(reason, times, set_aside=times >= 3)

    first, *others = queue.causes(
        {
            f"{SCENE_ID}-1": failed(f"IncompleteError: half A of sample {'ab' * 16} came out non-finite 3 times"),
            f"{SCENE_ID}-2": failed(f"IncompleteError: half A of sample {'cd' * 16} came out non-finite 3 times", 3),
            f"{SCENE_ID}-3": failed(f"IncompleteError: half B of sample {'ab' * 16} came out non-finite 3 times"),
            f"{SCENE_ID}-4": failed("ValueError: cannot reshape array of size -12 into shape (4,3.5)"),
            f"{SCENE_ID}-5": failed("ValueError: cannot reshape array of size 7 into shape (4,1e-3)"),
            f"{SCENE_ID}-6": failed("IncompleteError: half A of sample … came out", 2),
        }
    )
    assert first.cause == "IncompleteError: half A of sample … came out non-finite … times"
    assert (list(first.jobs), first.set_aside, first.example) == (
        [f"{SCENE_ID}-2", f"{SCENE_ID}-1"],
        1,
        f"{SCENE_ID}-2",
    )
    assert [len(cause.jobs) for cause in others] == [2, 1, 1]


def test_what_a_stranger_writes_as_a_failure_cannot_speak_to_a_terminal(connection: redis.Redis) -> None:
    connection.set(FAILED + NAME, b"\x1b]0;owned\x07\xff" + b"x" * 1_000_000)
    connection.set(f"{FAILED}../../etc", "why")
    connection.set(f"{FAILED}{SCENE_ID}-8; rm -rf ~", "why")
    ((name, failure),) = queue_status(connection).failed.items()
    assert name == NAME
    assert failure.reason.startswith(" ]0;owned")
    assert failure.reason.isprintable()
    assert len(failure.reason) <= 2000
