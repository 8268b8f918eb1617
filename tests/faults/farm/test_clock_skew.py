"""Machines whose clocks differ by a year: nothing is lost, numbered or ordered by what a machine takes for the time.

A machine with a wrong clock is a process whose C library tells another time: time namespaces leave the time of day
alone, so that a few lines of C are loaded before it, which Python, Redis' client, RQ and Zarr all ask, and not only
those that call `time.time`. Files are stamped by the file system, whose clock is right, as a file server's would be.
"""

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import store_samples as samples

from photonfarm.shared.farm.redis_server import EmbeddedRedis
from photonfarm.shared.queue import beat, connect, hosts, queue_status, reconcile
from photonfarm.shared.store import SceneReader, SceneStore, Store
from photonfarm.shared.store.check.check import check_store
from photonfarm.shared.store.io.storage import FOREIGN_AGE_S, STRAY_AGE_S

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="loads a library before a process's own")

YEAR_S = 365 * 86400
ENDED_S = 60.0  # for a process to end that nobody talks to any more
SKEWS = pytest.mark.parametrize("skew_s", [YEAR_S, -YEAR_S], ids=["a year ahead", "a year behind"])

CLOCK = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdlib.h>
#include <sys/time.h>
#include <time.h>

static long skew(void) { const char *told = getenv("CLOCK_SKEW_S"); return told ? atol(told) : 0; }

int clock_gettime(clockid_t clock, struct timespec *now) {
    static int (*plain)(clockid_t, struct timespec *);
    if (!plain) plain = dlsym(RTLD_NEXT, "clock_gettime");
    int result = plain(clock, now);
    if (!result && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE)) now->tv_sec += skew();
    return result;
}

int gettimeofday(struct timeval *restrict now, void *restrict zone) {
    struct timespec precise;
    int result = clock_gettime(CLOCK_REALTIME, &precise);
    now->tv_sec = precise.tv_sec;
    now->tv_usec = precise.tv_nsec / 1000;
    return result;
}

time_t time(time_t *now) {
    struct timespec precise;
    clock_gettime(CLOCK_REALTIME, &precise);
    if (now) *now = precise.tv_sec;
    return precise.tv_sec;
}
"""

MACHINE = """
import contextlib, io, json, sys, traceback
from pathlib import Path
from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.shared.plan.request import Request
from photonfarm.shared.queue import beat, connect, queue_status, reconcile
from photonfarm.shared.store import Store
from photonfarm.shared.store.check.check import check_store
from photonfarm.shared.plan.top_up import TopUp
sys.path.append(sys.argv[1])
import analytic_scene as analytic

names = dict(globals())
for line in sys.stdin:
    code, root, url = json.loads(line)
    said, error = io.StringIO(), ""
    try:
        with contextlib.redirect_stdout(said):
            exec(code, {**names, "root": root, "url": url, "store": Store(root)})
    except Exception:
        error = traceback.format_exc()
    print(json.dumps([said.getvalue().strip(), error]), flush=True)
