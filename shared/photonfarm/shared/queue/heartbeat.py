"""Which workers are alive: keys that Redis drops by its own clock unless they are written again."""

from __future__ import annotations

import os
from dataclasses import dataclass
from itertools import count

from redis import Redis

from photonfarm.shared.core.processes import process_space
from photonfarm.shared.queue.untrusted import beginnings, names_below, remove_lasting

ALIVE = "alive:"
WORKER = "rq:photonfarm:worker:"

HEARTBEAT_MOST_S = 3600
"""A key that lasts longer than this, or for ever, is not the heartbeat of a worker."""

_VALUE_BYTES = 1024


@dataclass(frozen=True, slots=True)
class _Heartbeat:
    host: str  # the supervisor's process space, in which `process` counts
    job: str | None
    process: int  # of the supervisor; 0: unknown


def take_name(connection: Redis, name: str, host: str, process: int, *, ttl_s: float) -> str:
    """Take a name for a worker: this one, or with a number behind it while another worker has it.

    A worker that was killed on this `host`, which is `processes.process_space()`, gives up its name and its job at
    once, not only when its heartbeat expires.
    """
    for number in count(1):
        own = name if number == 1 else f"{name}-{number}"
        remove_lasting(connection, [WORKER + own], HEARTBEAT_MOST_S)
        held = _heartbeat_of(connection, own)
        if held is not None and held.host == host and _is_gone(held.process):
            bury(connection, own)
        if connection.set(WORKER + own, f"{host} - {process}", px=int(ttl_s * 1000), nx=True):
            return own
    raise AssertionError  # count() does not end


def _is_gone(process: int) -> bool:
    """Whether no other process on this machine has that number."""
    if process == os.getpid():  # the number of a predecessor, which has ended
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        return False
    return False


def beat(connection: Redis, worker: str, host: str, name: str | None, *, ttl_s: float, process: int = 0) -> None:
    """Write the heartbeat of a worker on a `host`, as in `take_name`, and of the job that it renders, if any."""
    ttl_ms = int(ttl_s * 1000)  # the server's clock counts it down, not a client's
    with connection.pipeline() as pipeline:
        pipeline.set(WORKER + worker, f"{host} {name or '-'} {process}", px=ttl_ms)
        if name:
            pipeline.set(ALIVE + name, worker, px=ttl_ms)
        pipeline.execute()


def bury(connection: Redis, worker: str) -> str | None:
    """Remove a worker's heartbeat, and free its job at once; returns the job's name."""
    name = free_job(connection, worker)
    connection.delete(WORKER + worker)
    return name


def free_job(connection: Redis, worker: str) -> str | None:
    """Free the job that a worker last reported, so that others can take it; returns its name."""
    name = job_of_worker(connection, worker)
    if name:
        connection.delete(ALIVE + name)
    return name


def job_of_worker(connection: Redis, worker: str) -> str | None:
    """The job that a worker last reported."""
    heartbeat = _heartbeat_of(connection, worker)
    return None if heartbeat is None else heartbeat.job


def _heartbeat_of(connection: Redis, worker: str) -> _Heartbeat | None:
    return _parsed(next(beginnings(connection, [WORKER + worker], _VALUE_BYTES)))


def _parsed(value: str) -> _Heartbeat | None:
    words = value.split()
    if len(words) != 3 or not words[2].isascii() or not words[2].isdecimal() or len(words[2]) > 9:
        return None
    return _Heartbeat(words[0], None if words[1] == "-" else words[1], int(words[2]))


def workers_alive(connection: Redis) -> set[str]:
    """The workers with a heartbeat, except those of this machine whose process has ended since."""
    names = sorted(names_below(connection, WORKER))
    values = beginnings(connection, [WORKER + name for name in names], _VALUE_BYTES)
    return {name for name, held in zip(names, map(_parsed, values), strict=True) if not _has_ended(held)}


def _has_ended(held: _Heartbeat | None) -> bool:
    return held is not None and held.host == process_space() and _is_gone(held.process)


def hosts(connection: Redis) -> set[str]:
    """The hosts, each a process space, that have a live worker."""
    values = beginnings(connection, [WORKER + name for name in names_below(connection, WORKER)], _VALUE_BYTES)
    return {value.split()[0] for value in values if value.strip()}
