"""Why workers are idle, as they report it: they take no jobs, or skip a scene.

A report is written with every heartbeat and expires with it. It is text for people: no decision depends on it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from redis import Redis

from photonfarm.shared.queue.untrusted import beginnings, names_below, printable

PAUSED = "rq:photonfarm:paused:"
LEFT = "rq:photonfarm:left:"
REASON_LETTERS = 500

_SCENE_AND_WORKER = re.compile("([0-9a-f]{32}):(.+)", re.DOTALL)


@dataclass(frozen=True, slots=True)
class IdleReports:
    """The workers' reports, by name; printable."""

    paused: dict[str, str]  # why a worker takes no jobs
    left: dict[str, dict[str, str]]  # by scene id, then by worker: why it skips the scene


def report_idle(connection: Redis, worker: str, paused: str | None, left: Mapping[str, str], *, ttl_s: float) -> None:
    """Report why a worker takes no jobs, if it takes none, and which scenes it skips; expires after `ttl_s`."""
    ttl_ms = int(ttl_s * 1000)
    with connection.pipeline(transaction=False) as pipeline:
        if paused is None:
            pipeline.delete(PAUSED + worker)
        else:
            pipeline.set(PAUSED + worker, paused[:REASON_LETTERS], px=ttl_ms)
        for scene_id, reason in left.items():
            pipeline.set(f"{LEFT}{scene_id}:{worker}", reason[:REASON_LETTERS], px=ttl_ms)
        pipeline.execute()


def clear_idle_report(connection: Redis, worker: str, left: Iterable[str]) -> None:
    """Remove the reports of a worker: it takes jobs again, and skips none of these scenes."""
    connection.delete(PAUSED + worker, *(f"{LEFT}{scene_id}:{worker}" for scene_id in left))


def read_idle_reports(connection: Redis) -> IdleReports:
    """The reports that workers have made."""
    left: dict[str, dict[str, str]] = {}
    for name, reason in _reports(connection, LEFT).items():
        if found := _SCENE_AND_WORKER.fullmatch(name):
            left.setdefault(found[1], {})[printable(found[2])] = reason
    return IdleReports({printable(name): reason for name, reason in _reports(connection, PAUSED).items()}, left)


def _reports(connection: Redis, prefix: str) -> dict[str, str]:
    names = sorted(names_below(connection, prefix))
    reasons = beginnings(connection, [prefix + name for name in names], 4 * REASON_LETTERS)
    return {name: printable(reason)[:REASON_LETTERS] for name, reason in zip(names, reasons, strict=True) if reason}