"""


@pytest.fixture(scope="module")
def clock(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The library that tells another time."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        pytest.skip("no C compiler, of which a wrong clock is made")
    folder = tmp_path_factory.mktemp("clock")
    (folder / "clock.c").write_text(CLOCK)
    subprocess.run(
        [compiler, "-shared", "-fPIC", "-O1", "-o", folder / "clock.so", folder / "clock.c", "-ldl"], check=True
    )
    return folder / "clock.so"


Machine = Callable[..., str]


@pytest.fixture(scope="module")
def machine(clock: Path, analytic: ModuleType) -> Iterator[Machine]:
    """Function (skew in seconds, store, code, URL of Redis) → what the code prints on the machine with that skew."""
    machines: dict[int, subprocess.Popen[str]] = {}

    def started(skew_s: int) -> subprocess.Popen[str]:
        told = os.environ | {"LD_PRELOAD": str(clock), "CLOCK_SKEW_S": str(skew_s)}
        command = [sys.executable, "-c", MACHINE, str(analytic.FOLDER)]
        return subprocess.Popen(command, env=told, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE)

    def at(skew_s: int, root: Path, code: str, url: str = "") -> str:
        if skew_s not in machines:
            machines[skew_s] = started(skew_s)
        talk = machines[skew_s]
        assert talk.stdin is not None
        assert talk.stdout is not None
        with suppress(BrokenPipeError):  # it has ended: there is no line then
            talk.stdin.write(json.dumps([code, str(root), url]) + "\n")
            talk.stdin.flush()
        line = talk.stdout.readline()
        assert line, f"the machine {skew_s} s off has ended by itself, with return code {talk.wait(ENDED_S)}"
        said, error = json.loads(line)
        assert not error, error
        return str(said)

    try:
        yield at
        for process in machines.values():
            process.communicate(timeout=ENDED_S)  # closes what it listens to, which ends it
        assert {skew_s: process.returncode for skew_s, process in machines.items()} == dict.fromkeys(machines, 0)
    finally:
        for process in machines.values():
            with process:  # waits
                process.kill()


@pytest.fixture
def scene(planned: Callable[..., SceneStore]) -> SceneStore:
    """Four jobs of two samples."""
    return planned(4)


def root_of(scene: SceneStore) -> Path:
    return scene.folder.parent.parent


def rows_read(scene: SceneStore) -> list[int]:
    reader = SceneReader(root_of(scene), scene.scene_id)
    return [reader.read(row).row for row in reader.refresh().tolist()]


@SKEWS
def test_the_clock_of_such_a_machine_is_wrong_for_all_that_ask_it(
    machine: Machine, tmp_path: Path, skew_s: int
) -> None:
    """The other tests show nothing unless this holds."""
    Store(tmp_path / "store", create=True)
    code = """
import time, datetime, os
now = [time.time(), time.time_ns() / 1e9, datetime.datetime.now(datetime.UTC).timestamp()]
path = Path(root) / "stamped"
path.touch()
print(*now, path.stat().st_mtime)
"""
    *told, stamped = map(float, machine(skew_s, tmp_path / "store", code).split())
    assert np.abs(np.array(told) - time.time() - skew_s).max() < 60
    assert abs(stamped - time.time()) < 60


# --------------------------------------------------------------------------------------------------------------- sweeps


@SKEWS
def test_a_sweep_by_a_machine_with_a_wrong_clock_leaves_what_living_writers_need(
    machine: Machine, scene: SceneStore, skew_s: int
) -> None:
    """A job here, in the middle of its rows, and parts of other machines: all fresh, by the file system's clock."""
    given = samples.outputs(scene, 0)
    mine = scene.storage.part()
    foreign = mine.with_name("another-machine-1a2b3c4d5e-17-0-0.partial")
    folder = mine.with_name("another-machine-1a2b3c4d5e-17-1-0.partial")  # a plan, on its way
    foreign.write_bytes(b"half a file")
    folder.mkdir()
    with scene.job_writer(0) as out:
        for row, photons in given.photons.items():
            out.photons(row, photons)
        for row, buffers in given.buffers.items():
            out.view(row, buffers, given.visibility[row])
        first, *others = given.radiance
        out.radiance(first, given.radiance[first])
        assert machine(skew_s, root_of(scene), "print(store.sweep(), store.sweep(stray_age_s=0))") == "0 0"
        for row in others:
            out.radiance(row, given.radiance[row])
        assert out.commit(samples.FIGURES)
    assert foreign.exists()
    assert folder.exists()
    assert len(rows_read(scene)) == 2


