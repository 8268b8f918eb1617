"""What the command line prints: tables for people, JSON for programs."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import click
from rich import markup
from rich.console import Console
from rich.table import Table

from photonfarm.shared.scene.spec import SceneSpec, shape_ids

if TYPE_CHECKING:
    from photonfarm.shared.farm.dry_run import DryRun
    from photonfarm.shared.farm.submission import Submission
    from photonfarm.shared.queue import Failure, FailureCause, QueueStatus
    from photonfarm.shared.store import Store


class CheckResult(Protocol):
    """The result of one check of `photonfarm doctor`."""

    @property
    def name(self) -> str:
        """What was checked."""

    @property
    def works(self) -> bool:
        """Whether it works."""

    @property
    def detail(self) -> str:
        """What was found, or what to do."""

    @property
    def exit_code(self) -> int:
        """The exit code of the command if this check fails; 0 if the check is optional."""


ANSWER_S = 5.0
"""How long `status` waits for an answer of Redis; workers wait longer."""

IDLE_SHOWN = 10
"""The most idle workers whose reasons are printed."""


def _json(document: Any) -> None:
    click.echo(json.dumps(document, indent=2))


def _table(rows: Iterable[tuple[str, ...]], head: tuple[str, ...] = ()) -> None:
    table = Table(*head, box=None, show_header=bool(head), pad_edge=False)
    for row in rows:
        table.add_row(*map(markup.escape, row))
    console = Console(soft_wrap=True)
    console.width = max(console.width, 132)  # ids are for copying: never cut
    console.print(table, highlight=False)


# ----------------------------------------------------------------------------------------------------------- scene show


def scene(spec: SceneSpec, as_json: bool) -> None:
    """Print a checked spec: its id, its settings, its movable groups."""
    if as_json:
        _json({"scene_id": spec.scene_id, "bytes_per_sample": bytes_per_sample(spec), **spec.model_dump(mode="json")})
        return
    t, source = spec.transport, spec.scene
    _table(
        (
            ("name", spec.name),
            ("scene id", spec.scene_id),
            ("source", source.file or f"built-in {source.builtin}"),
            ("kind", f"dynamic, {len(spec.groups)} movable groups" if spec.groups else "static"),
            ("film", f"{spec.film.width} × {spec.film.height}, field of view {spec.view.fov_deg:g}°"),
            ("light transport", f"depth {t.max_depth}, {t.connections} connections, light ratio {t.light_ratio:g}"),
            ("half-estimates", f"2 × {t.half_spp} samples per pixel"),
            ("views from", _box(spec.view.origin.min, spec.view.origin.max)),
            ("looking at", _box(spec.view.look_at.min, spec.view.look_at.max)),
            ("point cloud", f"{spec.points} points"),
            ("photons", f"{spec.photons.paths} paths, {spec.photons.depth} hits each"),
            ("exposure", f"{spec.exposure:g}"),
            ("bytes per sample", f"≤ {bytes_per_sample(spec):,} with its own view and modification"),
        )
    )  # fmt: skip
    if spec.groups:
        click.echo()
        _table(
            (
                (g.name, str(len(shape_ids(g))), f"{g.removal_probability:g}", _box(g.box.min, g.box.max))
                for g in spec.groups
            ),
            ("movable", "shapes", "removed", "positions"),
        )  # fmt: skip


def bytes_per_sample(spec: SceneSpec) -> int:
    """The stored bytes of one sample that has a view and a modification of its own, before compression."""
    from photonfarm.shared.store.format.schema import bytes_of_rows

    return sum(bytes_of_rows(spec).values())


def _box(low: tuple[float, ...], high: tuple[float, ...]) -> str:
    return " × ".join(f"{a:g}" if a == b else f"{a:g}…{b:g}" for a, b in zip(low, high, strict=True))


# --------------------------------------------------------------------------------------------------------------- submit


def submission(result: Submission, as_json: bool) -> None:
    """Print the outcome of a submission."""
    if as_json:
        _json(asdict(result))
        return
    if result.dry_run:
        click.echo(
            f"scene {result.scene_id}: {result.planned} samples would be planned, {result.planned_before} are already"
        )
        return
    queued = "not queued" if result.queued is None else f"{result.queued} jobs queued"
    click.echo(
        f"scene {result.scene_id}: {result.planned} samples planned, {result.planned_before} planned before, {queued}"
    )
    if result.scenes:
        from photonfarm.shared.scene.spec import SCENES_VARIABLE

        click.echo(f"workers find its scene file with {SCENES_VARIABLE}={result.scenes}", err=True)


def dry_run(result: DryRun, as_json: bool) -> None:
    """Print what a request would plan, its size and cost, and a better use of the same cost."""
    submission(result, as_json)
    if as_json or not result.planned:
        return
    size = f"at most {result.size_bytes / 1e6:,.1f} MB before compression"
    if result.core_s is None or result.wall_s is None:
        click.echo(size)
        return
    cores = "1 core" if result.cores == 1 else f"{result.cores} cores"
    click.echo(f"{size}; {_amount(result.core_s)} core-seconds: {_duration(result.wall_s)} on the {cores} here")
    click.echo(_suggestion(result))


def _suggestion(result: DryRun) -> str:
    better = result.suggestion
    if result.reduction is None:
        return f"no suggestion: another half_spp would render the {result.planned_before} planned samples again"
    if better is None:
        return "what is asked for is within 5 % of the best at this cost"
    request = f"{better.samples} views of one pass"
    if better.views is not None:
        options = f"--modifications {better.modifications} --views {better.views}"
        request = f"{options} ({better.samples} samples of one pass)"
    return (
        f"suggested at this cost: half_spp = {better.half_spp} in [transport], {request}: "
        f"{100 * result.reduction:.0f} % less excess error predicted"
    )


def _amount(seconds: float) -> str:
    return f"{seconds:,.0f}" if seconds >= 10 else f"{seconds:.1f}"


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{_amount(seconds)} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:,.1f} h"


# --------------------------------------------------------------------------------------------------------------- status


def status(store: str | Path, redis_url: str, as_json: bool) -> None:
    """Print the store's scenes, and the queue if Redis answers.

    Raises StoreError at the end if a scene or a marker cannot be read, or a marker belongs to no plan.
    """
    from photonfarm.shared.core.errors import StoreError
    from photonfarm.shared.store import Store, store_status

    opened = Store(store)
    scenes = [asdict(scene) for scene in store_status(opened)]
    _status(opened, scenes, redis_url, as_json)
    unread = []
    if unreadable := [s["error"] for s in scenes if s["error"]]:
        unread.append(f"{len(unreadable)} of {len(scenes)} scenes cannot be read: {'; '.join(unreadable)}")
    unread += [f"scene {s['scene_id']}: {_unread_markers(s)}" for s in scenes if s["markers_unreadable"]]
    unread += [f"scene {s['scene_id']}: {_lost_plan(s)}" for s in scenes if s["markers_without_plan"]]
    if unread:
        raise StoreError("; ".join(unread))


def _unread_markers(scene: Mapping[str, Any]) -> str:
    """The message about a scene's unreadable markers."""
    return (
        f"{scene['markers_unreadable']} of {_markers(scene)} markers cannot be read, and size, core time and "
        f"redrawn leave them out: {scene['marker_error']}; `photonfarm store check` names each"
    )


