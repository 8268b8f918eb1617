"""What holds a worker back, and lets it go again: a nearly full disk, a trainer far behind. No job fails for it."""

import errno
import os
import shutil
import sys
from pathlib import Path
from types import ModuleType

import pytest
from click.testing import CliRunner

from photonfarm.core.errors import StoreError
from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.plan.request import Request
from photonfarm.queue.connection import connect
from photonfarm.queue.rq_adapter import queue_status
from photonfarm.renderer.cli import machine_verbs
from photonfarm.renderer.worker import backpressure
from photonfarm.renderer.worker.backpressure import FULL_S, DiskReserve, is_full
from photonfarm.store import SceneStore, Store


@pytest.fixture
def scene(analytic: ModuleType, store: Store) -> SceneStore:
    """Four jobs of two samples."""
    return store.scene(store.plan(analytic.small_spec(), Request(modifications=8), shard_rows=2).scene_id)


@pytest.mark.parametrize(
    ("size", "in_bytes"), [("0", 0), ("500MB", 5 * 10**8), ("1.5 GB", 15 * 10**8), ("2T", 2 * 10**12), ("7kB", 7000)]
)
def test_a_size_is_read_as_it_is_written(size: str, in_bytes: int) -> None:
    assert machine_verbs._bytes(None, None, size) == in_bytes


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--reserve", "5 bananas"], "500MB or 2GB"),
        (["--ahead", "0.5"], "--ahead"),
        (["--job", "1"], "--scene"),
    ],
)
def test_options_that_cannot_be_are_wrong_usage(arguments: list[str], said: str) -> None:
    result = CliRunner().invoke(machine_verbs.work, arguments)
    assert result.exit_code == 2
    assert said in result.output


class Clock:
    now = 1000.0

    def __call__(self) -> float:
        return self.now


def free_is(monkeypatch: pytest.MonkeyPatch, gigabytes: float) -> None:
    usage = shutil.disk_usage("/")._replace(free=int(gigabytes * 1e9))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)


def test_no_job_is_taken_while_less_than_the_reserve_is_free(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = DiskReserve(store, 5 * 10**9)
    free_is(monkeypatch, 4.9)
    assert "4.9 GB" in disk.reason()
    assert "5 GB are to stay free (--reserve)" in disk.reason()
    free_is(monkeypatch, 5)
    assert disk.reason() is None
    free_is(monkeypatch, 0)
    assert DiskReserve(store, 0).reason() is None


def test_a_store_that_is_not_on_a_disk_has_no_reserve(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    free_is(monkeypatch, 0)
    monkeypatch.setattr(store, "storage", object())
    assert DiskReserve(store, 1 << 60).reason() is None


def test_a_disk_that_refused_a_write_is_left_alone_for_a_while(store: Store) -> None:
    clock = Clock()
    disk = DiskReserve(store, 0, clock=clock)
    disk.note_refusal()
    assert "the disk is full" in disk.reason()
    clock.now += FULL_S
    assert disk.reason() is None


@pytest.mark.parametrize(("number", "full"), [(errno.ENOSPC, True), (errno.EDQUOT, True), (errno.EACCES, False)])
def test_a_full_disk_is_told_from_other_refusals(number: int, full: bool) -> None:
    error = StoreError("cannot commit job 0")
    error.__cause__ = OSError(number, os.strerror(number))
    assert is_full(error) is full
    assert is_full(error.__cause__) is full
    assert not is_full(ValueError())


def test_the_trainers_first_samples_are_never_held_back() -> None:
    from photonfarm.trainer.runs.settings import TrainSettings, make_preset

    for settings in (TrainSettings(), make_preset("small")):
        assert settings.minimum_samples + settings.validation_samples < backpressure.AHEAD_MINIMUM


def test_a_worker_waits_for_space_says_so_once_and_goes_on(
    analytic: ModuleType, store: Store, scene: SceneStore, redis_server: EmbeddedRedis, tmp_path: Path
) -> None:
    """A file of 2 GB takes the space and gives it back; whatever else is written here meanwhile is less than 1 GB."""
    ballast = tmp_path / "ballast"
    try:
        with ballast.open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, 2 * 10**9)
    except OSError as error:
        pytest.skip(f"no 2 GB to spare here: {error}")
    reserve = shutil.disk_usage(tmp_path).free + 10**9
    log = tmp_path / "log"
    with analytic.start_worker(
        store.root, redis_server.url, analytic.command(), log, until_complete=True, reserve_bytes=reserve
    ) as running:
        analytic.wait_for(lambda: "takes no jobs" in log.read_text(), 120)
        analytic.wait_for(lambda: queue_status(connect(redis_server.url)).queued == 4, 60)
        assert scene.committed_jobs() == set()
        ballast.unlink()
        assert running.wait(120) == 0
    assert scene.missing_jobs() == []
    assert log.read_text().count("takes no jobs") == log.read_text().count("takes jobs again") == 1
    assert queue_status(connect(redis_server.url)).failed == {}


def test_a_commit_that_finds_the_disk_full_fails_no_job_and_ends_no_worker(
    analytic: ModuleType, store: Store, scene: SceneStore, redis_server: EmbeddedRedis, tmp_path: Path
) -> None:
    """The first commit finds no space, whatever the reserve."""
    code = """
import errno, runpy, sys
from photonfarm.renderer.worker import backpressure
from photonfarm.store.io.local import LocalStorage
backpressure.FULL_S = 0.2
plain, refusals = LocalStorage.adopt, [1]
def adopt(self, part, name, *, replace=False):
    if "radiance" in name and refusals[0]:
        refusals[0] -= 1
        raise OSError(errno.ENOSPC, "No space left on device", str(part))
    return plain(self, part, name, replace=replace)
LocalStorage.adopt = adopt
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""
    log, child = tmp_path / "log", (sys.executable, "-c", code, *analytic.command()[1:])
    with analytic.start_worker(store.root, redis_server.url, child, log, until_complete=True) as running:
        assert running.wait(240) == 0
    assert scene.missing_jobs() == []
    said = log.read_text()
    assert "the disk is full" in said
    assert "starting again" not in said
    assert queue_status(connect(redis_server.url)).failed == {}
