"""Answers of the bucket are lost, requests come late, submitters and workers die or sleep at every step."""

import contextlib
import io
import itertools
import os
import shutil
import signal
import threading
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import obstore
import pytest
import s3_server
from obstore.exceptions import AlreadyExistsError
from obstore.store import from_url

from photonfarm.core.errors import StoreError
from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.plan.request import PlannedRows, Request
from photonfarm.queue.connection import connect
from photonfarm.queue.reconciliation import reconcile
from photonfarm.renderer.tools import doctor
from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.io import object_requests
from photonfarm.store.io.objects import ObjectStorage


def stored(url: str) -> dict[str, bytes]:
    """Every object below a place, by name."""
    bucket = from_url(url, client_options={"allow_http": True})
    names = [about["path"] for batch in obstore.list(bucket) for about in batch]
    return {name: bytes(obstore.get(bucket, name).bytes()) for name in names}


def part_of(storage: ObjectStorage, content: bytes) -> Path:
    part = storage.part()
    part.write_bytes(content)
    return part


# ---------------------------------------------------------------------------------------------------------- single puts


@pytest.mark.parametrize("fault", ["answer", "request", "late"])
def test_a_put_whose_answer_is_lost_is_known_for_our_own(
    url: str, port: int, monkeypatch: pytest.MonkeyPatch, fault: str
) -> None:
    late = threading.Event()
    faults = iter([late if fault == "late" else fault])
    storage = ObjectStorage(url)
    storage.check()
    with s3_server.faulty_way(
        port, lambda method, path: next(faults, None) if (method, path[-4:]) == ("PUT", "name") else None
    ) as way:
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{way}")
        shaken = ObjectStorage(url)
        assert shaken.adopt(part_of(shaken, b"ours"), "name")
        assert next(faults, None) is None
        assert not shaken.adopt(part_of(shaken, b"theirs"), "name")
        late.set()
    assert storage.read("name") == b"ours"


def test_a_replacement_that_arrives_late_does_not_undo_a_later_one(
    url: str, port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    storage = ObjectStorage(url)
    storage.adopt(part_of(storage, b"damaged"), "name")
    monkeypatch.setattr(object_requests, "PATIENCE_S", 0.0)
    late = threading.Event()
    with s3_server.faulty_way(port, lambda method, _: late if method == "PUT" else None) as way:
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{way}")
        shaken = ObjectStorage(url)
        shaken._is_conditional = True
        with pytest.raises(OSError, match="name"):
            shaken.adopt(part_of(shaken, b"late"), "name", replace=True)
        storage.adopt(part_of(storage, b"later"), "name", replace=True)
        late.set()
    assert storage.read("name") == b"later"


def test_a_put_refused_for_another_that_then_failed_is_tried_again(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """S3 answers 409 while another put of the name is under way."""
    refusals, plain = iter([True]), obstore.put

    def conflicting(*args: Any, **how: Any) -> Any:
        if args[1] == "name" and next(refusals, False):
            raise AlreadyExistsError("409 Conflict")
        return plain(*args, **how)

    monkeypatch.setattr(obstore, "put", conflicting)
    storage = ObjectStorage(url)
    assert storage.adopt(part_of(storage, b"ours"), "name")
    assert storage.read("name") == b"ours"


def test_the_doctor_tries_the_bucket(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "does not overwrite" in doctor._writes(url)
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "wrong")
    with pytest.raises(StoreError):
        doctor._writes(url)


def test_the_doctor_tells_that_a_disk_is_too_full_for_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "can be written" in doctor._writes(tmp_path / "store")
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=int(0.4e9)))
    with pytest.raises(StoreError, match=r"0\.4 GB"):
        doctor._writes(tmp_path / "store")


# --------------------------------------------------------------------------------------------------------------- plans

FIRST = Request(modifications=2, views_per_modification=2)
SECOND = Request(modifications=3)

ROOT = "plans/000000/zarr.json"
POINTS = {
    "before the claim": ("plans/000000.claim", "before"),
    "after the claim": ("plans/000000.claim", "after"),
    "between two files": ("plans/000000/sample_view/zarr.json", "before"),
    "before the folder's own file": (ROOT, "before"),
    "after the folder's own file": (ROOT, "after"),
}


class Killed(BaseException):
    """Stands for SIGKILL: nothing is put after it."""


@contextlib.contextmanager
def at(point: tuple[str, str], act: Callable[[], None]) -> Iterator[None]:
    """Do something once, at a point of the puts; if that kills, there are no further ones in this context."""
    name, when = point
    plain, acted, dead = obstore.put, threading.Lock(), threading.Event()

    def reached() -> None:
        if acted.acquire(blocking=False):
            try:
                act()
            except Killed:
                dead.set()
                raise

    def put(bucket: Any, path: str, *args: Any, **how: Any) -> Any:
        if dead.is_set():
            raise Killed
        if path.endswith(name) and when == "before":
            reached()
        result = plain(bucket, path, *args, **how)
        if path.endswith(name) and when == "after":
            reached()
        return result

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(obstore, "put", put)
        yield


