"""What the tests of farms that go wrong share."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import ModuleType

import pytest
import redis
from skewed_clock import CLOCK, ENDED_S, MACHINE, Machine

from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.store import SceneStore


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EmbeddedRedis]:
    """A server that a module's tests may do with what they like, one after the other."""
    with EmbeddedRedis(tmp_path_factory.mktemp("redis")) as running:
        connection = redis.Redis.from_url(running.url)
        connection.config_set("appendonly", "no")  # what is oversized need not go to the disk as well
        yield running


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
