"""What `status`, `status --watch` and `up` show of a farm: a table and sentences, or JSON for programs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.text import Text

from photonfarm.cli.show import make_table, print_json, print_table
from photonfarm.core.formatting import format_bytes
from photonfarm.core.waiting import format_span
from photonfarm.farm.progress import FarmProgress, SceneProgress, describe_failed
from photonfarm.scene.poor_views import describe_counts

if TYPE_CHECKING:
    from photonfarm.farm.watch import FarmWatch
    from photonfarm.queue.failures import FailureCause

LOOK_S = 2.0
PLAIN_S = 5.0  # where there is no terminal
HEAD = ("scene", "id", "samples", "jobs", "in hand", "rate", "left", "core time", "size")


def print_farm(farm: FarmProgress, store: str | Path) -> None:
    """Print a farm as it is now, with whole ids."""
    print_table(_list_scenes(farm, letters=32), HEAD)
    click.echo()
    if farm.running is not None:
        click.echo("`photonfarm up` is at work here" + (f"; watch it at {farm.running.web}" * bool(farm.running.web)))
    for line in list_lines(farm, store):
        click.echo(line)


def keep_watching(watch: FarmWatch, store: str | Path) -> None:
    """Show the farm until Ctrl-C. Raises StoreError if the store is gone."""
    console = Console(highlight=False)
    live = Live(console=console, auto_refresh=False) if console.is_terminal else None
    with suppress(KeyboardInterrupt), live or nullcontext():
        while True:
            farm = watch.look()
            if live is None:
                click.echo(time.strftime("%H:%M:%S"))
                print_farm(farm, store)
            else:
                live.update(draw_farm(farm, store), refresh=True)
            time.sleep(PLAIN_S if live is None else LOOK_S)


@contextmanager
def follow_up(store: str | Path) -> Iterator[Callable[[FarmProgress, bool], None]]:
    """A function that shows a farm on stderr: in place on a terminal, else in a line now and then, and the last one."""
    console = Console(stderr=True, highlight=False)
    live = Live(console=console, auto_refresh=False) if console.is_terminal else None
    started = said = time.monotonic()

    def show(farm: FarmProgress, last: bool) -> None:
        nonlocal said
        now = time.monotonic()
        if live is not None:
            live.update(draw_farm(farm, store), refresh=True)
        elif last or now - said >= PLAIN_S:
            said = now
            click.echo(f"{now - started:4.0f} s  {describe_farm(farm)}", err=True)

    with live or nullcontext():
        yield show


def draw_farm(farm: FarmProgress, store: str | Path) -> Group:
    """The farm as a terminal shows it, with a bar for each scene."""
    bars = (
        ProgressBar(max(scene.status.samples_planned, 1), scene.status.samples_complete + scene.in_hand, width=24)
        for scene in farm.scenes
        if not scene.status.error
    )
    rows: list[tuple[RenderableType, ...]] = [
        (*row, bar) for row, bar in zip(_list_scenes(farm, letters=8), bars, strict=True)
    ]
    text = Text("\n".join(list_lines(farm, store)))
    return Group(Text(time.strftime("%H:%M:%S")), make_table(rows, (*HEAD, "")), text)


def describe_farm(farm: FarmProgress) -> str:
    """The farm in one line: scenes and trainings, and what waits for what, else what workers do."""
    scenes = (_describe_scene(scene) for scene in farm.scenes if not scene.status.error)
    waits = [wait.sentence for wait in farm.waits]
    doing = [f"{name} {activity}" for name, activity in farm.queue.activities.items()]
    why = f"({'; '.join(waits or doing)})" if waits or doing else ""
    return "  ".join(filter(None, (*scenes, *(training.line for training in farm.trainings), why)))


def list_lines(farm: FarmProgress, store: str | Path) -> Iterator[str]:
    """What cannot be read, the queue, what workers and trainers do, and what waits for what."""
    for scene in farm.scenes:
        yield from (f"{scene.status.name} {scene.status.scene_id}: {fault}" for fault in scene.faults)
        if poor := describe_counts(scene.status.counts):
            yield f"{scene.status.name} {scene.status.scene_id}: {poor}"
    yield f"queue: {farm.describe_queue()}"
    yield from (f"  worker {name} {activity}" for name, activity in farm.queue.activities.items())
    yield from (f"  {wait.sentence}" for wait in farm.waits if wait.kind != "job_failed")
    for when, causes in (("", farm.queue.causes), ("before: ", farm.queue.kept)):
        for cause in causes:
            from photonfarm.queue.failures import repeating_command

            yield f"  {when}{describe_failed(cause)}"
            yield f"      to repeat one: {repeating_command(store, cause.example)}"
    yield from (training.line for training in farm.trainings)


def _list_scenes(farm: FarmProgress, letters: int) -> list[tuple[str, ...]]:
    """The rows of the table of scenes, with so many letters of their ids."""
    return [
        (
            scene.status.name,
            scene.status.scene_id[:letters],
            _describe_samples(scene),
            f"{scene.status.jobs_committed}/{scene.status.jobs_planned}",
            str(scene.in_hand),
            _describe_rate(scene),
            "" if scene.left_s is None else format_span(scene.left_s),
            f"{scene.status.core_s:.0f} s" + (f" ({scene.status.redrawn} redrawn)" if scene.status.redrawn else ""),
            format_bytes(scene.status.size_bytes),
        )
        for scene in farm.scenes
        if not scene.status.error
    ]


def _describe_scene(scene: SceneProgress) -> str:
    in_hand = f" (+{scene.in_hand} in hand)" if scene.in_hand else ""
    left = "" if scene.left_s is None else f"{format_span(scene.left_s)} left"
    parts = (f"{scene.status.name}: samples {_describe_samples(scene)}{in_hand}", _describe_rate(scene), left)
    return ", ".join(filter(None, parts))


def _describe_samples(scene: SceneProgress) -> str:
    further = f", passes {scene.passes[0]}/{scene.passes[1]}" if scene.passes[1] else ""
    return f"{scene.samples[0]}/{scene.samples[1]}{further}"


def _describe_rate(scene: SceneProgress) -> str:
    if scene.rate is None or not scene.missing:
        return ""
    return f"{scene.rate:.1f} samples/s" if scene.rate >= 1 else f"{60 * scene.rate:.1f} samples/min"


def print_document(farm: FarmProgress, store: str | Path) -> None:
    """Print the farm as JSON."""
    status = farm.queue.status
    queue = status and {
        "queued": status.queued,
        "running": status.running,
        "workers": status.workers,
        "left": status.skipped,
        "paused": status.paused,
        "doing": {name: asdict(activity) for name, activity in status.activities.items()},
        "failures": _list_failures(farm.queue.causes, store),
    }
    print_json(
        {
            "scenes": [asdict(scene.status) for scene in farm.scenes],
            "queue": queue,
            "no_queue": farm.queue.reason or None,
            "kept_failures": _list_failures(farm.queue.kept, store),
            "trainings": [asdict(training) for training in farm.trainings],
            "up": None if farm.running is None else asdict(farm.running),
        }
    )


def _list_failures(causes: Sequence[FailureCause], store: str | Path) -> list[dict[str, Any]]:
    from photonfarm.queue.failures import repeating_command

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
