"""What `status --watch` and `up` show: the farm, redrawn in place on a terminal, and as plain lines elsewhere."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from photonfarm.core.formatting import format_count
from photonfarm.core.waiting import format_span
from photonfarm.farm.status import NoQueue, describe_failed
from photonfarm.farm.training import count_steps
from photonfarm.farm.up import FarmProgress
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
        yield f"  {format_count(status.queued, 'job')} queued, {status.running} running, {status.workers} workers"
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


PLAIN_LINE_S = 5.0  # between progress lines where there is no terminal for bars
PACE_S = 120.0  # over which the time left is estimated

_NUMBER = re.compile(r"\d+(\.\d+)?")


class FarmTalk:
    """Says what a farm does, as `photonfarm.farm.up.Talk` asks for it."""

    def __init__(self) -> None:
        """Say it on stderr."""
        self._console = Console(stderr=True, highlight=False, soft_wrap=True)

    def say(self, line: str) -> None:
        """Print a sentence."""
        self._console.print(line, markup=False)

    @contextmanager
    def progress(self, steps: int) -> Iterator[Callable[[FarmProgress, bool], None]]:
        """A function that moves the bars, or prints a line now and then, and the last one in any case."""
        last_line = started = time.monotonic()
        told: set[str] = set()
        bars, below = _bars(), Text()
        samples = bars.add_task("samples", total=None)
        passes = bars.add_task("further passes", total=None, visible=False)
        training = bars.add_task("training steps", total=steps, visible=steps > 0)

        def show(found: FarmProgress, last: bool) -> None:
            nonlocal last_line
            first = samples if found.samples[0] < found.samples[1] else passes  # what is in hand is of these
            for bar, (committed, planned) in ((samples, found.samples), (passes, found.passes)):
                done = min(committed + found.in_hand * (bar == first), planned)
                done = max(done, int(bars.tasks[bar].completed))  # rich counts what falls and rises again twice
                bars.update(bar, completed=done, total=planned, visible=bar == samples or planned > 0)
            bars.update(training, completed=found.step, total=max(found.step, steps))
            note = f"training{found.note}" if found.note else ""
            below.plain = "\n".join(filter(None, (*found.doing, note)))
            for wait in found.waits:
                if (kind := _NUMBER.sub("…", wait)) not in told:
                    told.add(kind)
                    self.say(wait)
            now = time.monotonic()
            if not self._console.is_terminal and (now - last_line >= PLAIN_LINE_S or last):
                last_line = now
                self.say(f"{now - started:4.0f} s  {progress_line(found, bars.tasks[samples].time_remaining)}")

        shown = Live(Group(bars, below), console=self._console) if self._console.is_terminal else nullcontext()
        with shown:
            yield show


def progress_line(found: FarmProgress, left_s: float | None = None) -> str:
    """The progress in words, with the time that the samples still take, if it is known."""
    (samples, planned), (passes, further) = found.samples, found.passes
    in_hand = f" (+{found.in_hand} in hand)" if found.in_hand else ""
    left = f", {format_span(left_s)} left" if left_s and samples < planned else ""
    words = f"  further passes {passes}/{further}" if further else ""
    training = f"  steps {count_steps(found.step, found.steps)}{found.note}" if found.steps else ""
    why = f"  ({'; '.join(found.waits)})" if found.waits else f"  ({'; '.join(found.doing)})" if found.doing else ""
    return f"samples {samples}/{planned}{in_hand}{left}{words}{training}{why}"


def _bars() -> Progress:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    return Progress(*columns, auto_refresh=False, speed_estimate_period=PACE_S, get_time=time.monotonic)
