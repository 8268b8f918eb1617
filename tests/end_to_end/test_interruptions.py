"""Farm and worker ended in the middle in several ways: nothing stays behind, and started again the farm goes on."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.farm.submission import submit
from photonfarm.plan.request import Request
from photonfarm.scene.spec_loading import NamedSpec
from photonfarm.store import SceneStore, Store

pytestmark = [
    pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks at processes through /proc"),
]


def processes_in(folder: Path) -> dict[int, str]:
    """Command lines of all processes that run in a folder or below it, by process id."""
    found = {}
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if (process / "cwd").resolve().is_relative_to(folder.resolve()):
                found[int(process.name)] = (process / "cmdline").read_text().replace("\0", " ")
        except OSError:
            continue  # ended meanwhile
    return found


def wait_until(reached: Callable[[], object], seconds: float = 120) -> None:
    deadline = time.monotonic() + seconds
    while not reached():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.1)


def interruptible() -> None:
    """A shell starts what it runs in the background deaf to SIGINT, and its children inherit that."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.slow
def test_up_stopped_killed_and_robbed_of_its_redis_goes_on_and_leaves_nothing_behind(
    tmp_path: Path, small_room: Path
) -> None:
    def start(modifications: int, steps: int) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "photonfarm.cli", "up", small_room.name, "--shard-rows", "4"]
        command += ["--modifications", str(modifications), "--train-steps", str(steps), "--workers", "1"]
        return subprocess.Popen(
            command, cwd=tmp_path, stderr=subprocess.DEVNULL, start_new_session=True, preexec_fn=interruptible
        )

    def markers() -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in tmp_path.glob("store/scenes/*/committed/*.json")}

    def logged() -> int:
        log = tmp_path / "run/metrics.jsonl"
        return log.stat().st_mtime_ns if log.exists() else 0

    (tmp_path / "photonfarm.toml").write_text("[report]\nuntimed = true\n")  # its report may cost less
    for number, code in ((signal.SIGINT, 130), (signal.SIGKILL, -signal.SIGKILL)):
        before = logged()
        farm = start(40, steps=1_000_000)
        wait_until(lambda earlier=before: logged() > earlier)  # the trainer is at work
        farm.send_signal(number)
        assert farm.wait(150) == code  # a busy machine compiles kernels for a minute, and a worker ends its job first
        wait_until(lambda: not processes_in(tmp_path), 60)

    so_far = [json.loads(line)["step"] for line in (tmp_path / "run/metrics.jsonl").read_text().splitlines()]
    committed = markers()
    farm = start(80, steps=max(so_far) + 50)
    wait_until(lambda: len(markers()) > len(committed))
    (redis,) = processes_in(tmp_path / "run/redis")
    os.kill(redis, signal.SIGKILL)
    assert farm.wait(300) == 0
    assert len(markers()) == 40
    assert committed.items() <= markers().items(), "what was committed is not rendered again"
    assert json.loads((tmp_path / "out/report.json").read_text())["runs"][0]["steps"] == max(so_far) + 50
    assert not processes_in(tmp_path)


DOCKER_S = 10  # from its SIGTERM to its SIGKILL


@pytest.fixture
def endless_room(small_room: Path) -> Path:
    """`small_room` with as many samples per pixel as there may be: native code that is busy for minutes."""
    small_room.write_text(re.sub(r"(?m)^half_spp = .*$", "half_spp = 65536", small_room.read_text()))
    return small_room


def started(folder: Path, *verb: str, **environment: str) -> subprocess.Popen[bytes]:
    """A verb in a folder, with what it says in the file `said`."""
    with (folder / "said").open("wb") as said:
        return subprocess.Popen(
            [sys.executable, "-m", "photonfarm.cli", *verb],
            cwd=folder,
            stderr=said,
            start_new_session=True,
            preexec_fn=interruptible,
            env=os.environ | environment,
        )


def wait_for_native_code(folder: Path) -> None:
    """The base is written right before the first sample is rendered."""
    wait_until(lambda: list(folder.glob("store/scenes/*/base/zarr.json")))
    time.sleep(1)


def assert_nothing_is_torn(folder: Path) -> None:
    (scene,) = Store(folder / "store").scenes()
    assert isinstance(scene, SceneStore)
    assert scene.has_base()
    assert scene.committed_jobs() == set()
    assert not [file for file in scene.folder.glob("plans/*/*/c.*") if file.parent.name in ("radiance", "depth")]


@pytest.mark.parametrize(
    ("signals", "code", "within_s"),
    [
        pytest.param([signal.SIGTERM], 143, DOCKER_S, marks=pytest.mark.slow),
        ([signal.SIGINT, signal.SIGINT], 130, 4),
    ],
)
def test_up_in_the_middle_of_a_long_job_ends_within_seconds_and_without_a_trace(
    tmp_path: Path, endless_room: Path, signals: list[signal.Signals], code: int, within_s: float
) -> None:
    options = ("--modifications", "8", "--views", "1", "--shard-rows", "4", "--hold-out", "0.5", "--workers", "1")
    farm = started(tmp_path, "up", endless_room.name, *options)
    wait_for_native_code(tmp_path)
    told = time.monotonic()
    for number in signals:
        farm.send_signal(number)
        time.sleep(0.5)
    assert farm.wait(60) == code
    assert time.monotonic() - told < within_s
    assert not processes_in(tmp_path)
    said = (tmp_path / "said").read_text()
    assert said.count("stopping; a job in hand that is not nearly done will be rendered again") == 1
    for log in (tmp_path / "said", *(tmp_path / "run").glob("*.log")):
        assert "Traceback" not in log.read_text()
    assert_nothing_is_torn(tmp_path)


@pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, marks=pytest.mark.slow), signal.SIGTERM])
def test_work_in_the_middle_of_a_long_job_ends_within_seconds_and_without_a_trace(
    tmp_path: Path, endless_room: Path, number: signal.Signals
) -> None:
    with EmbeddedRedis(tmp_path / "redis") as redis:
        submit(NamedSpec.load(str(endless_room)), tmp_path / "store", redis.url, Request(modifications=4))
        worker = started(tmp_path, "work", PHOTONFARM_REDIS_URL=redis.url)
        wait_for_native_code(tmp_path)
        told = time.monotonic()
        worker.send_signal(number)
        assert worker.wait(60) == 0
        assert time.monotonic() - told < DOCKER_S
        assert processes_in(tmp_path).keys() == {redis.pid}
    said = (tmp_path / "said").read_text()
    assert said.count("stopping; a job in hand that takes longer than 5 s will be rendered again") == 1
    assert "Traceback" not in said
    assert_nothing_is_torn(tmp_path)
