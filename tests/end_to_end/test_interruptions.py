"""`photonfarm up` ended in the middle in several ways: nothing stays behind, and started again it goes on."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest


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


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks at processes through /proc")
def interruptible() -> None:
    """A shell starts what it runs in the background deaf to SIGINT, and its children inherit that."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def test_up_stopped_killed_and_robbed_of_its_redis_goes_on_and_leaves_nothing_behind(
    tmp_path: Path, small_room: Path
) -> None:
    def start(modifications: int, steps: int) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "photonfarm.shared.cli", "up", small_room.name, "--shard-rows", "4"]
        command += ["--modifications", str(modifications), "--train-steps", str(steps)]
        return subprocess.Popen(
            command, cwd=tmp_path, stderr=subprocess.DEVNULL, start_new_session=True, preexec_fn=interruptible
        )

    def markers() -> int:
        return len(list(tmp_path.glob("store/scenes/*/committed/*.json")))

    def logged() -> int:
        log = tmp_path / "run/metrics.jsonl"
        return log.stat().st_mtime_ns if log.exists() else 0

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        before = logged()
        farm = start(60, steps=1_000_000)
        wait_until(lambda earlier=before: logged() > earlier)  # the trainer is at work
        farm.send_signal(number)
        farm.wait(150)  # a busy machine compiles kernels for a minute, and a worker ends its job first
        assert farm.returncode != 0
        wait_until(lambda: not processes_in(tmp_path), 60)

    so_far = [json.loads(line)["step"] for line in (tmp_path / "run/metrics.jsonl").read_text().splitlines()]
    committed = markers()
    farm = start(200, steps=max(so_far) + 200)
    wait_until(lambda: markers() > committed)
    (redis,) = processes_in(tmp_path / "run/redis")
    os.kill(redis, signal.SIGKILL)
    assert farm.wait(300) == 0
    assert markers() == 100
    assert json.loads((tmp_path / "out/report.json").read_text())["train_steps"] == max(so_far) + 200
    assert not processes_in(tmp_path)
