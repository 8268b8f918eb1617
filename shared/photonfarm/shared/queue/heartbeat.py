"""Who is alive: keys that Redis drops by its own clock unless they are written again."""

from __future__ import annotations

from redis import Redis

from photonfarm.shared.queue.untrusted import beginnings, names_below

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
    words = next(beginnings(connection, [WORKER + worker], _VALUE_BYTES)).split()
    return words[1] if len(words) == 2 and words[1] != "-" else None


def hosts(connection: Redis) -> set[str]:
    """The hosts that have a worker alive."""
    said = beginnings(connection, [WORKER + name for name in names_below(connection, WORKER)], _VALUE_BYTES)
    return {value.split()[0] for value in said if value.strip()}
