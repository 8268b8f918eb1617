"""The verbs infer, live and pack."""

from __future__ import annotations

import os
import shlex
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

from photonfarm.cli.options import (
    address_options,
    arrangement_options,
    json_option,
    refuse_own_folder,
    shot_file_options,
    start_options,
    store_option,
)
from photonfarm.core.formatting import format_bytes, format_count
from photonfarm.core.processes import end_on_ctrl_c
from photonfarm.core.waiting import tell_waiting
from photonfarm.renderer.cli.sample_verbs import parse_amount
from photonfarm.trainer.cli.evaluation_verbs import device_option

if TYPE_CHECKING:
    from photonfarm.predict.infer_result import InferResult
    from photonfarm.renderer.jobs.truth import Amount
    from photonfarm.scene.arrangement import Shot


LIVE_PORT = 8430

run_option = click.option(
    "--run",
    type=click.Path(path_type=Path),
    envvar="PHOTONFARM_RUN",
    default="run",
    show_default=True,
    help="Folder of the training run, or a network on its own, as `photonfarm pack` wrote it.",
)


def _refuse_store(run: Path, **asked: object) -> None:
    """Refuse options that need a store, and a store that is named, for a network on its own."""
    asked["store"] = click.get_current_context().get_parameter_source("store") is ParameterSource.COMMANDLINE
    if run.is_file() and (given := [name for name, value in asked.items() if value not in (None, False)]):
        options = " and ".join(f"--{name.replace('_', '-')}" for name in given)
        raise click.UsageError(f"{options}: {run} is a network on its own, and knows no store")


@click.command()
@store_option
@run_option
@start_options
@arrangement_options()
@click.option(
    "--truth",
    "amount",
    metavar="SPP|TIME|ERROR",
    callback=parse_amount,
    help="Render it by bdpt beside the network's image: with so many samples per pixel (256), for so long (20s), or "
    "until its own squared error is so small a share of its mean square (0.1%).",
)
@click.option("--store-it", is_flag=True, help="Plan it as a sample, too; else the store stays as it is.")
@shot_file_options
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
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default="shown", show_default=True)
@device_option
@json_option
def infer(
    store: str | Path,
    run: Path,
    row: int | None,
    like: str | None,
    asked: Shot,
    amount: Amount | None,
    store_it: bool,
    cameras: Path | None,
    configurations: Path | None,
    path: Path | None,
    orbit: int | None,
    buffers: Path | None,
    fps: float,
    out: Path,
    device: str,
    as_json: bool,
) -> None:
    """Show a trained network's image of any configuration and camera, of a stored sample, or along a camera path.

    What stands where is said by names; all others stay at rest, or as --row or --like has them. --row alone shows the
    sample that is stored. Inputs are rendered where the renderer is installed; for a path, a file may have them. PNG,
    NPZ, JSON and, with the package OpenEXR, EXR; of a path PNG, GIF, JSON and, with the extra `video`, MP4.

    --configurations and --cameras show all that files say, each in a folder: a configuration by its own camera, or by
    all of --cameras, or by that of the other options. --json prints what frame.json holds, and of several a list.
    """
    from photonfarm.scene.arrangement import Arrangement, Shot
    from photonfarm.scene.camera_path import CameraPath, Frames

    began = time.perf_counter()
    files = cameras or configurations
    read = [file for file in (cameras, configurations, path, buffers) if file]
    kinds = {"--camera-path": path, "--orbit": orbit, "--buffers": buffers}
    kinds |= {"--cameras" if cameras else "--configurations": files}
    given = [name for name, value in kinds.items() if value is not None]
    of_frame: dict[str, object] = {"--store-it": store_it or None, "--truth": amount if buffers else None}
    if given != ["--configurations"]:
        of_frame |= {"--camera": asked.camera, "--look-at": asked.look_at, "--fov": None if files else asked.fov}
    alone = [name for name, value in of_frame.items() if value is not None]
    arranged = like is not None or asked != Shot() or amount is not None or store_it
    if len(given) > 1 or (given and alone) or (buffers is not None and (arranged or row is not None)):
        others = [*given, *alone] if len(given) > 1 or alone else [*given, "what stands where"]
        raise click.UsageError(f"{' and '.join(others)} exclude each other")
    _refuse_store(run, row=row, like=like, store_it=store_it)
    refuse_own_folder(out)
    frames = Frames.read(buffers) if buffers else None
    along = orbit or (CameraPath.load(path) if path else None)
    if isinstance(along, CameraPath):
        along.sample()  # a faulty one is refused before anything is loaded
    from photonfarm.core.files import make_folder
    from photonfarm.plan.chosen import Chosen
    from photonfarm.predict import infer as shows
    from photonfarm.predict.infer_result import list_made, remove_made
    from photonfarm.predict.opened_run import OpenRun, require_renderer
    from photonfarm.scene.shot_files import read_shots
    from photonfarm.store.read.find import find_start
    from photonfarm.trainer.predictors.trained import TrainedRun

    trained, before = TrainedRun.load(run), list_made(out)
    if not trained.packed:  # else a folder of it must be removed in the end
        click.get_current_context().with_resource(end_on_ctrl_c())
    shown: list[InferResult] = []

    def tell(result: InferResult, where: str = "") -> None:
        """Keep a result, and say it, unless all are said as JSON in the end."""
        shown.append(result)
        for doubt in result.about["doubts"]:
            click.echo(f"warning: {where}{doubt}", err=True)
        if not as_json:
            for line in (*result.files, f"{where}{result.sentence}"):
                click.echo(line)

    if frames is not None:
        tell(shows.show_frames(store, trained, frames, out, fps=fps, device=device))
    elif row is not None and not arranged and not given:
        tell(shows.show_sample(store, trained, row, out, device))
    else:
        require_renderer(trained)
        from photonfarm.renderer.jobs.path_buffers import list_views

        spec = trained.scene(store).spec
        begin, camera = find_start(store, trained.scene_id, row, like) or (None, None)
        configuration, view = asked.apply(spec, begin), asked.view(spec, camera)
        shots = [(configuration, view)]
        if along is not None:
            changes = Arrangement.of(**asked.model_dump(include=set(Arrangement.model_fields)))
            configuration, views = list_views(spec, changes, along, begin)
            shots = [(configuration, each) for each in views]
        elif files is not None:
            shots = read_shots(spec, cameras, configurations, configuration, otherwise=view, fov=asked.fov)
        elif store_it:
            Chosen.of(spec, configuration, view)  # a view that no sample can have is refused before anything is loaded
        make_folder(out, "write the pictures")
        count = f"{format_count(len(shots), 'image')} of " if given else ""
        say = partial(click.echo, err=True)
        with tell_waiting(say, f"rendering {count}{spec.name}"):
            opened = OpenRun(trained, store, device)
            say(f"loaded in {time.perf_counter() - began:.3g} s")
            if along is not None:
                tell(shows.show_path(opened, configuration, views, out, fps=fps, amount=amount))
            for number, shot in enumerate(shots if along is None else []):
                name = f"frame-{number:04}" if files else ""
                result = shows.show_frame(opened, *shot, out / name, amount, store_it=store_it)
                tell(result, f"{name}: " if files else "")
    if removed := remove_made(before - {file for result in shown for file in result.files}, read):
        names = ", ".join(str(file.relative_to(out)) for file in removed)
        click.echo(f"removed from {out}, as they showed something else: {names}", err=True)
    if as_json:
        from photonfarm.cli.show import print_json

        print_json([result.document() for result in shown] if files else shown[0].document())
    if store_it and not shown[0].about["planned"]["complete"]:
        work = shlex.join(["photonfarm", "work", "--store", str(store), "--share", "0/1", "--until-complete"])
        click.echo(f"workers render it; where none is at work, this does: {work}", err=True)


