"""The verb `export`, and what it prints: a bar on a terminal, else lines."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from photonfarm.cli.options import json_option, store_option
from photonfarm.core.formatting import format_bytes, format_count
from photonfarm.core.waiting import format_span
from photonfarm.plan.hold_out import HOLD_OUT

if TYPE_CHECKING:
    from photonfarm.export.export import OnProgress

EXTRAS = ("points", "photons", "visibility")


def _extras(ctx: click.Context, param: click.Parameter, text: str) -> tuple[str, ...]:  # noqa: ARG001
    asked = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    if unknown := [name for name in asked if name not in EXTRAS]:
        raise click.BadParameter(f"{unknown[0]!r} is none of {', '.join(EXTRAS)}")
    return asked


def _rows(ctx: click.Context, param: click.Parameter, text: str) -> str:  # noqa: ARG001
    from photonfarm.export.snapshot import parse_ranges

    try:
        parse_ranges(text)
    except ValueError as error:
        raise click.BadParameter(str(error)) from error
    return text


@click.command()
@click.argument("scene", metavar="SPEC_OR_SCENE")
@store_option
@click.option("--to", required=True, type=click.Choice(["webdataset", "exr", "npz", "parquet"]), help="The format.")
@click.option("--out", required=True, type=click.Path(file_okay=False, path_type=Path), help="A folder.")
@click.option(
    "--split",
    type=click.Choice(["all", "train", "held-out"]),
    default="all",
    show_default=True,
    help="The samples to train on, those held out, or both; each is labelled.",
)
@click.option(
    "--hold-out",
    type=click.FloatRange(0, 1, min_open=True, max_open=True),
    default=HOLD_OUT,
    show_default=True,
    help="Share of the configurations that is held out, as `train` has it.",
)
@click.option("--rows", default="", callback=_rows, metavar="RANGES", help="These rows of the store alone: 0-31,40.")
@click.option(
    "--buffers",
    default="all",
    show_default=True,
    metavar="all|none|NAMES",
    help="Buffers and guides beside A and B: albedo,normal,depth,direct and so on.",
)
@click.option(
    "--with",
    "extras",
    default="",
    callback=_extras,
    metavar="NAMES",
    help="Also points and photons, once per configuration, and visibility, with each sample.",
)
@click.option(
    "--samples-per-file",
    type=click.IntRange(1),
    help="For webdataset, parquet and npz.  [default: as many as make 128 MB; of npz 1]",
)
@json_option
def export(scene: str, store: str | Path, out: Path, as_json: bool, **asked: Any) -> None:
    """Write what is complete of a scene, by its name, its id or its spec, in a format that other programs read.

    webdataset: tar shards that stream. exr: an image per sample with a layer for everything, and transforms.json with
    the cameras. npz: NumPy archives. parquet: tables for `datasets`, with Croissant metadata. Values are those of the
    store, bit for bit. A README.md has licence and credits; export.json says scene, plans, committed jobs and versions.

    Files appear whole. It may be killed and started again at any time, and writes what the folder lacks: later on, the
    samples that were completed meanwhile. A folder with another scene or other settings is refused.

    Exit codes: 0 exported, 7 no sample is complete, 4 store or folder, 3 what the scene does not have, 130 Ctrl-C.
    """
    from photonfarm.cli.show import print_json  # numpy comes with it
    from photonfarm.export.export import export_scene
    from photonfarm.export.folder import ExportRequest

    try:
        with show_progress() as (log, on_progress):
            result = export_scene(store, scene, out, ExportRequest(**asked), log, on_progress)
    except KeyboardInterrupt:
        click.echo("stopped; the same command goes on from here", err=True)
        sys.exit(130)
    if as_json:
        print_json(asdict(result))
        return
    shared = f", {format_count(result.configurations, 'configuration')}" if result.configurations else ""
    size = f" in {format_count(result.new_files, 'file')} of {format_bytes(result.new_bytes)}" if result.new else ""
    click.echo(f"{result.folder}: {format_count(result.samples, 'sample')}{shared}; {result.new} of them new{size}")


LINE_S = 4.0
"""The seconds between lines of progress where there is no terminal."""


@contextmanager
def show_progress() -> Iterator[tuple[Callable[[str], None], OnProgress]]:
    """Functions that say a line, and how far the export is: a bar on a terminal, else lines; both on stderr."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True, soft_wrap=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("samples"),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
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
