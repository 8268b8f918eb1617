"""`photonfarm status --watch`: the farm, redrawn in place on a terminal, and as plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Iterator

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from photonfarm.core.waiting import format_span
from photonfarm.farm.status import NoQueue, describe_failed
from photonfarm.farm.watch import FarmView, FarmWatch, SceneView

LOOK_S = 2.0
PLAIN_S = 5.0  # where there is no terminal


def keep_watching(watch: FarmWatch) -> None:
    """Show the farm until Ctrl-C. Raises StoreError if the store is gone."""
    console = Console(highlight=False)
    try:
        if not console.is_terminal:
            while True:
                console.print("\n".join(lines(watch.look())), soft_wrap=True, markup=False)
                time.sleep(PLAIN_S)
        with Live(console=console, auto_refresh=False) as live:
            while True:
                live.update(draw_farm(watch.look()), refresh=True)
                time.sleep(LOOK_S)
    except KeyboardInterrupt:
        return


def draw_farm(view: FarmView) -> Group:
    """The farm as a terminal shows it."""
    table = Table("scene", "id", "samples", "in hand", "rate", "left", "core time", "size", box=None, pad_edge=False)
    for scene in view.scenes:
        if scene.error:
            continue
        table.add_row(
            Text(scene.name),
            scene.scene_id[:8],
            _describe_progress(scene),
            str(scene.in_hand),
            _rate(scene),
            _describe_left(scene),
            f"{scene.core_s:.0f} s",
            f"{scene.size_bytes / 1e6:.1f} MB",
        )
    return Group(Text(time.strftime("%H:%M:%S")), table, *(Text(line) for line in _below(view)))


def lines(view: FarmView) -> Iterator[str]:
    """The farm as plain lines."""
    now = time.strftime("%H:%M:%S")
    for scene in view.scenes:
        if scene.error:
            continue
        in_hand = f" (+{scene.in_hand} in hand)" if scene.in_hand else ""
        parts = (
            f"samples {_describe_progress(scene)}{in_hand}",
            _rate(scene),
            _describe_left(scene),
            "" if scene.missing else "all there",
        )
        yield f"{now}  {scene.name} {scene.scene_id[:8]}: {', '.join(filter(None, parts))}"
    yield from _below(view)


def _below(view: FarmView) -> Iterator[str]:
    """Which scenes cannot be read, what workers and trainers do, and what waits for what."""
    yield from (f"  scene {each.scene_id} cannot be read: {each.error}" for each in view.scenes if each.error)
    if isinstance(view.queue, NoQueue):
        yield f"  {view.queue.reason if view.named_redis else _without_redis(view)}"
    else:
        status = view.queue.status
        yield f"  {status.queued} jobs queued, {status.running} running, {status.workers} workers"
    for name, activity in sorted(view.activities.items()):
        yield f"  worker {name} {activity}"
    yield from (f"  {training.line}" for training in view.trainings)
    yield from (f"  {wait}" for wait in view.waits)
    yield from (f"  before: {describe_failed(cause)}" for cause in view.queue.kept)


def _without_redis(view: FarmView) -> str:
    """What is known of workers without a queue: only what they commit."""
    if any(scene.rate for scene in view.scenes):
        return "no queue is known here; workers without Redis are at work (`work --share`, `slurm`)"
    return "no farm is at work here"


def _describe_progress(scene: SceneView) -> str:
    further = f", passes {scene.passes[0]}/{scene.passes[1]}" if scene.passes[1] else ""
    return f"{scene.samples[0]}/{scene.samples[1]}{further}"


def _rate(scene: SceneView) -> str:
    if scene.rate is None:
        return ""
    return f"{scene.rate:.1f} samples/s" if scene.rate >= 1 else f"{60 * scene.rate:.1f} samples/min"


def _describe_left(scene: SceneView) -> str:
    return "" if scene.left_s is None else f"{format_span(scene.left_s)} left"
