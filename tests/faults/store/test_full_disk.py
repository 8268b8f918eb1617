"""A disk that is really full, or really read-only: nothing half-done is seen, nothing is lost, and work goes on.

The disk is a small tmpfs. Mounting needs root; without, all of this runs once more in a user namespace of its own.
"""

import contextlib
import errno
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import pytest

from photonfarm.core.errors import StoreError
from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.plan.request import Request
from photonfarm.queue.connection import connect
from photonfarm.queue.rq_adapter import queue_status
from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.renderer.worker.backpressure import is_full
from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.check.check import check_store

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="mounts a tmpfs")

SIZE_BYTES = 2 << 20
PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
NODES = 2000  # files, folders and links
BALLAST = "lost+found"  # a name that is not looked at

Bytes = Callable[[SceneStore], dict[str, bytes]]


def run(*command: str) -> str:
    """Nothing if a command succeeds; else what it says."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    except FileNotFoundError as error:
        return str(error)
    return "" if done.returncode == 0 else (done.stderr.strip() or f"exit code {done.returncode}")


class Disk:
    """A tmpfs whose space or whose number of files can be used up to the last but a few."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def leave(self, kind: str, count: int) -> None:
        """Leave so many pages, or so many files, free."""
        self.make_room()
        if kind == "pages":
            with (self.folder / BALLAST).open("wb") as file:
                free = os.statvfs(self.folder).f_bavail * os.statvfs(self.folder).f_frsize
                if free > count * PAGE_BYTES:
                    os.posix_fallocate(file.fileno(), 0, free - count * PAGE_BYTES)
        else:
            used = NODES - os.statvfs(self.folder).f_ffree
            self._remount(f"nr_inodes={used + count}")

    def make_room(self) -> None:
        (self.folder / BALLAST).unlink(missing_ok=True)
        self._remount(f"nr_inodes={NODES}")

    def read_only(self, wanted: bool) -> None:
        self._remount("ro" if wanted else "rw")

    def _remount(self, options: str) -> None:
        said = run("mount", "-o", f"remount,{options}", str(self.folder))
        assert not said, said


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Disk]:
    """Mounted where the fixture `planned` puts its store."""
    folder = tmp_path / "store"
    folder.mkdir()
    options = f"size={SIZE_BYTES},nr_inodes={NODES},mode=0700"
    if said := run("mount", "-t", "tmpfs", "-o", options, "photonfarm-test", str(folder)):
        pytest.skip(f"no tmpfs can be mounted here: {said}")
    # unmounts once its input ends, with the test or with us, however we end; lazily: a worker may still be at it
    undo = ["sh", "-c", 'trap "" INT TERM; read -r _; exec umount --lazy "$0"', str(folder)]
    with subprocess.Popen(undo, stdin=subprocess.PIPE, start_new_session=True) as undoing:
        yield Disk(folder)
    assert undoing.returncode == 0


@pytest.fixture
def scene(disk: Disk, planned: Callable[..., SceneStore]) -> SceneStore:
    """A scene on the disk: six jobs of two samples; base and first job are there."""
    return planned(6)


def render(analytic: ModuleType, scene: SceneStore, job: int) -> bool:
    renderer = ShardRenderer(Store(scene.storage.where), worker="test", load=analytic.AnalyticScene.load)
    return renderer.render(scene.scene_id, job)


def refusal(work: Callable[[], object]) -> StoreError | None:
    """The error that some work ends with, if it does."""
    try:
        work()
    except StoreError as error:
        return error
    return None


def read_all(scene: SceneStore) -> set[int]:
    """The rows that a new reader sees, each read whole."""
    reader = SceneReader(scene.storage.where, scene.scene_id)
    return {reader.read(row).row for row in reader.refresh().tolist()}


def complete(scene: SceneStore) -> set[int]:
    """The rows that a new reader sees."""
    return set(SceneReader(scene.storage.where, scene.scene_id).refresh().tolist())


def parts(scene: SceneStore) -> list[str]:
    """What is in the folder of what is not adopted yet."""
    return [str(path.relative_to(scene.storage.root)) for path in (scene.storage.root / "tmp").rglob("*")]


# ------------------------------------------------------------------------------------------------------------ no worker


