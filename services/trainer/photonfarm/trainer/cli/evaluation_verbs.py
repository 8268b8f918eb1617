"""The verbs that measure trained networks: evaluate, report."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any, get_args

import click

from photonfarm.cli.options import RunFolder, check_device, json_option, store_option
from photonfarm.trainer.runs.settings import MOST_HELD_OUT, ReadyDenoiser


class RepeatableOption(click.Option):
    """An option that may be repeated; a configuration file may give a single value."""

    def type_cast_value(self, ctx: click.Context, value: Any) -> Any:
        """The values as a tuple; click would split a single text into letters."""
        return super().type_cast_value(ctx, [value] if isinstance(value, str | int) else value)


device_option = click.option(
    "--device",
    default="auto",
    show_default=True,
    metavar="auto|cpu|cuda[:N]",
    callback=check_device,
    help="Of the networks; auto: cuda where there is one.",
)

MEASURING = (
    store_option,
    click.option(
        "--run",
        "runs",
        cls=RepeatableOption,
        multiple=True,
        type=RunFolder(),
        default=["run"],
        envvar="PHOTONFARM_RUN",
        show_default=True,
        help="Folder of a training run; several give several rows.",
    ),
    click.option(
        "--references",
        type=click.Path(path_type=Path, file_okay=False),
        metavar="FOLDER",
        help="Converged views, as `photonfarm store merge --out FOLDER` leaves them.",
    ),
    click.option(
        "--denoiser",
        "denoisers",
        type=click.Choice(get_args(ReadyDenoiser)),
        cls=RepeatableOption,
        multiple=True,
        help="Measure a ready one too, or several. none: dropped pixels stay black.",
    ),
    click.option(
        "--kept",
        type=click.IntRange(1),
        cls=RepeatableOption,
        multiple=True,
        metavar="K",
        help="These denoisers are given one of K pixels; may be repeated.  [default: 1]",
    ),
    click.option(
        "--halves",
        type=click.IntRange(2),
        cls=RepeatableOption,
        multiple=True,
        metavar="N",
        help="Denoisers, and networks of halves such as guided_denoise, are also given the mean of N halves, of as "
        "many passes of the view (`top-up`); may be repeated.",
    ),
    click.option(
        "--samples",
        "most",
        type=click.IntRange(1),
        default=MOST_HELD_OUT,
        show_default=True,
        help="At most so many, each of a view of its own.",
    ),
    click.option(
        "--inception",
        type=click.Path(path_type=Path, dir_okay=False),
        metavar="FILE",
        help="Weights of FID's Inception network, for the references.  [default: those that are installed]",
    ),
    click.option(
        "--without-inception", is_flag=True, help="Leave out FID, KID and Feature L1, which take most of the time."
    ),
    device_option,
)
"""The options for what is measured, against what and where."""


def add_measuring_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add `MEASURING` to a verb; `_collect_arguments` takes all but the runs."""
    for option in reversed(MEASURING):
        command = option(command)
    return command


def _collect_arguments(
    denoisers: tuple[ReadyDenoiser, ...],
    kept: tuple[int, ...],
    references: Path | None,
    inception: Path | None,
    **others: Any,
) -> dict[str, Any]:
    """The arguments of `compare`: every denoiser with every share of the pixels. Raises UsageError."""
    if kept and not denoisers:
        raise click.UsageError("--kept applies only to ready denoisers; name one with --denoiser")
    if inception and references is None:
        raise click.UsageError(
            "--inception is used only to compare with references; give their folder with --references"
        )
    chosen = [*product(dict.fromkeys(denoisers), dict.fromkeys(kept or (1,)))]
    return {"denoisers": chosen, "references": references, "inception": inception, **others}


@click.command()
@add_measuring_options
@json_option
def evaluate(store: str | Path, runs: tuple[Path, ...], as_json: bool, **asked: Any) -> None:
    """Measure trained networks on views that none of them was trained on, each by its first sample.

    The linear error is mean squared, of radiance × exposure, against the clean images: the targets' noise is taken out.
    With references there are the columns of the paper too: of clip(exposure · I, 0, 1)^(1/2.2). In each run's folder
    this leaves evaluation.json, with every figure, and comparison.png, a few of the images side by side.
    """
    how = _collect_arguments(**asked)
    from photonfarm.trainer.compare.evaluate import compare
    from photonfarm.trainer.compare.evaluation_page import format_evaluation, write_evaluation
    from photonfarm.trainer.predictors.trained import TrainedRun

    loaded = [TrainedRun.load(run) for run in dict.fromkeys(runs)]
    from photonfarm.trainer.cli.show import show_progress

    with show_progress() as on_progress:
        evaluation = compare(store, loaded, on_progress=on_progress, **how)
    pictures = write_evaluation(evaluation, loaded)
    click.echo(json.dumps(evaluation.document(), indent=2) if as_json else format_evaluation(evaluation))
    click.echo(f"side by side: {', '.join(map(str, pictures))}", err=True)


@click.command()
@add_measuring_options
@click.option("--untimed", is_flag=True, help="Leave out the time of a frame, which asks for a quiet machine.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default="out", show_default=True)
@json_option
def report(store: str | Path, runs: tuple[Path, ...], untimed: bool, out: Path, as_json: bool, **asked: Any) -> None:
    """Write report.html and report.json: what was learned, at which cost, with pictures.

    Runs and denoisers are measured as by `evaluate`. Where the renderer is installed, the time of a frame is measured
    from the scene to the image; with references, the worst cases of the first run are found and shown.
    """
    how = _collect_arguments(**asked)
    from photonfarm.trainer.cli.show import show_progress
    from photonfarm.trainer.report import write_report

    with show_progress() as on_progress:
        figures = write_report(store, list(dict.fromkeys(runs)), out, on_progress=on_progress, timed=not untimed, **how)
    click.echo(figures["verdict"], err=True)
    if figures["val_mssim"] is not None:
        click.echo(
            f"as a display shows it, against the references: MSE {figures['val_mse_metric']:.4f}, MSSIM "
            f"{figures['val_mssim']:.3f}",
            err=True,
        )
    click.echo(f"side by side: {out / 'comparison.png'}", err=True)
    click.echo(json.dumps(figures, indent=2) if as_json else out / "report.html")