@SKEWS
def test_a_sweep_by_a_machine_with_a_wrong_clock_takes_what_is_old_by_the_file_systems(
    machine: Machine, scene: SceneStore, skew_s: int
) -> None:
    mine = scene.storage.part()
    dead = mine.with_name(mine.name.replace(f"-{os.getpid()}-", "-4194999-"))  # no process has this number
    foreign = mine.with_name("another-machine-1a2b3c4d5e-17-0-0.partial")
    ages = {dead: STRAY_AGE_S, foreign: FOREIGN_AGE_S}
    for path, age_s in ages.items():
        path.write_bytes(b"half a file")
        os.utime(path, (0, time.time() - age_s + 30))
    assert machine(skew_s, root_of(scene), "print(store.sweep())") == "0"
    for path, age_s in ages.items():
        os.utime(path, (0, time.time() - age_s - 1))
    assert machine(skew_s, root_of(scene), "print(store.sweep())") == "2"


@pytest.mark.parametrize("ahead_s", [1, 3600, YEAR_S])
def test_a_part_whose_stamp_lies_in_the_future_is_left_until_that_is_past(scene: SceneStore, ahead_s: int) -> None:
    """Some file systems let machines stamp their files themselves; a negative age is not taken for a great one."""
    mine = scene.storage.part()
    foreign = mine.with_name("another-machine-1a2b3c4d5e-17-0-0.partial")
    dead = mine.with_name(mine.name.replace(f"-{os.getpid()}-", "-4194999-"))
    for path in (mine, foreign, dead):
        path.write_bytes(b"half a file")
        os.utime(path, (0, time.time() + ahead_s + 30))
    assert scene.storage.sweep() == 0
    for path in (mine, foreign, dead):
        os.utime(path, (0, time.time() - STRAY_AGE_S - 1))
    assert scene.storage.sweep() == 1
    assert not dead.exists()


@pytest.mark.parametrize("hours", [1, 12, 23])
def test_a_part_stamped_by_a_machine_that_is_hours_behind_is_left_to_its_writer(scene: SceneStore, hours: int) -> None:
    """This holds up to a day, the documented age: clocks of one farm differ by less, or its stamps are the server's."""
    given = samples.outputs(scene, 0)
    with scene.job_writer(0) as out:
        for row, photons in given.photons.items():
            out.photons(row, photons)
        for row, buffers in given.buffers.items():
            out.view(row, buffers, given.visibility[row])
        for row, halves in given.radiance.items():
            out.radiance(row, halves)
        foreign = scene.storage.part().with_name("another-machine-1a2b3c4d5e-17-0-0.partial")
        foreign.write_bytes(b"half a file")
        for path in (root_of(scene) / "tmp").iterdir():
            os.utime(path, (0, time.time() - hours * 3600))
        assert Store(root_of(scene)).sweep(stray_age_s=0) == 0
        assert foreign.exists()
        assert out.commit(samples.FIGURES)


# ---------------------------------------------------------------------------------------------- commits, plans, repairs

RENDER = """
store.scenes()[0]
renderer = ShardRenderer(store, worker="elsewhere", load=analytic.AnalyticScene.load)
print(*[renderer.render(store.scene_ids()[0], job) for job in {jobs}])
"""


def test_jobs_of_machines_a_year_apart_are_all_committed_once_and_are_what_one_machine_renders(
    machine: Machine,
    scene: SceneStore,
    clean_bytes: Callable[[int], dict[str, bytes]],
    stored_bytes: Callable[[SceneStore], dict[str, bytes]],
) -> None:
    root = root_of(scene)
    reader = SceneReader(root, scene.scene_id)
    assert machine(YEAR_S, root, RENDER.format(jobs=[0, 2])) == "True True"
    assert reader.refresh().size == 4
    assert machine(-YEAR_S, root, RENDER.format(jobs=[2, 1, 0])) == "False True False"
    assert reader.refresh().size == 2
    assert machine(0, root, RENDER.format(jobs=[1, 3])) == "False True"
    assert reader.refresh().size == 2
    assert stored_bytes(scene) == clean_bytes(4)
    assert check_store(Store(root), when="now").exit_code == 0


