"""What is wrong with one scene of a store stays with it, and what is wrong with the store is told as that."""

import logging
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import store_samples as samples

from photonfarm.core.errors import CorruptError, StoreError
from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.plan.request import Request
from photonfarm.queue.connection import connect
from photonfarm.queue.reconciliation import reconcile
from photonfarm.queue.rq_adapter import queue_status
from photonfarm.store import JobWriter, SceneReader, SceneStore, Store
from photonfarm.store.check.check import check_store
from photonfarm.store.io.local import LocalStorage
from photonfarm.store.read.find import Query, find_samples, scene_named


@pytest.fixture(scope="module")
def redis_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EmbeddedRedis]:
    with EmbeddedRedis(tmp_path_factory.mktemp("redis")) as server:
        yield server


@pytest.fixture
def redis_url(redis_server: EmbeddedRedis) -> str:
    """The URL of an empty Redis."""
    connect(redis_server.url).flushall()
    return redis_server.url


def planned(store: Store, points: int = 16) -> SceneStore:
    """Two jobs of two samples, the first of them committed."""
    spec = samples.small_spec(points=points)
    scene = store.scene(store.plan(spec, Request(modifications=4), shard_rows=2).scene_id)
    assert samples.commit(scene, 0, samples.outputs(scene, 0))
    return scene


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


HARMS: dict[str, Callable[[Path], None]] = {
    "a bit of a plan": lambda scene: flip(scene / "plans/000000/view/c.0.0"),
    "a plan's zarr.json": lambda scene: (scene / "plans/000000/zarr.json").unlink(),
    "the spec": lambda scene: (scene / "spec.json").write_text(""),
    "the spec, which is lost": lambda scene: (scene / "spec.json").unlink(),
}


@pytest.mark.parametrize("harm", HARMS.values(), ids=HARMS)
def test_a_damaged_scene_holds_up_no_other(
    store: Store, redis_url: str, harm: Callable[[Path], None], caplog: pytest.LogCaptureFixture
) -> None:
    damaged, whole = planned(store, 16), planned(store, 17)
    harm(damaged.folder)
    again = Store(store.root)
    statuses = {status.scene_id: status for status in samples.statuses(again)}
    assert statuses[whole.scene_id].error is None
    assert (statuses[whole.scene_id].jobs_planned, statuses[whole.scene_id].jobs_committed) == (2, 1)
    about = statuses[damaged.scene_id]
    assert (about.jobs_planned, about.size_bytes) == (0, 0)
    assert damaged.scene_id in str(about.error)

    connection = connect(redis_url)
    caplog.clear()
    caplog.set_level(logging.WARNING)
    assert reconcile(again, connection) == 1
    assert reconcile(again, connection) == 0
    assert queue_status(connection).queued == 1
    (told,) = [record.getMessage() for record in caplog.records if "passed over" in record.getMessage()]
    assert damaged.scene_id in told
    with pytest.raises(CorruptError):
        reconcile(again, connection, scene_id=damaged.scene_id)


def test_a_scene_that_has_lost_its_spec_is_told_by_all_and_a_submission_writes_the_spec_again(store: Store) -> None:
    scene = planned(store)
    (scene.folder / "spec.json").unlink()
    again = Store(store.root)
    assert (again.scene_ids(), again.has_scene(scene.scene_id)) == ([scene.scene_id], True)
    request = Request(modifications=4)
    for look in (
        lambda: again.scene(scene.scene_id),
        SceneReader(store.root, scene.scene_id).refresh,
        lambda: find_samples(again, again.scene_ids(), Query.of()),
    ):
        with pytest.raises(CorruptError):
            look()
    assert not (scene.folder / "spec.json").exists()
    assert again.plan(samples.small_spec(points=16), request).known == 4
    assert again.scene(scene.scene_id).missing_jobs() == [1]


def test_what_is_no_scene_of_ours_among_the_scenes_is_ignored_by_all(store: Store) -> None:
    scene = planned(store)
    for name in (".DS_Store", "notes.txt", "0" * 32):
        (store.root / "scenes" / name).write_text("someone's")
    for name in ("nothex", "1" * 32, "A" * 32):
        (store.root / "scenes" / name / "plans").mkdir(parents=True)
    for name in ("nothex", "A" * 32):
        (store.root / "scenes" / name / "plans/000000").mkdir()
    again = Store(store.root)
    assert again.scene_ids() == [scene.scene_id]
    assert [about.error for about in samples.statuses(again)] == [None]
    assert scene_named(again, "small") == scene.scene_id
    samples.commit_all(scene)
    scene.write_base(*samples.base())
    report = check_store(again, when="now", repair=True)
    assert (report.exit_code, [about.scene_id for about in report.scenes]) == (0, [scene.scene_id])


def test_a_store_that_cannot_be_read_is_no_error_of_its_scenes(
    store: Store, redis_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    planned(store)
    again = Store(store.root)

    def refused(self: LocalStorage, name: str) -> bytes:
        raise PermissionError(13, "Permission denied", name)

    monkeypatch.setattr(LocalStorage, "read", refused)
    with pytest.raises(StoreError):
        samples.statuses(again)
    with pytest.raises(StoreError):
        reconcile(again, connect(redis_url))


# ---------------------------------------------------------------------------------------------------- a store that goes


def removed(root: Path) -> None:
    shutil.rmtree(root)


def unmounted(root: Path) -> None:
    """The mount point stays, empty."""
    shutil.rmtree(root)
    root.mkdir()


@pytest.mark.parametrize("go", [removed, unmounted])
@pytest.mark.parametrize("when", ["before a row", "before the commit"])
def test_a_store_that_goes_under_a_worker_is_told_and_not_begun_anew(
    store: Store, go: Callable[[Path], None], when: str
) -> None:
    scene = planned(store)
    given = samples.outputs(scene, 1)

    def work() -> None:
        with JobWriter(scene, scene.job_rows(1)) as out:
            if when == "before a row":
                go(store.root)
            samples.give(out, given)
            out._join()
            if when == "before the commit":
                go(store.root)
            out.commit(samples.FIGURES)

    with pytest.raises(StoreError) as caught:
        work()
    assert not isinstance(caught.value, CorruptError)
    assert not store.root.exists() if go is removed else not list(store.root.iterdir())


@pytest.mark.parametrize("go", [removed, unmounted])
def test_nothing_of_a_store_that_is_gone_is_taken_for_missing(
    store: Store, redis_url: str, go: Callable[[Path], None]
) -> None:
    scene = planned(store)
    reader = SceneReader(store.root, scene.scene_id)
    assert reader.refresh().tolist() == [0, 1]
    go(store.root)
    for look in (
        store.scene_ids,
        scene.missing_jobs,
        lambda: reconcile(store, connect(redis_url)),
        reader.refresh,
        lambda: reader.read(0),
        lambda: scene.write_base(*samples.base()),
        lambda: scene.plan(Request(modifications=9)),
        store.sweep,
    ):
        with pytest.raises(StoreError, match="the store is gone") as caught:
            look()
        assert not isinstance(caught.value, CorruptError)
    assert not store.root.exists() if go is removed else not list(store.root.iterdir())


def test_scenes_without_the_store_s_document_are_refused_with_advice_and_never_adopted(store: Store) -> None:
    """A new document would have another id."""
    planned(store)
    document = store.root / "photonfarm.json"
    whole = document.read_bytes()
    document.unlink()
    for create in (False, True):
        with pytest.raises(CorruptError, match="put it back"):
            Store(store.root, create=create)
    assert not document.exists()
    document.write_bytes(whole)
    assert Store(store.root, create=True).store_id == store.store_id
