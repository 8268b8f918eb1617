"""Many workers that wait look at the store as often as one of them would."""

from collections.abc import Callable

import pytest
import queue_samples
import redis
import store_samples as samples

from photonfarm.shared.plan.request import Request
from photonfarm.shared.queue import ALIVE, beat, job_name, look, reconcile, reconciliation, record_failure
from photonfarm.shared.store import SceneStore, Store
from photonfarm.shared.store.io.local import LocalStorage

scene = queue_samples.scene

KEY = f"{reconciliation.LOOKED}all"


@pytest.fixture
def listed(monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """How often markers have been listed since the last call."""
    folders, plain = [], LocalStorage.names

    def names(storage: LocalStorage, folder: str) -> list[str]:
        folders.append(folder)
        return plain(storage, folder)

    def count() -> int:
        found = sum(folder.endswith("/committed") for folder in folders)
        folders.clear()
        return found

    monkeypatch.setattr(LocalStorage, "names", names)
    return count


@pytest.fixture
def waiting(connection: redis.Redis, store: Store, scene: SceneStore) -> str:
    """All jobs are committed but the last, which somebody renders; its name."""
    for job in range(scene.jobs() - 1):
        assert samples.commit(scene, job, samples.outputs(scene, job))
    name = job_name(scene.scene_id, scene.jobs() - 1)
    beat(connection, "somebody", "elsewhere", name, ttl_s=60)
    return name


@pytest.mark.parametrize("workers", [4, 64])
@pytest.mark.usefixtures("waiting")
def test_any_number_of_waiting_workers_list_the_markers_once_in_a_while(
    connection: redis.Redis, store: Store, listed: Callable[[], int], workers: int
) -> None:
    stores = [Store(store.root) for _ in range(workers)]
    listed()
    assert {look(each, connection, every_s=60) for each in stores} == {"waits"}
    assert listed() == 1
    connection.delete(KEY)  # as after the while
    assert {look(each, connection, every_s=60) for each in stores} == {"waits"}
    assert listed() == 1


@pytest.mark.usefixtures("waiting")
def test_the_commands_of_a_waiting_worker_do_not_grow_with_the_workers(
    connection: redis.Redis, store: Store, scene: SceneStore
) -> None:
    def commands_of_a_look() -> int:
        before = sum(about["calls"] for about in connection.info("commandstats").values())
        assert look(store, connection, every_s=60) == "waits"
        return sum(about["calls"] for about in connection.info("commandstats").values()) - before

    look(store, connection, every_s=60)
    few = commands_of_a_look()
    for worker in range(3000):  # more keys than one answer to a scan has
        connection.set(f"{ALIVE}{job_name(scene.scene_id, 10**6 + worker)}", "a worker", ex=60)
    assert commands_of_a_look() == few < 10


def test_a_job_that_is_free_again_is_queued_once_the_while_is_over(
    connection: redis.Redis, store: Store, waiting: str
) -> None:
    assert look(store, connection, every_s=60) == "waits"
    connection.delete(ALIVE + waiting)
    assert look(store, connection, every_s=60) == "waits"
    assert 0 < connection.pttl(KEY) <= 60_000
    connection.delete(KEY)
    assert look(store, connection, every_s=60) == "queued"
    assert queue_samples.queued(connection) == [waiting]
    assert connection.exists(KEY) == 0, "while there are new jobs, nobody is told to wait"
    assert look(store, connection, every_s=60) == "waits"


def test_a_submission_looks_whatever_others_have_found(
    connection: redis.Redis, store: Store, scene: SceneStore
) -> None:
    for job in range(scene.jobs()):
        assert samples.commit(scene, job, samples.outputs(scene, job))
    assert look(store, connection, every_s=60) == "nothing"
    scene.plan(Request(modifications=2, seed=1))
    assert look(store, connection, every_s=60) == "nothing", "as found before"
    assert reconcile(store, connection) == 1


def test_where_all_that_is_missing_has_failed_there_is_nothing_to_wait_for(
    connection: redis.Redis, store: Store, waiting: str
) -> None:
    connection.delete(ALIVE + waiting)
    record_failure(connection, waiting, "it is broken")
    assert look(store, connection, every_s=60) == "nothing"


def test_while_another_process_looks_there_is_something_to_wait_for(
    connection: redis.Redis, store: Store, scene: SceneStore
) -> None:
    with connection.lock("rq:photonfarm:reconcile", timeout=10):
        assert look(store, connection, every_s=60) == "waits"
    assert connection.exists(KEY) == 0
    assert look(store, connection, every_s=60) == "queued"


@pytest.mark.parametrize("put", [
    lambda connection: connection.set(KEY, "waits"),
    lambda connection: connection.set(KEY, "waits", ex=3600),
    lambda connection: connection.set(KEY, "whatever", ex=30),
    lambda connection: connection.sadd(KEY, "waits"),
], ids=["for ever", "for an hour", "another word", "another type"])  # fmt: skip
def test_what_a_stranger_writes_does_not_keep_workers_from_looking(
    connection: redis.Redis, store: Store, scene: SceneStore, put: Callable[[redis.Redis], object]
) -> None:
    put(connection)
    assert look(store, connection, every_s=60) == "queued"
