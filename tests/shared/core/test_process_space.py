"""Containers may share a host's name: a process number tells nothing of a worker in another one."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import redis

from photonfarm.shared import queue
from photonfarm.shared.core.processes import process_space
from photonfarm.shared.farm.redis_server import EmbeddedRedis

NAME = f"{'ab' * 16}-3"


@pytest.fixture
def connection(tmp_path: Path) -> Iterator[redis.Redis]:
    with EmbeddedRedis(tmp_path / "redis") as running, queue.connect(running.url) as connected:
        yield connected


def gone() -> int:
    """The number of a process that has ended."""
    with subprocess.Popen(["true"]) as ended:
        ended.wait()
    return ended.pid


def test_a_worker_in_another_container_of_the_same_host_name_keeps_its_name_and_its_job(
    connection: redis.Redis,
) -> None:
    """Its process, by a number that nobody has here or that is our own, is alive there."""
    other = f"{os.uname().nodename}-0123abcd4026531836"
    for process in (gone(), os.getpid()):
        queue.beat(connection, "ada", other, NAME, ttl_s=60, process=process)
        assert queue.take_name(connection, "ada", process_space(), os.getpid(), ttl_s=60) == "ada-2"
        assert queue.job_of_worker(connection, "ada") == NAME
        assert connection.exists(queue.ALIVE + NAME)
        queue.bury(connection, "ada-2")


def test_a_worker_that_was_killed_in_this_container_leaves_its_name_at_once(connection: redis.Redis) -> None:
    queue.beat(connection, "ada", process_space(), NAME, ttl_s=60, process=gone())
    assert queue.take_name(connection, "ada", process_space(), os.getpid(), ttl_s=60) == "ada"
    assert not connection.exists(queue.ALIVE + NAME)


def test_a_worker_that_was_killed_here_is_not_counted_while_its_heartbeat_lasts(connection: redis.Redis) -> None:
    queue.beat(connection, "killed", process_space(), NAME, ttl_s=60, process=gone())
    queue.beat(connection, "alive", process_space(), None, ttl_s=60, process=os.getppid())
    queue.beat(connection, "elsewhere", "another-machine", None, ttl_s=60, process=gone())
    assert queue.queue_status(connection).workers == 2


def test_a_process_space_is_the_same_for_every_process_in_it_and_begins_with_the_hosts_name() -> None:
    code = "from photonfarm.shared.core.processes import process_space; print(process_space())"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert told.strip() == process_space()
    assert process_space().startswith(f"{os.uname().nodename}-")
    assert len(process_space().split()) == 1, "a word of the heartbeat"
