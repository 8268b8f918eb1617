"""The verb infer."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import click

from photonfarm.cli.options import store_option
from photonfarm.core.waiting import tell_waiting
from photonfarm.trainer.cli.evaluation_verbs import device_option
from photonfarm.trainer.cli.train_verb import run_option


@click.command()
@store_option
@run_option
@click.option("--row", type=click.IntRange(0), help="The sample in a row of the store.")
@click.option("--view", metavar="VECTOR|KEY", help="The sample of this view, as `store find` takes it.")
@click.option(
    "--modification",
    metavar="VECTOR|KEY",
    help="And of this configuration; of a path its configuration, which otherwise is the scene at rest.",
)
@click.option(
    "--camera-path",
    "path",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    metavar="FILE",
    help="Views along a path in JSON, as `photonfarm buffers` takes it.",
)
@click.option("--orbit", type=click.IntRange(1, 10_000), metavar="FRAMES", help="Views once around the scene.")
@click.option(
    "--buffers",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Views whose buffers `photonfarm buffers` wrote, on a machine with the renderer.",
)
@click.option("--fps", type=click.FloatRange(1, 50), default=12.0, show_default=True, help="Frames a second of a path.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default="out", show_default=True)
@device_option
def infer(
    store: str | Path,
    run: Path,
    row: int | None,
    view: str | None,
    modification: str | None,
    path: Path | None,
    orbit: int | None,
    buffers: Path | None,
    fps: float,
    out: Path,
    device: str,
) -> None:
    """Show a trained network's image of one sample, or of a camera path: PNG, GIF and, with its extra, MP4.

    The views of a path are in no store: their inputs are rendered, where the renderer is installed, or a file has them.
    """
    from photonfarm.predict import infer as shows
    from photonfarm.predict.opened_run import OpenRun, require_renderer
    from photonfarm.scene.camera_path import CameraPath, Frames
    from photonfarm.trainer.predictors.trained import TrainedRun

    kinds = {"--row": row, "--view": view, "--camera-path": path, "--orbit": orbit, "--buffers": buffers}
    given = [name for name, value in kinds.items() if value is not None]
    if len(given) > 1 or not (given or modification):
        several = f"; {' and '.join(given)} exclude each other" if given else ""
        raise click.UsageError(f"name what to show by one of {', '.join(kinds)}, or by --modification{several}")
    if modification and given in (["--row"], ["--buffers"]):
        raise click.UsageError(f"{given[0]} has a configuration; --modification cannot give it another one")
    along = orbit or (CameraPath.load(path) if path else None)
    if isinstance(along, CameraPath):
        along.sample()  # a faulty one is refused before anything is loaded
    trained = TrainedRun.load(run)
    if along is not None:
        require_renderer(trained)
        from photonfarm.renderer.jobs.path_buffers import find_views

        _, configuration, views = find_views(store, trained.scene_id, modification, along)
        with tell_waiting(partial(click.echo, err=True), f"rendering {len(views)} frames of {trained.scene_id}"):
            result = shows.show_path(OpenRun(trained, store, device), configuration, views, out, fps=fps)
    elif buffers is not None:
        result = shows.show_frames(store, trained, Frames.read(buffers), out, fps=fps, device=device)
    else:
        chosen = shows.find_row(store, trained, modification, view) if row is None else row
        result = shows.show_sample(store, trained, chosen, out, device)
    for file in result.files:
        click.echo(file)
    click.echo(result.sentence, err=True)
