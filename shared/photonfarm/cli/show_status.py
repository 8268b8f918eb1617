"""What `photonfarm status` prints: tables for people, JSON for programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from photonfarm.cli.show import print_json, print_table
from photonfarm.core.waiting import format_span
from photonfarm.farm.running_farm import RunningFarm
from photonfarm.farm.status import RECENT_S, NoQueue, StoreQueue, idle, lost_plan, unread_markers
from photonfarm.farm.training import TrainingProgress
from photonfarm.store import SceneStatus

if TYPE_CHECKING:
    from photonfarm.queue import FailureCause


def document(
    scenes: Sequence[SceneStatus],
    found: StoreQueue | NoQueue,
    store: str | Path,
    running: RunningFarm | None,
    trainings: Sequence[TrainingProgress],
) -> None:
    """Print a store's scenes, its queue, or why nothing is known of it, and trainings as JSON."""
    document = None if isinstance(found, NoQueue) else _queue_document(found, store)
    reason = found.reason if isinstance(found, NoQueue) else None
    print_json(
        {
            "scenes": [asdict(scene) for scene in scenes],
            "queue": document,
            "no_queue": reason,
            "kept_failures": _failures_document(found.kept, store),
            "trainings": [asdict(training) for training in trainings],
            "up": None if running is None else asdict(running),
        }
    )


def scenes(found: Sequence[SceneStatus]) -> None:
    """Print a table of a store's scenes."""
    print_table(
        (
            (
                s.name,
                s.scene_id,
                f"{s.samples_complete}/{s.samples_planned}",
                f"{s.jobs_committed}/{s.jobs_planned}",
                f"{s.size_bytes / 1e6:.1f} MB",
                f"{s.core_s:.0f} s",
                str(s.redrawn),
            )
            for s in found
            if not s.error
        ),
        ("scene", "id", "samples", "jobs", "size", "core time", "redrawn"),
    )
    for s in found:
        unread = f"cannot be read: {s.error}" if s.error else ""
        for message in filter(None, (unread, unread_markers(s), lost_plan(s))):
            click.echo(f"{s.name} {s.scene_id}: {message}")
    click.echo()


def queue(
    found: StoreQueue | NoQueue,
    scenes: Sequence[SceneStatus],
    store: str | Path,
    running: RunningFarm | None,
    *,
    named_redis: bool,
    since_commit_s: float | None = None,
) -> None:
    """Print what the queue of a store with these scenes holds, or why nothing is known of it.

    Unless a user has `named_redis`, a store without one is nothing to worry about. `since_commit_s` is the time since a
    job was committed, if that is known.
    """
    if running is not None:
        click.echo("`photonfarm up` is at work here" + (f"; watch it at {running.web}" if running.web else ""))
    missing = sum(scene.samples_planned - scene.samples_complete for scene in scenes)
    if isinstance(found, NoQueue):
        click.echo(f"queue: {found.reason if named_redis else _without_redis(missing, since_commit_s)}")
    else:
        _known_queue(found, scenes, store, missing)
    _failures("failed before", found.kept, store)


def _without_redis(missing: int, since_commit_s: float | None) -> str:
    """What a store without a queue means to someone who has named no Redis."""
    if not missing:
        return "none is needed: all that is planned is there"
    if since_commit_s is not None and since_commit_s <= RECENT_S:
        return (
            f"none is known here, but a job was committed {format_span(since_commit_s)} ago, so workers without Redis "
            f"may be at work (`work --share`, `slurm`); {missing} samples are missing"
        )
    return (
        f"no farm is at work here; `photonfarm up` goes on with the {missing} samples that are missing, given their "
        "spec, and `photonfarm work --share 0/1` renders just these"
    )


def _known_queue(found: StoreQueue, scenes: Sequence[SceneStatus], store: str | Path, missing: int) -> None:
    status, causes = found.status, found.causes
    failed, aside = sum(len(cause.jobs) for cause in causes), sum(cause.set_aside for cause in causes)
    core_s, complete = sum(scene.core_s for scene in scenes), sum(scene.samples_complete for scene in scenes)
    left = missing * core_s / complete / status.workers if missing and complete and status.workers else None
    click.echo(
        f"queue: {status.queued} queued, {status.running} running, {status.workers} workers, {failed} failed"
        + (f", of which {aside} are set aside until `photonfarm submit --retry`" if aside else "")
        + (f"; about {format_span(left)} left for {missing} samples" if left else "")
    )
    for name, activity in sorted(status.activities.items()):
        click.echo(f"  worker {name} {activity}")
    for line in idle(status, {scene.scene_id: scene.name for scene in scenes}, missing):
        click.echo(f"  {line}")
    _failures("", causes, store)


def trainings(found: Sequence[TrainingProgress]) -> None:
    """Print how far trainings are."""
    for training in found:
        click.echo(training.line)


def _failures(when: str, causes: Sequence[FailureCause], store: str | Path) -> None:
    for cause in causes:
        from photonfarm.queue import repeating_command

        click.echo(f"  {len(cause.jobs)} {when} × {cause.cause}" if when else f"  {len(cause.jobs)} × {cause.cause}")
        click.echo(f"      to repeat one: {repeating_command(store, cause.example)}")


def _queue_document(found: StoreQueue, store: str | Path) -> dict[str, Any]:
    status = found.status
    return {
        "queued": status.queued,
        "running": status.running,
        "workers": status.workers,
        "left": status.left,
        "paused": status.paused,
        "doing": {name: asdict(activity) for name, activity in status.activities.items()},
        "failures": _failures_document(found.causes, store),
    }


def _failures_document(causes: Sequence[FailureCause], store: str | Path) -> list[dict[str, Any]]:
    if not causes:
        return []
    from photonfarm.queue import repeating_command

    return [
        {
            "cause": cause.cause,
            "failed": len(cause.jobs),
            "set_aside": cause.set_aside,
            "jobs": [
                {"name": name, **asdict(failure), "command": repeating_command(store, name)}
                for name, failure in cause.jobs.items()
            ],
        }
        for cause in causes
    ]
