"""Many workers that wait look at the store as often as one of them would."""

from collections.abc import Callable

import pytest
import queue_samples
import redis
import store_samples as samples

from photonfarm.plan.request import Request
from photonfarm.queue import reconciliation
from photonfarm.queue.reconciliation import fill_seldom, reconcile
from photonfarm.queue.rq_adapter import fail_of_worker
from photonfarm.store import SceneStore, Store
from photonfarm.store.io.local import LocalStorage

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
    assert reconcile(store, connection) == 1
    return queue_samples.taken(connection, "somebody").job_id


@pytest.mark.parametrize("workers", [4, 64])
@pytest.mark.usefixtures("waiting")
def test_any_number_of_waiting_workers_list_the_markers_once_in_a_while(
    connection: redis.Redis, store: Store, listed: Callable[[], int], workers: int
) -> None:
    stores = [Store(store.root) for _ in range(workers)]
    listed()
    assert {fill_seldom(each, connection, every_s=60) for each in stores} == {"waits"}
    assert listed() == 1
    connection.delete(KEY)  # as after the while
    assert {fill_seldom(each, connection, every_s=60) for each in stores} == {"waits"}
    assert listed() == 1


def test_a_job_that_is_free_again_is_queued_once_the_while_is_over(
    connection: redis.Redis, store: Store, waiting: str
) -> None:
    assert fill_seldom(store, connection, every_s=60) == "waits"
    fail_of_worker(connection, "somebody", "killed", counts=True)
    assert fill_seldom(store, connection, every_s=60) == "waits"
    assert 0 < connection.pttl(KEY) <= 60_000
    assert queue_samples.queued(connection) == [waiting]
    connection.flushall()
    assert fill_seldom(store, connection, every_s=60) == "queued"
    assert queue_samples.queued(connection) == [waiting]
    assert connection.exists(KEY) == 0, "while there are new jobs, nobody is told to wait"
    assert fill_seldom(store, connection, every_s=60) == "waits"


def test_a_submission_looks_whatever_others_have_found(
    connection: redis.Redis, store: Store, scene: SceneStore
) -> None:
    for job in range(scene.jobs()):
        assert samples.commit(scene, job, samples.outputs(scene, job))
    assert fill_seldom(store, connection, every_s=60) == "nothing"
    scene.plan(Request(modifications=2, seed=1))
    assert fill_seldom(store, connection, every_s=60) == "nothing", "as found before"
    assert reconcile(store, connection) == 1


def test_where_all_that_is_missing_has_failed_there_is_nothing_to_wait_for(
    connection: redis.Redis, store: Store, waiting: str
) -> None:
    fail_of_worker(connection, "somebody", "killed", counts=False)
    assert queue_samples.failed(connection, "it is broken") == waiting
    assert fill_seldom(store, connection, every_s=60) == "nothing"


def test_while_another_process_looks_there_is_something_to_wait_for(
    connection: redis.Redis, store: Store, scene: SceneStore
) -> None:
    with connection.lock("rq:photonfarm:reconcile", timeout=10):
        assert fill_seldom(store, connection, every_s=60) == "waits"
    assert connection.exists(KEY) == 0
    assert fill_seldom(store, connection, every_s=60) == "queued"
