"""Who is alive: keys that Redis drops by its own clock unless they are written again."""

from __future__ import annotations

from collections.abc import Iterable

from redis import Redis
from rq.utils import as_text

ALIVE = "alive:"
WORKER = "rq:photonfarm:worker:"
_VALUE_BYTES = 1024


def beat(connection: Redis, worker: str, host: str, name: str | None, *, ttl_s: float) -> None:
    """Say for a time that a worker is alive, and the job that it renders, if any."""
    ttl_ms = int(ttl_s * 1000)  # the server's clock counts it down, not a client's
    with connection.pipeline() as pipeline:
        pipeline.set(WORKER + worker, f"{host} {name or '-'}", px=ttl_ms)
        if name:
            pipeline.set(ALIVE + name, worker, px=ttl_ms)
        pipeline.execute()


def bury(connection: Redis, worker: str) -> str | None:
    """Free at once the job that a worker of this name died with, instead of when its heartbeat runs out; its name."""
    name = job_of_worker(connection, worker)
    connection.delete(WORKER + worker, *([ALIVE + name] if name else []))
    return name


def job_of_worker(connection: Redis, worker: str) -> str | None:
    """The job that a worker last said to render."""
    words = _words(connection, WORKER + worker)
    return words[1] if len(words) == 2 and words[1] != "-" else None


def hosts(connection: Redis) -> set[str]:
    """The hosts that have a worker alive."""
    return {words[0] for key in names_below(connection, WORKER) if (words := _words(connection, WORKER + key))}


def _words(connection: Redis, key: str) -> list[str]:
    return as_text(connection.getrange(key, 0, _VALUE_BYTES)).split()


def names_below(connection: Redis, prefix: str) -> set[str]:
    """What follows a prefix in the keys that have it."""
    keys: Iterable[bytes] = connection.scan_iter(f"{prefix}*", count=1000)
    return {key.decode(errors="replace").removeprefix(prefix) for key in keys}