@pytest.mark.parametrize("kind", ["pages", pytest.param("files", marks=pytest.mark.slow)])
def test_a_commit_succeeds_as_soon_as_there_is_room_and_shows_nothing_before(
    analytic: ModuleType,
    disk: Disk,
    scene: SceneStore,
    clean_bytes: Callable[[int], dict[str, bytes]],
    stored_bytes: Bytes,
    kind: str,
) -> None:
    """There is room for nothing, then for one page or file more each time: each step of the commit fails in turn."""
    refused = []
    for job in (0, 1):  # the first also writes the base, and makes the markers' folder
        before = read_all(scene)
        for left in range(200):
            disk.leave(kind, left)
            if (error := refusal(lambda job=job: render(analytic, scene, job))) is None:
                break
            refused.append(str(error))
            assert is_full(error), error
            assert str(disk.folder) in str(error)
            assert not scene.is_committed(job)
            assert read_all(scene) == before
            assert parts(scene) == []
        assert scene.is_committed(job)
        assert before < read_all(scene)
    doing = {said.partition("cannot ")[2].partition(":")[0] for said in refused}
    assert {"write the base", "commit job 0", "commit job 1"} <= doing
    disk.make_room()
    for job in scene.missing_jobs():
        assert render(analytic, scene, job)
    assert stored_bytes(scene) == clean_bytes(6)
    assert check_store(Store(disk.folder), when="now").exit_code == 0


@pytest.mark.parametrize("kind", ["pages"])
def test_a_plan_that_finds_no_room_is_not_there_and_is_made_once_there_is(
    analytic: ModuleType, disk: Disk, scene: SceneStore, kind: str
) -> None:
    request = Request(modifications=20, seed=7)
    for left in (0, 1, 5, 10, 20):
        disk.leave(kind, left)
        with pytest.raises(StoreError) as caught:
            Store(disk.folder).plan(analytic.small_spec(), request)
        assert is_full(caught.value)
        assert len(Store(disk.folder).scene(scene.scene_id).plans()) == 1
        assert parts(scene) == []
    disk.make_room()
    result = Store(disk.folder).plan(analytic.small_spec(), request)
    assert (result.plan, result.new) == (1, 20)


@pytest.mark.parametrize("kind", ["files"])
def test_a_repair_that_finds_no_room_to_write_down_what_it_does_moves_nothing(
    analytic: ModuleType, disk: Disk, scene: SceneStore, kind: str
) -> None:
    """It may end at any of its steps; the next one ends what it began, and all of the job's files are somewhere."""
    for job in (0, 1):
        render(analytic, scene, job)
    shard = disk.folder / next(iter(f"{scene.name}/{name}" for name in scene.marker(1)["files"] if "depth" in name))
    shard.write_bytes(b"x" + shard.read_bytes()[1:])
    files = {path.relative_to(disk.folder): path.read_bytes() for path in disk.folder.rglob("*") if path.is_file()}
    seen = []
    for left in range(40):
        disk.leave(kind, left)
        error = refusal(lambda: check_store(Store(disk.folder), when="now", repair=True))
        if error is None:
            break
        assert is_full(error), error
        seen.append(scene.committed_jobs())
        assert {0, 1} <= complete(scene)
    assert seen[0] == {0, 1}
    assert scene.committed_jobs() == {0}
    disk.make_room()
    for name, content in files.items():
        places = [disk.folder / name, *(folder / name for folder in (disk.folder / "quarantine").iterdir())]
        assert content in [place.read_bytes() for place in places if place.exists()]
    assert parts(scene) == []
    for job in scene.missing_jobs():
        assert render(analytic, scene, job)
    assert check_store(Store(disk.folder), when="now").exit_code == 0


def test_a_store_that_is_read_only_refuses_to_be_written_with_a_sentence_and_reads_on(
    analytic: ModuleType, disk: Disk, scene: SceneStore
) -> None:
    render(analytic, scene, 0)
    disk.read_only(True)
    try:
        for work in (
            lambda: render(analytic, scene, 1),
            lambda: Store(disk.folder).plan(analytic.small_spec(), Request(modifications=30)),
            lambda: Store(disk.folder).add(analytic.small_spec(points=17)),
        ):
            with pytest.raises(StoreError) as caught:
                work()
            assert isinstance(caught.value.__cause__, OSError)
            assert caught.value.__cause__.errno == errno.EROFS
            assert not is_full(caught.value)
            assert caught.value.exit_code == 4
        assert len(read_all(scene)) == 2
        assert Store(disk.folder).sweep(stray_age_s=0) == 0
        assert check_store(Store(disk.folder), when="now").exit_code == 0
    finally:
        disk.read_only(False)
    assert render(analytic, scene, 1)


