"""Verbs about the samples of a store, and images like them: buffers, measure-frames, preview, render."""

from __future__ import annotations

import json
import math
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from photonfarm.cli.options import (
    arrangement_options,
    device_option,
    json_option,
    refuse_own_folder,
    start_options,
    store_option,
)
from photonfarm.core.errors import SpecError
from photonfarm.core.formatting import format_count
from photonfarm.core.processes import end_on_ctrl_c
from photonfarm.core.waiting import tell_waiting

if TYPE_CHECKING:
    from photonfarm.renderer.jobs.truth import Amount
    from photonfarm.scene.arrangement import Arrangement, Shot


def parse_amount(ctx: click.Context, param: click.Parameter, text: str | None) -> Amount | None:  # noqa: ARG001
    """How much an option asks to render; fails for text that says no amount."""
    from photonfarm.renderer.jobs.truth import Amount

    try:
        return None if text is None else Amount.parse(text)
    except SpecError as error:
        raise click.BadParameter(f"{error}.") from error


@click.command()
@click.argument("scene", metavar="SPEC_OR_SCENE")
@store_option
@click.option("--count", type=click.IntRange(1), default=24, show_default=True, help="Samples to show.")
@click.option("--out", type=click.Path(path_type=Path), default="preview.html", show_default=True)
def preview(scene: str, store: str | Path, count: int, out: Path) -> None:
    """Write a contact sheet of a scene's samples: plans of what stands where, A, B, albedo, normal, depth, photons.

    SPEC_OR_SCENE is a spec's file, or names a scene of the store by its id, how that begins, or its name.
    """
    if out.suffix not in (".html", ".htm"):
        raise click.BadParameter(f"{str(out)!r}: the sheet is a page; name it like preview.html", param_hint="--out")
    from photonfarm.renderer.tools.preview import write_contact_sheet
    from photonfarm.store import Store
    from photonfarm.store.read.find import scene_or_spec
    from photonfarm.store.read.reader import SceneReader

    write_contact_sheet(SceneReader(store, scene_or_spec(Store(store), scene).scene_id), count, out)
    click.echo(out)


@click.command()
@store_option
@click.option("--scene", required=True, metavar="ID", help="A scene of the store: its id, how it begins, or its name.")
@start_options
@arrangement_options(camera=False)
@click.option(
    "--camera-path",
    "path",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help='JSON: {"frames": 48, "views": [{"origin": [x, y, z], "look_at": [x, y, z]}, …], "closed": false}.',
)
@click.option("--orbit", type=click.IntRange(1, 10_000), metavar="FRAMES", help="Instead: once around the scene.")
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), default="buffers.npz", show_default=True)
@device_option
@end_on_ctrl_c()
def buffers(
    store: str | Path,
    scene: str,
    row: int | None,
    like: str | None,
    asked: Arrangement,
    path: Path | None,
    orbit: int | None,
    out: Path,
) -> None:
    """Write the buffers of views along a camera path, and the photons: what `photonfarm infer --buffers` shows.

    Nothing is written to the store. Views between those of the file lie on a Catmull–Rom spline through them.
    """
    from photonfarm.renderer.jobs.path_buffers import find_views, frames_of
    from photonfarm.scene.camera_path import CameraPath
    from photonfarm.scene.spec_loading import locate

    if (path is None) == (orbit is None):
        raise click.UsageError("one of --camera-path and --orbit is required")
    along = orbit or CameraPath.load(path or Path())
    with tell_waiting(partial(click.echo, err=True), f"rendering buffers of {scene}"):
        stored, configuration, views = find_views(store, scene, asked, along, row, like)
        cloud = stored.base()[1] if stored.has_base() else None
        frames = frames_of(locate(stored.spec), configuration, views, cloud)
        frames.write(out)
    click.echo(f"{out}: {format_count(len(frames), 'frame')}")


