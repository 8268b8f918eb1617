"""What `photonfarm status` prints: tables for people, JSON for programs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from photonfarm.shared.cli.show import print_json, print_table
from photonfarm.shared.farm.status import NoQueue, StoreQueue, lost_plan, unread_markers
from photonfarm.shared.queue import QueueStatus, repeating_command
from photonfarm.shared.store import SceneStatus

IDLE_SHOWN = 10
"""The most idle workers whose reasons are printed."""


def document(scenes: Sequence[SceneStatus], found: StoreQueue | NoQueue, store: str | Path) -> None:
    """Print a store's scenes and its queue as JSON, or why nothing is known of the queue."""
    document = None if isinstance(found, NoQueue) else _queue_document(found, store)
    reason = found.reason if isinstance(found, NoQueue) else None
    print_json({"scenes": [asdict(scene) for scene in scenes], "queue": document, "no_queue": reason})


def scenes(found: Sequence[SceneStatus]) -> None:
    """Print a table of a store's scenes."""
    with_guides = any(s.views_guided is not None for s in found)
    print_table(
        (
            (
                s.name, s.scene_id, f"{s.samples_complete}/{s.samples_planned}",
                f"{s.jobs_committed}/{s.jobs_planned}", *([_guided(s)] if with_guides else []),
                f"{s.size_bytes / 1e6:.1f} MB", f"{s.core_s:.0f} s", str(s.redrawn),
            )
            for s in found
            if not s.error
        ),
        ("scene", "id", "samples", "jobs", *(["guides"] if with_guides else []), "size", "core time", "redrawn"),
    )  # fmt: skip
    for s in found:
        unread = f"cannot be read: {s.error}" if s.error else ""
        for message in filter(None, (unread, unread_markers(s), lost_plan(s))):
            click.echo(f"{s.name} {s.scene_id}: {message}")
    click.echo()


def _guided(scene: SceneStatus) -> str:
    """How many of a scene's planned views have guides, as text."""
    return "none" if scene.views_guided is None else f"{scene.views_guided}/{scene.views_planned} views"


def queue(found: StoreQueue | NoQueue, scenes: Sequence[SceneStatus], store: str | Path) -> None:
    """Print what the queue of a store with these scenes holds, or why nothing is known of it."""
    if isinstance(found, NoQueue):
        click.echo(f"queue: {found.reason}")
        return
    status, causes = found.status, found.causes
    failed, aside = sum(len(cause.jobs) for cause in causes), sum(cause.set_aside for cause in causes)
    click.echo(
        f"queue: {status.queued} queued, {status.running} running, {status.workers} workers, {failed} failed"
        + (f", of which {aside} are set aside until `photonfarm submit --retry`" if aside else "")
    )
    for line in _idle_lines(status, {scene.scene_id: scene.name for scene in scenes}):
        click.echo(f"  {line}")
    for cause in causes:
        click.echo(f"  {len(cause.jobs)} × {cause.cause}")
        click.echo(f"      to repeat one: {repeating_command(store, cause.example)}")


def _idle_lines(found: QueueStatus, names: Mapping[str, str]) -> Iterator[str]:
    """Why scenes of the store are not rendered, by the workers' reports, which strangers may have written."""
    for scene_id, reasons in found.idle_reports.left.items():
        if scene_id in names:
            reason = next(iter(reasons.values()))
            yield f"{names[scene_id]}: left by {len(reasons)} of {found.workers} workers: {reason}"
    paused = found.idle_reports.paused
    for worker, reason in list(paused.items())[:IDLE_SHOWN]:
        yield f"worker {worker} takes no jobs: {reason}"
    if len(paused) > IDLE_SHOWN:
        yield f"and {len(paused) - IDLE_SHOWN} workers more"


def _queue_document(found: StoreQueue, store: str | Path) -> dict[str, Any]:
    status = found.status
    return {
        "queued": status.queued,
        "running": status.running,
        "workers": status.workers,
        "left": status.idle_reports.left,
        "paused": status.idle_reports.paused,
        "failures": [
            {
                "cause": cause.cause,
                "failed": len(cause.jobs),
                "set_aside": cause.set_aside,
                "jobs": [
                    {"name": name, **asdict(failure), "command": repeating_command(store, name)}
                    for name, failure in cause.jobs.items()
                ],
            }
            for cause in found.causes
        ],
    }
