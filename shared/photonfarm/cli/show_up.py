"""What `photonfarm up` says on stderr while it runs: sentences, and bars on a terminal."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.text import Text

from photonfarm.core.waiting import format_span
from photonfarm.farm.training import count_steps
from photonfarm.farm.up import FarmProgress

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
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
               TimeRemainingColumn())  # fmt: skip
    return Progress(*columns, auto_refresh=False, speed_estimate_period=PACE_S, get_time=time.monotonic)
