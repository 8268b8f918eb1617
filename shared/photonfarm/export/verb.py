"""The verb `export`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from photonfarm.cli.options import json_option, store_option
from photonfarm.plan.hold_out import HOLD_OUT

EXTRAS = ("points", "photons", "visibility")


def _extras(ctx: click.Context, param: click.Parameter, text: str) -> tuple[str, ...]:  # noqa: ARG001
    asked = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    if unknown := [name for name in asked if name not in EXTRAS]:
        raise click.BadParameter(f"{unknown[0]!r} is none of {', '.join(EXTRAS)}")
    return asked


def _rows(ctx: click.Context, param: click.Parameter, text: str) -> str:  # noqa: ARG001
    from photonfarm.export.columns import spans

    try:
        spans(text)
    except ValueError as error:
        raise click.BadParameter(str(error)) from error
    return text


@click.command()
@click.argument("scene", metavar="SPEC_OR_SCENE")
@store_option
@click.option("--to", required=True, type=click.Choice(["webdataset", "exr", "npz", "parquet"]), help="The format.")
@click.option("--out", required=True, type=click.Path(file_okay=False, path_type=Path), help="A folder.")
@click.option("--split", type=click.Choice(["all", "train", "held-out"]), default="all", show_default=True,
              help="The samples to train on, those held out, or both; each is labelled.")  # fmt: skip
@click.option("--hold-out", type=click.FloatRange(0, 1, min_open=True, max_open=True), default=HOLD_OUT,
              show_default=True, help="Share of the configurations that is held out, as `train` has it.")  # fmt: skip
@click.option("--rows", default="", callback=_rows, metavar="RANGES", help="These rows of the store alone: 0-31,40.")
@click.option("--buffers", default="all", show_default=True, metavar="all|none|NAMES",
              help="Buffers and guides beside A and B: albedo,normal,depth,direct and so on.")  # fmt: skip
@click.option("--with", "extras", default="", callback=_extras, metavar="NAMES",
              help="Also points and photons, once per configuration, and visibility, with each sample.")  # fmt: skip
@click.option("--samples-per-file", type=click.IntRange(1), help="For webdataset, parquet and npz.  "
              "[default: as many as make 128 MB; of npz 1]")  # fmt: skip
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
    from photonfarm.export import show
    from photonfarm.export.export import export_scene
    from photonfarm.export.settings import ExportRequest

    try:
        with show.progress() as (log, on_progress):
            result = export_scene(store, scene, out, ExportRequest(**asked), log, on_progress)
    except KeyboardInterrupt:
        click.echo("stopped; the same command goes on from here", err=True)
        sys.exit(130)
    show.result(result, as_json)