def assert_whole(scene: SceneStore, requests: list[Request], url: str) -> None:
    """All requests are planned, no key twice, and no plan holds a file of another."""
    plans = scene.plans()
    keys = [key.tobytes() for plan in plans for key in plan.rows.sample_key[plan.rows.sample_modification >= 0]]
    assert len(keys) == len(set(keys)) == 4 + 1
    assert [plan.first_job for plan in plans] == [0, *(plan.end_job for plan in plans[:-1])]
    for request in requests:
        assert Store(url).plan(scene.spec, request, dry_run=True).new == 0
    objects_ = stored(url)
    for plan in plans:
        with zipfile.ZipFile(io.BytesIO(objects_[f"{plan.folder}.claim"])) as claim:
            claimed = {f"{plan.folder}/{name}": claim.read(name) for name in claim.namelist()}
        assert claimed == {name: content for name, content in objects_.items() if name.startswith(f"{plan.folder}/")}


@pytest.mark.parametrize("point", POINTS.values(), ids=POINTS.keys())
def test_a_submitter_killed_at_any_point_leaves_no_plan_or_one_that_the_next_completes(
    analytic: ModuleType, url: str, point: tuple[str, str]
) -> None:
    scene = Store(url, create=True).add(analytic.small_spec())

    def kill() -> None:
        raise Killed

    with pytest.raises(Killed), at(point, kill):
        scene.plan(FIRST, shard_rows=2)
    assert len(Store(url).scene(scene.scene_id).plans()) == (point == POINTS["after the folder's own file"])
    result = Store(url).plan(scene.spec, SECOND)
    assert (result.plan, result.new) == ((0, 3) if point == POINTS["before the claim"] else (1, 1))
    scene.plan(FIRST)
    assert_whole(scene, [FIRST, SECOND], url)


@pytest.mark.parametrize("point", [POINTS["before the claim"], POINTS["between two files"]])
def test_a_submitter_that_sleeps_while_another_submits_mixes_nothing(
    analytic: ModuleType, url: str, point: tuple[str, str]
) -> None:
    scene = Store(url, create=True).add(analytic.small_spec())
    theirs = []
    with at(point, lambda: theirs.append(Store(url).plan(scene.spec, SECOND, shard_rows=2))):
        mine = scene.plan(FIRST, shard_rows=2)
    assert (theirs[0].plan, mine.plan) == ((0, 1) if point == POINTS["before the claim"] else (1, 0))
    assert_whole(scene, [FIRST, SECOND], url)


# -------------------------------------------------------------------------------------------------------------- workers


@pytest.mark.slow
def test_workers_behind_a_lossy_way_and_under_kills_lose_and_double_nothing(
    analytic: ModuleType,
    planned: Callable[..., SceneStore],
    clean_bytes: Callable[[int], dict[str, bytes]],
    url: str,
    port: int,
    redis_server: EmbeddedRedis,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Every fifth put is done and not answered, or lost, or late; the child is killed twice."""
    clean = clean_bytes(6)
    request = Request(modifications=3, views_per_modification=2, passes=2)
    store = Store(url, create=True)
    scene = store.scene(store.plan(analytic.small_spec(), request, shard_rows=2).scene_id)
    reconcile(store, connect(redis_server.url))
    kinds, puts, lock = itertools.cycle(["answer", "late", "request"]), itertools.count(1), threading.Lock()
    lost: list[str] = []

    def fault(method: str, path: str) -> str | threading.Event | None:
        with lock:
            if method != "PUT" or next(puts) % 5:
                return None
            lost.append(next(kinds))
            late = threading.Event()
            threading.Timer(1.0, late.set).start()
            return late if lost[-1] == "late" else lost[-1]

    with s3_server.faulty_way(port, fault) as way, contextlib.ExitStack() as stack:
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{way}")
        workers = [
            stack.enter_context(
                analytic.start_worker(url, redis_server.url, analytic.command(0.02), until_complete=True, name=name)
            )
            for name in ("a", "b")
        ]
        for worker in workers:
            stack.callback(worker.kill)
        for committed in (1, 3):
            analytic.wait_for(lambda committed=committed: len(scene.committed_jobs()) >= committed, 200)
            child = analytic.child_of(workers[0])
            if child is not None:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(child, signal.SIGKILL)
        assert [worker.wait(300) for worker in workers] == [0, 0], workers[0].stderr.read().decode()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{port}")
    assert len(lost) >= 10
    assert scene.missing_jobs() == []
    found = {name.removeprefix(f"{scene.name}/"): content for name, content in stored(url).items()}
    data = {name: content for name, content in found.items() if name.startswith(("plans/", "base/"))}
    assert {name: content for name, content in data.items() if not name.endswith(".claim")} == clean
    assert len([name for name in found if name.startswith("committed/")]) == scene.jobs() == 6

    source = SceneReader(url, scene.scene_id)  # as the trainer reads
    assert source.ready()
    rows = source.refresh()
    assert rows.size == 12
    assert all(np.isfinite(sample.radiance).all() for sample in source.read_samples(rows.tolist()))
    assert len(source.base()[1].position) == scene.spec.points
    keys: PlannedRows = scene.plans()[0].rows
    assert len({keys.sample_key[row].tobytes() for row in rows}) == 12