def _lost_plan(scene: Mapping[str, Any]) -> str:
    """The message about a scene's markers whose jobs no plan has."""
    return (
        f"{scene['markers_without_plan']} of {_markers(scene)} markers are of jobs that no plan has; "
        "`photonfarm store check` tells whether the last plan is missing"
    )


def _markers(scene: Mapping[str, Any]) -> int:
    """The number of a scene's markers, including those of guides."""
    return int(scene["jobs_committed"] + scene["guide_jobs"])


def _status(opened: Store, scenes: list[dict[str, Any]], redis_url: str, as_json: bool) -> None:
    from photonfarm.shared import queue

    if as_json:
        found, _ = _queue_status(opened, redis_url)
        causes = queue.causes(_still_missing(opened, found.failed)) if found else []
        _json({"scenes": scenes, "queue": found and _queue_document(found, causes, opened.root)})
        return
    _scenes(scenes)  # before Redis is asked, which may not answer
    found, absent = _queue_status(opened, redis_url)
    if found is None:
        click.echo(f"queue: {absent}")
        return
    _queue(opened, found, {s["scene_id"]: s["name"] for s in scenes})


def _queue_status(opened: Store, redis_url: str) -> tuple[QueueStatus | None, str]:
    """The status of the queue; or None, and the reason why Redis gives none."""
    from photonfarm.shared import queue
    from photonfarm.shared.core.errors import QueueError

    try:
        with queue.connect(redis_url, only_s=ANSWER_S) as connection:
            queue.check_served(connection, opened)
            return queue.queue_status(connection), ""
    except QueueError as error:
        return None, str(error)


