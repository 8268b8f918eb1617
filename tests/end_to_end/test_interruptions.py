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
def test_up_stopped_killed_and_robbed_of_its_redis_goes_on_and_leaves_nothing_behind(
    tmp_path: Path, small_room: Path
) -> None:
    command = [sys.executable, "-m", "photonfarm.shared.cli", "up", small_room.name, "--workers", "2"]
    command += ["--modifications", "60", "--views", "2", "--shard-rows", "4", "--train-steps", "120"]

    def start() -> subprocess.Popen[bytes]:
        return subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.DEVNULL, start_new_session=True)

    def markers() -> set[Path]:
        return set(tmp_path.glob("store/scenes/*/committed/*.json"))

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        before = len(markers())
        farm = start()
        wait_until(lambda least=before: len(markers()) > least)
        farm.send_signal(number)
        farm.wait(60)
        assert farm.returncode != 0
        wait_until(lambda: not processes_in(tmp_path), 60)

    before = markers()
    farm = start()
    wait_until(lambda: len(markers()) > len(before))
    (redis,) = processes_in(tmp_path / "run/redis")
    os.kill(redis, signal.SIGKILL)
    assert farm.wait(300) == 0
    assert len(markers()) == 30
    assert json.loads((tmp_path / "out/report.json").read_text())["train_steps"] == 120
    assert not processes_in(tmp_path)
