"""Containers may share a host's name: a process number tells nothing of a worker in another one."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import queue_samples
import redis

from photonfarm.core.processes import process_space
from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.queue.connection import connect
from photonfarm.queue.workers import WorkerReport, bury, read_workers, take_name


@pytest.fixture
def connection(tmp_path: Path) -> Iterator[redis.Redis]:
    with EmbeddedRedis(tmp_path / "redis") as running, connect(running.url) as connected:
        yield connected


def gone() -> int:
    """The number of a process that has ended."""
    with subprocess.Popen(["true"]) as ended:
        ended.wait()
    return ended.pid


def test_a_worker_in_another_container_of_the_same_host_name_keeps_its_name(
    connection: redis.Redis,
) -> None:
    """Its process, by a number that nobody has here or that is our own, is alive there."""
    other = f"{os.uname().nodename}-0123abcd4026531836"
    for process in (gone(), os.getpid()):
        queue_samples.told(connection, "ada", WorkerReport(host=other, process=process))
        assert take_name(connection, "ada", ttl_s=60) == "ada-2"
        assert list(read_workers(connection)) == ["ada", "ada-2"]
        bury(connection, "ada-2")


def test_a_process_space_is_the_same_for_every_process_in_it_and_begins_with_the_hosts_name() -> None:
    code = "from photonfarm.core.processes import process_space; print(process_space())"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert told.strip() == process_space()
    assert process_space().startswith(f"{os.uname().nodename}-")
    assert len(process_space().split()) == 1, "a word of the heartbeat"