def _scenes(scenes: Sequence[Mapping[str, Any]]) -> None:
    with_guides = any(s["views_guided"] is not None for s in scenes)
    _table(
        (
            (
                s["name"], s["scene_id"], f"{s['samples_complete']}/{s['samples_planned']}",
                f"{s['jobs_committed']}/{s['jobs_planned']}", *([_guided(s)] if with_guides else []),
                f"{s['size_bytes'] / 1e6:.1f} MB", f"{s['core_s']:.0f} s", str(s["redrawn"]),
            )
            for s in scenes
            if not s["error"]
        ),
        ("scene", "id", "samples", "jobs", *(["guides"] if with_guides else []), "size", "core time", "redrawn"),
    )  # fmt: skip
    for s in scenes:
        if s["error"]:
            click.echo(f"{s['name']} {s['scene_id']}: cannot be read: {s['error']}")
        if s["markers_unreadable"]:
            click.echo(f"{s['name']} {s['scene_id']}: {_unread_markers(s)}")
        if s["markers_without_plan"]:
            click.echo(f"{s['name']} {s['scene_id']}: {_lost_plan(s)}")
    click.echo()


def _guided(scene: Mapping[str, Any]) -> str:
    """How many of a scene's planned views have guides, as text."""
    if scene["views_guided"] is None:
        return "none"
    return f"{scene['views_guided']}/{scene['views_planned']} views"


def _queue(opened: Store, found: QueueStatus, names: Mapping[str, str]) -> None:
    from photonfarm.shared import queue

    causes = queue.causes(_still_missing(opened, found.failed))
    failed, aside = sum(len(cause.jobs) for cause in causes), sum(cause.set_aside for cause in causes)
    click.echo(
        f"queue: {found.queued} queued, {found.running} running, {found.workers} workers, {failed} failed"
        + (f", of which {aside} are set aside until `photonfarm submit --retry`" if aside else "")
    )
    for line in _idle_lines(found, names):
        click.echo(f"  {line}")
    for cause in causes:
        click.echo(f"  {len(cause.jobs)} × {cause.cause}")
        click.echo(f"      to repeat one: {queue.repeating_command(opened.root, cause.example)}")


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


def _still_missing(store: Store, failed: Mapping[str, Failure]) -> dict[str, Failure]:
    """The failures of this store's jobs that are still not committed."""
    from photonfarm.shared.core.errors import CorruptError
    from photonfarm.shared.queue import RenderArguments

    scene_ids, missing = set(store.scene_ids()), {}
    for name, failure in failed.items():
        job = RenderArguments.of(name)
        with contextlib.suppress(CorruptError):  # of a scene whose spec is damaged
            if job.scene_id in scene_ids and not store.scene(job.scene_id).is_done(job.job):
                missing[name] = failure
    return missing


def _queue_document(found: QueueStatus, causes: Iterable[FailureCause], store: str | Path) -> dict[str, Any]:
    from photonfarm.shared.queue import repeating_command

    return {
        "queued": found.queued,
        "running": found.running,
        "workers": found.workers,
        "left": found.idle_reports.left,
        "paused": found.idle_reports.paused,
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
            for cause in causes
        ],
    }


# --------------------------------------------------------------------------------------------------------------- doctor


def findings(found: Iterable[CheckResult], as_json: bool) -> int:
    """Print the results of checks as they come; returns the exit code of the first required check that failed, or 0."""
    console, code, seen = Console(soft_wrap=True), 0, []
    for finding in found:
        if not finding.works and not code:
            code = finding.exit_code
        seen.append(finding)
        if not as_json:
            mark = "[green]ok[/]  " if finding.works else ("[red]FAIL[/]" if finding.exit_code else "[yellow]none[/]")
            console.print(f"{mark} [bold]{finding.name}[/]: {markup.escape(finding.detail)}", highlight=False)
    if as_json:
        _json([{"name": f.name, "works": f.works, "detail": f.detail} for f in seen])
    return code
