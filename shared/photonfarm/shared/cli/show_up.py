"""What `photonfarm up` says on stderr while it runs: sentences, and bars on a terminal."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from photonfarm.shared.farm.up import FarmProgress

PLAIN_LINE_S = 15.0  # between progress lines where there is no terminal for bars


class FarmTalk:
    """Says what a farm does, as `photonfarm.shared.farm.up.Talk` asks for it."""

    def __init__(self) -> None:
        """Say it on stderr."""
        self._console = Console(stderr=True, highlight=False)

    def say(self, line: str) -> None:
        """Print a sentence."""
        self._console.print(line, markup=False)

    @contextmanager
    def progress(self, steps: int) -> Iterator[Callable[[FarmProgress, bool], None]]:
        """A function that moves the bars, or prints a line now and then, and the last one in any case."""
        last_line = started = time.monotonic()
        with _bars(self._console) as bars:
            samples = bars.add_task("samples", total=None)
            passes = bars.add_task("further passes", total=None, visible=False)
            training = bars.add_task("training steps", total=steps, visible=steps > 0)

            def show(found: FarmProgress, last: bool) -> None:
                nonlocal last_line
                for bar, (committed, planned) in ((samples, found.samples), (passes, found.passes)):
                    bars.update(bar, completed=committed, total=planned, visible=bar == samples or planned > 0)
                bars.update(training, completed=found.step, description=f"training steps{found.note}")
                now = time.monotonic()
                if not self._console.is_terminal and (now - last_line > PLAIN_LINE_S or last):
                    last_line = now
                    self.say(f"{now - started:4.0f} s  {progress_line(found)}")

            yield show


def progress_line(found: FarmProgress) -> str:
    """The progress in words."""
    (samples, planned), (passes, further) = found.samples, found.passes
    words = f"  further passes {passes}/{further}" if further else ""
    return f"samples {samples}/{planned}{words}  steps {found.step}/{found.steps}{found.note}"


def _bars(console: Console) -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(*columns, console=console, disable=not console.is_terminal)