def test_what_is_committed_is_the_same_whatever_the_stamps_of_its_files_are(scene: SceneStore) -> None:
    """A marker older than its files, or than its plan, and all of them older or younger than now."""
    samples.commit_all(scene)
    scene.write_base(*_base(scene))
    before = rows_read(scene)
    files = [path for path in root_of(scene).rglob("*") if path.is_file()]
    for i, order in enumerate([files, list(reversed(files))]):
        for n, path in enumerate(order):
            os.utime(path, (0, time.time() + (n - len(files) / 2) * 86400 * (i + 1)))
        assert Store(root_of(scene)).scene(scene.scene_id).missing_jobs() == []
        assert rows_read(scene) == before
        assert check_store(Store(root_of(scene)), when="now", repair=True).exit_code == 0
        assert Store(root_of(scene)).sweep() == 0


def _base(scene: SceneStore) -> Any:
    geometry, cloud = samples.base()
    return geometry, type(cloud)(**{f: np.resize(getattr(cloud, f), _shape(cloud, f, scene)) for f in cloud.__slots__})


def _shape(cloud: Any, name: str, scene: SceneStore) -> tuple[int, ...]:
    return (scene.spec.points, *getattr(cloud, name).shape[1:])


def test_plans_of_machines_a_year_apart_are_numbered_in_their_order_and_plan_nothing_twice(
    machine: Machine, scene: SceneStore
) -> None:
    root = root_of(scene)
    code = "asked = Request(modifications={n}, views_per_modification=2, passes=2)\n"
    code += "done = store.plan(analytic.small_spec(), asked)\nprint(done.plan, done.new, done.known)"
    told = [machine(skew_s, root, code.format(n=n)) for n, skew_s in [(4, YEAR_S), (6, -YEAR_S), (5, YEAR_S), (7, 0)]]
    assert told == ["1 8 8", "2 8 16", "None 0 20", "3 4 24"]
    top_up = "print(store.scenes()[0].plan(TopUp.of('+1', ['views=first:1'])).plan)"
    assert [machine(skew_s, root, top_up) for skew_s in (-YEAR_S, YEAR_S)] == ["4", "5"]
    plans = Store(root).scene(scene.scene_id).plans()
    assert [plan.number for plan in plans] == list(range(6))
    assert [plan.first_job for plan in plans[1:]] == [plan.end_job for plan in plans[:-1]]
    keys = np.concatenate([plan.rows.sample_key[plan.rows.sample_pass >= 0] for plan in plans])
    assert len(np.unique(keys, axis=0)) == len(keys) == 28 + 2


def test_repairs_of_machines_a_year_apart_are_numbered_in_their_order_and_lose_nothing(
    machine: Machine, scene: SceneStore
) -> None:
    root = root_of(scene)
    machine(0, root, RENDER.format(jobs=[0, 1, 2, 3]))
    repair = "print(check_store(store, when='then', repair=True).quarantine)"
    for number, (skew_s, job) in enumerate([(YEAR_S, 1), (-YEAR_S, 1), (0, 2)]):
        file = scene.folder / next(name for name in scene.marker(job)["files"] if "depth" in name)
        content = b"x" + file.read_bytes()[1:]
        file.write_bytes(content)
        assert machine(skew_s, root, repair) == f"quarantine/{number:06d}"
        assert (root / f"quarantine/{number:06d}" / file.relative_to(root)).read_bytes() == content
        assert machine(-skew_s, root, RENDER.format(jobs=[job])) == "True"
    assert len(rows_read(scene)) == 8


# ---------------------------------------------------------------------------------------------------------------- Redis


