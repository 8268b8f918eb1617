"""The verbs of the trainer service: train, report."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from photonfarm.shared.cli import json_option, redis_option, store_option

run_option = click.option(
    "--run", type=click.Path(path_type=Path, file_okay=False), envvar="PHOTONFARM_RUN", default="run",
    show_default=True, help="Folder of the training run: checkpoints, metrics.",
)  # fmt: skip


@click.command()
@click.argument("spec", required=False)
@store_option
@run_option
@redis_option
@click.option(
    "--preset",
    type=click.Choice(["small", "paper"]),
    default="small",
    show_default=True,
    help="Sizes of network and batch.",
)
@click.option("--steps", "max_steps", type=click.IntRange(1), help="Steps to train for.  [default: the preset's]")
@click.option("--seconds", "max_seconds", type=click.FloatRange(0, min_open=True), help="Stop after so much time.")
@click.option("--batch", type=click.IntRange(1), help="Samples per step.  [default: the preset's]")
@click.option("--seed", type=click.IntRange(0), help="Of the weights and the draws; 0 is a seed.  [default: 0]")
@click.option("--replay-ratio", type=click.FloatRange(0, min_open=True), help="Draws per sample that has arrived.")
@click.option(
    "--hold-out",
    type=click.FloatRange(0, 1, min_open=True, max_open=True),
    help="Share of the configurations never trained on.  [default: the preset's, 1/8 or 1/16]",
)
@click.option("--threads", type=click.IntRange(1), help="Processor threads of torch.  [default: 1]")
@click.option("--device", help="cpu or cuda.  [default: cpu]")
@click.option("--check", is_flag=True, help="Only say whether the run is alive (exit 0) or not (7).")
def train(
    spec: str | None, store: str | Path, run: Path, redis_url: str, preset: str, check: bool, **settings: Any
) -> None:
    """Train on SPEC's samples while they arrive, or continue a run; SPEC may be left out of a store with one scene.

    Redis, where there is one, is told how many samples have been used, for `photonfarm work --ahead`.
    """
    from photonfarm.trainer import service

    if check:
        service.check(run)
    else:
        changes = {k: v for k, v in settings.items() if v is not None}
        service.run(spec, store, run, preset, changes, redis_url)


@click.command()
@store_option
@run_option
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default="out", show_default=True)
@json_option
def report(store: str | Path, run: Path, out: Path, as_json: bool) -> None:
    """Write report.html and report.json: what was learned, at which cost, with pictures."""
    from photonfarm.trainer.report import write_report

    figures = write_report(store, run, out)
    click.echo(json.dumps(figures, indent=2) if as_json else out / "report.html")