# ----------------------------------------------------------------------------------------------------------- the worker

SHORT_WAIT = """
import runpy, sys
from photonfarm.renderer.worker import backpressure
backpressure.FULL_S = 0.5  # s instead of 30, between tries
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.mark.parametrize("pages", [50], ids=["after some jobs"])
def test_a_worker_waits_for_a_full_disk_says_so_and_goes_on_and_no_job_fails(
    analytic: ModuleType,
    disk: Disk,
    scene: SceneStore,
    clean_bytes: Callable[[int], dict[str, bytes]],
    stored_bytes: Bytes,
    redis_server: EmbeddedRedis,
    tmp_path: Path,
    pages: int,
) -> None:
    log, child = tmp_path / "log", (sys.executable, "-c", SHORT_WAIT, *analytic.command()[1:])
    disk.leave("pages", pages)
    connection = connect(redis_server.url)
    with contextlib.ExitStack() as stack:
        running = stack.enter_context(
            analytic.start_worker(disk.folder, redis_server.url, child, log, until_complete=True)
        )
        stack.callback(running.kill)
        for said, times in [("takes no jobs: the disk is full", 1), ("takes jobs again", 1), ("takes no jobs", 2)]:
            enough = lambda said=said, times=times: log.read_text().count(said) >= times  # noqa: E731
            analytic.wait_for(lambda enough=enough: running.poll() is not None or enough(), 120)
            assert enough(), log.read_text()
        committed = scene.committed_jobs()
        assert bool(committed) == bool(pages)
        assert len(committed) < 6
        complete = scene.progress().committed_samples  # a job may fit where the earlier one with its view does not
        assert len(read_all(scene)) == complete
        assert bool(complete) == bool(pages)
        assert running.poll() is None
        assert queue_status(connection).failed == {}
        disk.make_room()
        assert running.wait(120) == 0
    assert scene.missing_jobs() == []
    assert stored_bytes(scene) == clean_bytes(6)
    assert queue_status(connection).failed == {}
    assert "starting again" not in log.read_text()
    assert "Traceback" not in log.read_text()
    assert parts(scene) == []


def test_a_disk_that_becomes_read_only_ends_a_worker_that_is_at_work_and_loses_nothing(
    analytic: ModuleType, disk: Disk, scene: SceneStore, redis_server: EmbeddedRedis, tmp_path: Path
) -> None:
    """A file system that meets an error does so. It cannot while a part is open for writing: it is tried until then."""
    log = tmp_path / "log"
    with contextlib.ExitStack() as stack:
        running = stack.enter_context(
            analytic.start_worker(disk.folder, redis_server.url, analytic.command(0.3), log, until_complete=True)
        )
        stack.callback(running.kill)
        analytic.wait_for(lambda: len(scene.committed_jobs()) >= 1, 120)
        while run("mount", "-o", "remount,ro", str(disk.folder)):
            assert running.poll() is None
            time.sleep(0.001)
        try:
            assert running.wait(120) == StoreError.exit_code
            committed = scene.committed_jobs()
            assert 1 <= len(committed) < 6
            assert len(read_all(scene)) == 2 * len(committed)
            assert queue_status(connect(redis_server.url)).failed == {}
        finally:
            disk.read_only(False)
    with analytic.start_worker(disk.folder, redis_server.url, analytic.command(), log, until_complete=True) as running:
        assert running.wait(120) == 0
    assert scene.missing_jobs() == []
    assert len(read_all(scene)) == 12


# --------------------------------------------------------------------------------------------------------- not as root


@pytest.mark.skipif(os.geteuid() == 0, reason="root has run the others")
@pytest.mark.timeout(900)
def test_all_of_this_holds_in_a_user_namespace(tmp_path: Path) -> None:
    if said := run("unshare", "-Urm", "mount", "-t", "tmpfs", "photonfarm-test", str(tmp_path)):
        pytest.skip(f"neither root nor a user namespace with mounts: {said}")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--basetemp={tmp_path / 'inner'}"]
    inner = subprocess.run(["unshare", "-Urm", *command, __file__], capture_output=True, text=True)
    assert inner.returncode == 0, inner.stdout
    assert "no tmpfs can be mounted" not in inner.stdout
