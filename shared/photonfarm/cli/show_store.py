"""What `photonfarm store …` prints: sentences and tables for people, JSON for programs."""

from __future__ import annotations

import contextlib
import shlex
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from photonfarm.cli.show import print_json
from photonfarm.core.errors import StoreError
from photonfarm.core.formatting import format_bytes, format_count
from photonfarm.core.waiting import SILENCE_S
from photonfarm.farm.join import JoinedScene
from photonfarm.scene.poor_views import describe_counts
from photonfarm.store import Store
from photonfarm.store.check.check import CheckProgress, SceneReport, StoreReport
from photonfarm.store.model.findings import FindingGroup, Remedy
from photonfarm.store.model.withdrawal import Withdrawal
from photonfarm.store.read.find import FoundSample, Matches


@contextlib.contextmanager
def progress(done_in_words: str = "read") -> Iterator[CheckProgress]:
    """A progress callback for a check or a join: a bar on a terminal, else a line per scene; both on stderr."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _lines(done_in_words)
        return
    columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[read]}"), TimeRemainingColumn()
    with Progress(*columns, console=console, transient=True) as bars:
        tasks: dict[str, Any] = {}

        def show(scene: str, done: int, total: int, size_bytes: int) -> None:
            if scene not in tasks:
                tasks[scene] = bars.add_task(scene, total=total, read="")
            bars.update(tasks[scene], completed=done, read=f"{done}/{total} jobs{_describe_size(size_bytes)}")

        yield show


def _lines(done_in_words: str) -> CheckProgress:
    """A line for each scene, and one every few seconds before that."""
    said = time.monotonic()

    def line(scene: str, done: int, total: int, size_bytes: int) -> None:
        nonlocal said
        if done == total or time.monotonic() - said > SILENCE_S * 0.8:
            said = time.monotonic()
            of = "" if done == total else f" of {total}"
            click.echo(f"{scene}: {done}{of} jobs {done_in_words}{_describe_size(size_bytes)}", err=True)

    return line


def _describe_size(size_bytes: int) -> str:
    return f", {format_bytes(size_bytes)}" if size_bytes else ""


# ---------------------------------------------------------------------------------------------------------------- check


def print_check(report: StoreReport, as_json: bool) -> None:
    """Print what a check read and found, by scene and cause, and what to do about it."""
    if as_json:
        scenes = [{**asdict(scene), "groups": [_group(group) for group in scene.groups]} for scene in report.scenes]
        about = {"exit_code": report.exit_code, "quarantine": report.quarantine, "parts": report.parts}
        print_json({**about, "scenes": scenes})
        return
    for scene in report.scenes:
        _print_scene(scene)
    if report.parts:
        click.echo(f"tmp: {report.parts} unfinished files; workers sweep those of the dead")
    if report.quarantine:
        click.echo(
            f"set aside to {report.quarantine}, with a record of why; workers render the jobs that are missing now"
        )
    groups = [group for scene in report.scenes for group in scene.groups]
    wrong = sum(group.count for group in groups if group.cause.remedy is not Remedy.LOOK)
    if not wrong:
        click.echo("nothing is wrong")
    elif not report.repaired:
        click.echo(f"{format_count(wrong, 'finding')}; --repair sets aside what can be written again")
    elif report.exit_code == StoreError.exit_code:
        click.echo(
            "something is still wrong, and --repair does not help: see above for what does. A plan comes back from a "
            "copy of its folder below plans/; jobs and base need no copy, and are rendered again"
        )


def _print_scene(scene: SceneReport) -> None:
    read = (
        f"{format_count(scene.jobs, 'job')}, {format_count(scene.samples, 'sample')}, {format_bytes(scene.size_bytes)}"
    )
    click.echo(f"{scene.name or 'unreadable'} {scene.scene_id}: {read}")
    if scene.halves is not None:
        click.echo(f"  A against B: {scene.halves.in_words}")
    if poor := describe_counts(scene.counts):
        click.echo(f"  {poor}")
    for group in scene.groups:
        click.echo(f"  {group.count} × {group.cause.label}: {group.cause.sentence} ({group.cause.remedy.value})")
        for f in group.first:
            numbers = (f"{what} {n}" for what, n in (("job", f.job), ("row", f.row)) if n is not None)
            click.echo(f"      {', '.join(filter(None, (*numbers, f.file)))}: {f.detail}")
        if group.count > len(group.first):
            click.echo(f"      and {group.count - len(group.first)} more")
    if scene.set_aside:
        click.echo(f"  set aside: {', '.join(scene.set_aside)}")


def _group(group: FindingGroup) -> dict[str, Any]:
    return {
        "cause": group.cause.label,
        "means": group.cause.sentence,
        "remedy": group.cause.remedy.value,
        "count": group.count,
        "first": [{"job": f.job, "row": f.row, "file": f.file, "detail": f.detail} for f in group.first],
    }


# ----------------------------------------------------------------------------------------------------------------- find


def print_matches(matches: Matches, store: str | Path, as_json: bool) -> None:
    """Print samples: what they show, where their values are stored, and commands to read and render one."""
    if as_json:
        samples = [
            {name.removesuffix("_"): value for name, value in asdict(sample).items()}  # `pass` is a word of Python's
            | {"complete": sample.complete, "commands": list_commands(sample, store)}
            for sample in matches.samples
        ]
        print_json({"count": matches.count, "nearest": matches.nearest, "samples": samples})
        return
    for sample in matches.samples:
        _print_sample(sample, store)
    if matches.count > len(matches.samples):
        click.echo(f"{matches.count - len(matches.samples)} more; --limit shows more of them", err=True)
    if not matches.count:
        near = "" if matches.nearest is None else f"; the nearest is {matches.nearest:g} scene units away"
        click.echo(f"no sample fits{near}", err=True)


def _print_sample(sample: FoundSample, store: str | Path) -> None:
    state = "complete" if sample.complete else "not complete"
    click.echo(f"{sample.scene_name} {sample.scene_id}, row {sample.row}, pass {sample.pass_}: {state}")
    click.echo(f"  key           {sample.key}")
    click.echo(f"  modification  {sample.modification_key}  row {sample.modification_row}")
    click.echo(f"  view          {sample.view_key}  row {sample.view_row}")
    click.echo(f"  shows         {sample.shot}")
    for job, committed in dict(zip(sample.jobs, sample.committed, strict=True)).items():
        click.echo(f"  job           {job}: {'committed' if committed else 'missing'}")
    for place in sample.places:
        held = "" if place.there else "  (not there)"
        click.echo(f"  {place.array:<16} {place.file}  inner chunk {place.chunk}, index {place.index}{held}")
    for what, command in list_commands(sample, store).items():
        click.echo(f"  {what:<13} {command}")


def list_commands(sample: FoundSample, store: str | Path) -> dict[str, str]:
    """The command lines that read a sample, and those that render what is missing of it."""
    listed = {}
    if sample.complete:
        scene = f"open_scene({str(store)!r}, {sample.scene_id!r})"
        program = f"from photonfarm.data import open_scene; print({scene}.row({sample.row}).radiance)"
        listed["look at it"] = shlex.join(["python", "-c", program])
    lacking = {job for job, committed in zip(sample.jobs, sample.committed, strict=True) if not committed}
    for job in dict.fromkeys(sample.jobs):
        if job in lacking:
            words = ["photonfarm", "work", "--store", str(store), "--scene", sample.scene_id, "--job", str(job)]
            listed[f"render job {job}"] = shlex.join(words)
    return listed


# ---------------------------------------------------------------------------------------------- merge, join, withdraw


def print_joined(scenes: Sequence[JoinedScene], as_json: bool) -> None:
    """Print what a join has copied, scene by scene."""
    if as_json:
        print_json([asdict(scene) for scene in scenes])
        return
    for scene in scenes:
        known = scene.there - scene.planned
        jobs = format_count(scene.jobs, "job")
        there = format_count(scene.there, "sample")
        said = f"{there} there, {scene.planned} planned here now, {known} before; {jobs} copied"
        left = f"; {scene.left} are left to workers, as their jobs here are not whole there" if scene.left else ""
        click.echo(f"{scene.name} {scene.scene_id}: {said}{left}")


def describe_contents(store: Store, scene_id: str) -> str:
    """What there is of a scene, in words."""
    try:
        scene = store.scene(scene_id)
        progress = scene.progress()
    except StoreError:
        return f"the damaged scene {scene_id}"
    rendered = f"{progress.committed_samples} of {progress.planned_samples} planned samples are rendered"
    return f"scene {scene_id} ({scene.spec.name}), of which {rendered},"


def print_withdrawn(result: Withdrawal, as_json: bool) -> None:
    """Print what a withdrawal has forgotten, and what stays."""
    if as_json:
        print_json(asdict(result))
        return
    kept = f", {result.kept} stay planned, as rendered ones show their views or configurations" if result.kept else ""
    forgotten = f"{result.samples} samples in {format_count(result.jobs, 'job')} are forgotten"
    said = f"{forgotten if result.jobs else 'nothing is left to withdraw'}; {result.rendered} are rendered and stay"
    left = "" if result.jobs else f"; {result.left}"
    click.echo(f"plan {result.plan} of scene {result.scene_id} ({result.name}): {said}{kept}{left}")