@click.command("measure-frames")
@store_option
@click.option("--scene", required=True, metavar="ID", help="A scene of the store: its id, how it begins, or its name.")
@click.option(
    "--row",
    "rows",
    type=click.IntRange(0),
    multiple=True,
    required=True,
    help="A complete sample, whose configuration and view are measured; may be repeated.",
)
@click.option(
    "--kept",
    type=click.IntRange(1),
    multiple=True,
    metavar="K",
    help="Time a half-estimate with one pixel in K kept, too; may be repeated.",
)
@click.option(
    "--halves",
    type=click.IntRange(2),
    multiple=True,
    metavar="N",
    help="Time an image of all pixels with the samples of N half-estimates; may be repeated.",
)
@click.option(
    "--timed",
    type=click.IntRange(1),
    default=9,
    show_default=True,
    metavar="FRAMES",
    help="Frames to time, after some that do not count.",
)
@click.option(
    "--seconds",
    type=click.FloatRange(0, min_open=True),
    default=math.inf,
    help="Begin no further frame after so much time, from the first that counts.  [default: no limit]",
)
@click.option(
    "--points",
    type=click.IntRange(1),
    metavar="P",
    help="Time the first P points of the base cloud, those that a network uses.  [default: all]",
)
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), default="frames.npz", show_default=True)
@device_option
@end_on_ctrl_c()
def measure_frames(
    store: str | Path,
    scene: str,
    rows: tuple[int, ...],
    kept: tuple[int, ...],
    halves: tuple[int, ...],
    timed: int,
    seconds: float,
    points: int | None,
    out: Path,
) -> None:
    """Measure what the parts of a frame cost here, on one core, and what kind of surface each pixel shows.

    Nothing is written to the store. Give rows of at least two configurations, so that edits are measured as between
    samples.
    """
    from photonfarm.renderer.scene import backend

    backend.load(threads=1)
    from photonfarm.renderer.tools.measure.frame_costs import write_frame_costs

    with tell_waiting(partial(click.echo, err=True), f"timing {format_count(timed, 'frame')}"):
        amounts = [*((k, 1) for k in kept), *((1, n) for n in halves)]
        costs = write_frame_costs(store, scene, rows, amounts, timed, points, out, seconds)
    parts = {**costs.parts(), **{f"render_s {n}/{k}": render for (k, n), render in costs.renders().items()}}
    click.echo(", ".join(f"{name} {seconds.median:.4f}" for name, seconds in parts.items()))
    click.echo(f"{out}: {format_count(len(rows), 'row')}, {format_count(len(costs.edit_s), 'timed frame')}")


@click.command()
@click.argument("scene", metavar="SPEC_OR_SCENE")
@store_option
@start_options
@arrangement_options()
@click.option(
    "--spp",
    "amount",
    metavar="SPP|TIME|ERROR",
    callback=parse_amount,
    help="Samples per pixel (256), for how long to render (20s), or until the image's own squared error is so small a "
    "share of its mean square (0.1%).  [default: 64]",
)
@click.option(
    "--pass",
    "pass_number",
    type=click.IntRange(0),
    metavar="P",
    help="With --row alone, another pass of its view, stored or not.  [default: that of the row]",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Write A and B to FILE.npz or FILE.exr, or a picture of their mean to FILE.png.",
)
@device_option
@json_option
@end_on_ctrl_c()
def render(
    scene: str,
    store: str | Path,
    row: int | None,
    like: str | None,
    asked: Shot,
    amount: Amount | None,
    pass_number: int | None,
    out: Path | None,
    as_json: bool,
) -> None:
    """Render any configuration from any camera by bdpt, or a stored sample again; the store stays as it is.

    What stands where is said by names; all others stay at rest, or as --row or --like has them.

    With --row alone, the sample is rendered again from its seeds, and compared with the stored one. On the same kind of
    processor, with the same versions, it is equal to the bit. Elsewhere it differs by rounding. What a card rendered,
    or renders here, is equal in distribution alone. Exit codes: 0 equal to the bit, or the store does not have this
    pass; 1 it differs, by no more than chance (a block z-test); 4 it differs by more.
    """
    from photonfarm.renderer.jobs import truth
    from photonfarm.renderer.jobs.repeat import repeat
    from photonfarm.scene.arrangement import Shot

    say = partial(click.echo, err=True)
    again = row is not None and (like, asked, amount) == (None, Shot(), None)
    if not again and pass_number is not None:
        raise click.UsageError("--pass: is of a stored sample, which --row alone renders again")
    if out is not None and out.suffix not in truth.SUFFIXES:
        raise click.BadParameter(f"{str(out)!r}: ends in none of {', '.join(truth.SUFFIXES)}", param_hint="--out")
    file = out or Path("render.png")
    if out is not None or not again:
        refuse_own_folder(file.parent)
        truth.check_file(file)
    if again:
        repeated = repeat(store, scene, row or 0, pass_number, say)
        if out is not None:
            repeated.write(out)
            say(f"written to {out}")
        document = {**repeated.document(), "files": [] if out is None else [str(out)]}
        click.echo(json.dumps(document, indent=1) if as_json else repeated.line())
        sys.exit(repeated.exit_code)
    with tell_waiting(say, f"rendering {scene}"):
        image = truth.render_asked(store, scene, asked, row, like, amount or truth.Amount(spp=64))
    for doubt in image.doubts:
        say(f"warning: {doubt}")
    image.write(file)
    say(f"written to {file}")
    click.echo(json.dumps({**image.document(), "files": [str(file)]}, indent=1) if as_json else image.line())