@click.command()
@store_option
@run_option
@device_option
@address_options
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    help=f"[default: {LIVE_PORT}, or a free one if that is taken]",
)
@click.option(
    "--truth", "most_spp", type=click.IntRange(1), default=4096, show_default=True, help="Most samples per pixel."
)
@click.option("--may-submit", is_flag=True, help="Let whoever reaches the page plan what it shows as a sample.")
def live(
    store: str | Path,
    run: Path,
    device: str,
    host: str,
    names: tuple[str, ...],
    port: int | None,
    most_spp: int,
    may_submit: bool,
) -> None:
    """Serve a page on which furniture, lamps and the camera are dragged: the network's picture beside the truth.

    The network's picture follows each move; as soon as nothing moves, `bdpt` renders the truth, and the error between
    both stands below. Nothing is written without --may-submit. Ends on Ctrl-C.
    """
    _refuse_store(run, may_submit=may_submit)
    from photonfarm.predict.live import Live
    from photonfarm.predict.opened_run import OpenRun
    from photonfarm.trainer.predictors.trained import TrainedRun
    from photonfarm.web.server import listen, serve

    trained, say = TrainedRun.load(run), partial(click.echo, err=True)
    server = listen(host, port, names, usual=LIVE_PORT, warn=say)
    stored = "" if trained.packed else f"--store {shlex.quote(str(store))} "
    begins = f"photonfarm infer {stored}--run {shlex.quote(str(run))}"
    with tell_waiting(say, f"loading {trained.name}"):
        shown = Live(lambda: OpenRun(trained, store, device), most_spp, begins, may_submit)
    say(shown.run.describe())
    say(
        f"whoever reaches the page may plan samples in {store}"
        if may_submit
        else "read-only; --may-submit plans samples"
    )
    say("Ctrl-C ends it")
    serve(server, shown.routes(), click.echo, writes=shown.writes())


@click.command()
@store_option
@run_option
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    default="network.photonfarm",
    show_default=True,
    help="A file that ends in .photonfarm; or in .onnx: the network alone, as ONNX.",
)
def pack(store: str | Path, run: Path, out: Path) -> None:
    """Write a trained network as one file, from which `infer`, `live` and `open_run` predict on any machine.

    It has weights, settings, the scene with its files, and the point cloud; neither samples nor the state of training.
    With --out NAME.onnx it is the network alone, whose inputs are named as in `photonfarm.data`.
    """
    from photonfarm.farm.training import ALONE, ONNX

    if out.suffix not in (ALONE, ONNX):
        raise click.BadParameter(f"{str(out)!r}: ends neither in {ALONE} nor in {ONNX}", param_hint="--out")
    from photonfarm.trainer.predictors.network_file import write_network
    from photonfarm.trainer.predictors.onnx_file import write_onnx
    from photonfarm.trainer.predictors.trained import TrainedRun
    from photonfarm.trainer.runs.run_folder import make_environment

    trained = TrainedRun.load(run)
    os.environ.update(make_environment(run))
    write = write_onnx if out.suffix == ONNX else write_network
    with tell_waiting(partial(click.echo, err=True), f"writing {out.name}"):
        write(trained, store, out)
    click.echo(f"{out}: {trained.name}, {format_bytes(out.stat().st_size)}")
