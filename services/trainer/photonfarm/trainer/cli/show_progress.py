"""What `evaluate` and `report` say of how far they are: bars on a terminal, a line every five seconds elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import click
from rich import markup
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from photonfarm.shared.core.processes import repeating
from photonfarm.shared.core.waiting import SILENCE_S, Steps

OnProgress = Callable[[str, int, int], None]


@contextmanager
def measuring_progress() -> Iterator[OnProgress]:
    """Yield a callback with what is done, how many of its samples are done, and of how many; 0: it has no parts."""
    console = Console(stderr=True)
    with _bars(console) if console.is_terminal else _lines() as show:
        yield show


@contextmanager
def _bars(console: Console) -> Iterator[OnProgress]:
    columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn()
    with Progress(*columns, console=console, transient=True) as bars:
        tasks: dict[str, Any] = {}
        measured: set[str] = set()

        def show(name: str, done: int, total: int) -> None:
            if name not in tasks:
                for part in [each for each in tasks if each not in measured]:
                    bars.remove_task(tasks.pop(part))
                tasks[name] = bars.add_task(markup.escape(name), total=total or None)
            if total:
                measured.add(name)
            bars.update(tasks[name], completed=done)

        yield show


@contextmanager
def _lines() -> Iterator[OnProgress]:
    name, since_s, samples = "starts", time.monotonic(), Steps(0)

    def show(what: str, done: int, total: int) -> None:
        nonlocal name, since_s, samples
        if what != name:
            name, since_s, samples = what, time.monotonic(), Steps(total)
        samples.reach(done)
        if total and done == total:
            click.echo(f"{name}: {total} samples", err=True)

    def line() -> str:
        if not samples.total:
            return f"{name}, for {time.monotonic() - since_s:.0f} s"
        return f"{name}: sample {samples.words()}"

    with repeating(SILENCE_S, lambda: click.echo(line(), err=True)):
        yield show
