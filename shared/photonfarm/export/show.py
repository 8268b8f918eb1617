"""What `photonfarm export` prints."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from photonfarm.cli.show import print_json
from photonfarm.core.waiting import format_span
from photonfarm.export.export import OnProgress, Result

LINE_S = 4.0
"""The seconds between lines of progress where there is no terminal."""


@contextmanager
def progress() -> Iterator[tuple[Callable[[str], None], OnProgress]]:
    """Functions that say a line, and how far the export is: a bar on a terminal, else lines; both on stderr."""
    console = Console(stderr=True, soft_wrap=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("samples"),
               TextColumn("{task.fields[rate]}"), TimeRemainingColumn())  # fmt: skip
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bars:
        bar = bars.add_task("export", total=None, rate="", visible=False)
        began = last = time.monotonic()

        def show(done: int, total: int, size_bytes: int) -> None:
            nonlocal last
            now = time.monotonic()
            rate = done / max(now - began, 1e-9)
            speed = f"{rate:.0f}/s, {rate * size_bytes / done / 1e6:.0f} MB/s"
            bars.update(bar, completed=done, total=total, rate=speed, visible=True)
            if not console.is_terminal and (now - last > LINE_S or done == total):
                last, left = now, format_span((total - done) / rate)
                console.print(f"{done}/{total} samples, {speed}, {left} left", highlight=False)

        def say(line: str) -> None:
            nonlocal began
            began = time.monotonic()  # the samples begin after the last line about what was before them
            console.print(line, markup=False, highlight=False)

        yield say, show


def result(found: Result, as_json: bool) -> None:
    """Print what was written."""
    if as_json:
        print_json(asdict(found))
        return
    shared = f", {found.configurations} configurations" if found.configurations else ""
    size = f" in {found.new_files} files of {found.new_bytes / 1e6:,.1f} MB" if found.new else ""
    click.echo(f"{found.folder}: {found.samples} samples{shared}; {found.new} of them new{size}")
