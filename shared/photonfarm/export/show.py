"""What `photonfarm export` prints."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict

import click

from photonfarm.export.export import OnProgress, Result
from photonfarm.shared.cli.show import print_json
from photonfarm.shared.core.waiting import in_words

LINE_S = 4.0
"""The seconds between lines of progress."""


def progress() -> tuple[Callable[[str], None], OnProgress]:
    """Functions that say a line, and how far the export is, every few seconds; both on stderr."""
    began = last = time.monotonic()

    def say(line: str) -> None:
        nonlocal began
        began = time.monotonic()  # the samples begin after the last line about what was before them
        click.echo(line, err=True)

    def show(done: int, total: int, size_bytes: int) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last > LINE_S or done == total:
            last, rate = now, done / max(now - began, 1e-9)
            speed = f"{rate:.0f}/s, {rate * size_bytes / done / 1e6:.0f} MB/s"
            click.echo(f"{done}/{total} samples, {speed}, {in_words((total - done) / rate)} left", err=True)

    return say, show


def result(found: Result, as_json: bool) -> None:
    """Print what was written."""
    if as_json:
        print_json(asdict(found))
        return
    shared = f", {found.configurations} configurations" if found.configurations else ""
    size = f" in {found.new_files} files of {found.new_bytes / 1e6:,.1f} MB" if found.new else ""
    click.echo(f"{found.folder}: {found.samples} samples{shared}; {found.new} of them new{size}")