@SKEWS
def test_a_heartbeat_ends_by_the_servers_clock(
    machine: Machine, scene: SceneStore, redis_server: EmbeddedRedis, skew_s: int
) -> None:
    connection = connect(redis_server.url)
    code = "beat(connect(url), 'ada', 'elsewhere', 'a-job', ttl_s={ttl_s})"
    machine(skew_s, root_of(scene), code.format(ttl_s=60), redis_server.url)
    assert hosts(connection) == {"elsewhere"}
    left_ms = [connection.pttl(key) for key in connection.keys("*") if b"a-job" in key or b"ada" in key]
    assert len(left_ms) == 2
    assert all(30_000 < left <= 60_000 for left in left_ms)
    machine(skew_s, root_of(scene), code.format(ttl_s=0.2), redis_server.url)
    time.sleep(0.3)
    assert hosts(connection) == set()


@SKEWS
def test_who_is_alive_here_is_alive_for_a_machine_with_a_wrong_clock_and_who_is_dead_is_dead(
    machine: Machine, scene: SceneStore, redis_server: EmbeddedRedis, skew_s: int
) -> None:
    """Its reconciliation queues again what nobody renders, and nothing else."""
    connection, url = connect(redis_server.url), redis_server.url
    assert reconcile(Store(root_of(scene)), connection) == 4
    queued = machine(skew_s, root_of(scene), "print(reconcile(store, connect(url)))", url)
    assert queued == "0"
    connection.flushall()
    beat(connection, "ada", "here", f"{scene.scene_id}-1", ttl_s=60)
    beat(connection, "bob", "here", f"{scene.scene_id}-2", ttl_s=0.1)
    time.sleep(0.2)
    assert machine(skew_s, root_of(scene), "print(reconcile(store, connect(url)))", url) == "3"
    told = machine(skew_s, root_of(scene), "print(queue_status(connect(url)).workers)", url)
    assert told == "1"


@pytest.fixture
def skewed_worker(
    clock: Path, analytic: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    """`analytic_scene.start_worker` with a skew; all of them are ended with the test."""
    started = []

    def start(skew_s: int, *arguments: Any, **settings: Any) -> subprocess.Popen[bytes]:
        with monkeypatch.context() as changed:
            changed.setenv("LD_PRELOAD", str(clock))
            changed.setenv("CLOCK_SKEW_S", str(skew_s))
            started.append(analytic.start_worker(*arguments, **settings))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.wait()


@pytest.mark.slow
def test_workers_a_year_apart_share_a_queue_and_one_that_dies_is_replaced(
    analytic: ModuleType,
    planned: Callable[..., SceneStore],
    skewed_worker: Callable[..., subprocess.Popen[bytes]],
    clean_bytes: Callable[[int], dict[str, bytes]],
    stored_bytes: Callable[[SceneStore], dict[str, bytes]],
    redis_server: EmbeddedRedis,
    tmp_path: Path,
) -> None:
    scene = planned(16)
    root, connection = root_of(scene), connect(redis_server.url)
    logs = {skew_s: tmp_path / f"log{skew_s}" for skew_s in (YEAR_S, -YEAR_S)}
    running = [
        skewed_worker(
            skew_s, root, redis_server.url, analytic.command(0.1), log, until_complete=True, name=f"worker{skew_s}"
        )
        for skew_s, log in logs.items()
    ]
    analytic.wait_for(lambda: len(_workers(scene)) == 2, 120)
    os.kill(analytic.child_of(running[0]), 9)
    assert [process.wait(240) for process in running] == [0, 0]
    assert scene.missing_jobs() == []
    assert queue_status(connection).failed == {}
    Store(root).sweep(stray_age_s=0)
    assert stored_bytes(scene) == clean_bytes(16)
    assert len(rows_read(scene)) == 32
    times = [json.loads(path.read_bytes())["figures"]["wall_s"] for path in (scene.folder / "committed").iterdir()]
    assert all(0 < seconds < 60 for seconds in times), "a job's seconds are those of a clock that runs evenly"


def _workers(scene: SceneStore) -> set[str]:
    return {scene.marker(job)["figures"]["worker"] for job in scene.committed_jobs()}
