"""Verbs of the renderer: buffers, doctor, measure-frames, preview, render, report, scene …, work."""

from __future__ import annotations

import json
import math
import re
import sys
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Any

import click

from photonfarm.shared.cli.options import json_option, redis_option, store_option
from photonfarm.shared.core.processes import ended_by_ctrl_c
from photonfarm.shared.core.waiting import waiting


@click.command()
@store_option
@redis_option
@json_option
def doctor(store: str | Path, redis_url: str, as_json: bool) -> None:
    """Try each part on this machine, and say what to do about what does not work."""
    from photonfarm.renderer.tools.doctor import examine
    from photonfarm.shared.cli import show

    sys.exit(show.findings(examine(store, redis_url, partial(click.echo, err=True)), as_json))


def _bytes(ctx: click.Context, param: click.Parameter, size: str) -> int:  # noqa: ARG001
    found = re.fullmatch(r"(\d+(?:\.\d+)?) *([kMGT]?)B?", size.strip())
    if found is None:
        raise click.BadParameter(f"{size!r} is not a size; write it like 500MB or 2GB")
    return int(float(found[1]) * 1000 ** " kMGT".index(found[2] or " "))


@click.command()
@store_option
@redis_option
@click.option("--name", help="Name of this worker, distinct among all.  [default: host and process]")
@click.option("--scene", "scene_id", metavar="ID",
              help="Work for this scene alone: its id, how it begins, or its name.")  # fmt: skip
@click.option("--job", type=click.IntRange(0), help="Render this one job of --scene here, without Redis, and end.")
@click.option("--until-complete", is_flag=True, help="Stop when nothing is missing.")
@click.option(
    "--reserve",
    "reserve_bytes",
    callback=_bytes,
    default="1GB",
    show_default=True,
    metavar="SIZE",
    help="Take no job while less of the store's disk is free.",
)
@click.option(
    "--ahead", type=click.FloatRange(1), metavar="RATIO",
    help="Take no job of a scene while more of its samples are committed than RATIO × those that its trainer has used. "
    "About the first 256 of a scene may always be (jobs are taken and finished whole, by each worker); without a "
    "trainer it stops there. Values below 1 would stop rendering for ever.",
)  # fmt: skip
@click.option(
    "--deadline", "deadline_s", type=click.FloatRange(0, min_open=True), default=1800.0, show_default=True,
    metavar="SECONDS", help="End a job that takes longer; it is started up to five times. A worker that was "
    "stopped (SIGSTOP) for so long ends its job when it goes on; others have taken it over by then.",
)  # fmt: skip
@click.option("--quiet", is_flag=True, help="Say only what is wrong.")
@click.option("--check", is_flag=True, help="Only say whether a worker of this host is alive (exit 0) or not (7).")
def work(
    store: str | Path,
    redis_url: str,
    scene_id: str | None,
    job: int | None,
    check: bool,
    **settings: Any,
) -> None:
    """Render queued jobs into the store, on one core, until asked to stop; start one per core.

    A store that does not exist is waited for; --until-complete ends with exit code 4 then. One Redis serves one store.
    Ctrl-C gives the job in hand 5 s to end, a second one ends it at once; it is rendered again then.
    """
    from photonfarm.renderer.worker import worker

    if check:
        worker.check(redis_url)
    elif job is None:
        worker.run_worker(store, redis_url, scene_id=scene_id, **settings)
    elif scene_id is None:
        raise click.UsageError("--job needs --scene: jobs are numbered within a scene")
    else:
        rendered, seconds = worker.render_job(store, scene_id, job)
        click.echo(f"job {job} rendered and committed in {seconds:.1f} s" if rendered else f"job {job} is committed")


@click.command()
@click.argument("spec")
@store_option
@click.option("--count", type=click.IntRange(1), default=24, show_default=True, help="Samples to show.")
@click.option("--out", type=click.Path(path_type=Path), default="preview.html", show_default=True)
def preview(spec: str, store: str | Path, count: int, out: Path) -> None:
    """Write a contact sheet of SPEC's samples: plans of what stands where, A, B, albedo, normal, depth, photons."""
    if out.suffix not in (".html", ".htm"):
        raise click.BadParameter(f"{str(out)!r}: the sheet is a page; name it like preview.html", param_hint="--out")
    from photonfarm.renderer.tools.preview import write_contact_sheet
    from photonfarm.shared.scene.spec_loading import load_spec
    from photonfarm.shared.store.read.other_scenes import scene_of
    from photonfarm.shared.store.read.reader import SceneReader

    write_contact_sheet(SceneReader(store, scene_of(store, spec, load_spec(spec))), count, out)
    click.echo(out)


@click.command()
@store_option
@click.option("--scene", required=True, metavar="ID", help="A scene of the store: its id, how it begins, or its name.")
@click.option(
    "--modification", metavar="VECTOR|KEY", help="The configuration, as `store find` takes it.  [default: at rest]"
)
@click.option(
    "--camera-path",
    "path",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help='JSON: {"frames": 48, "views": [{"origin": [x, y, z], "look_at": [x, y, z]}, …], "closed": false}.',
)
@click.option("--orbit", type=click.IntRange(1, 10_000), metavar="FRAMES", help="Instead: once around the scene.")
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), default="buffers.npz", show_default=True)
@ended_by_ctrl_c()
def buffers(
    store: str | Path, scene: str, modification: str | None, path: Path | None, orbit: int | None, out: Path
) -> None:  # fmt: skip
    """Write the buffers of views along a camera path, and the photons: what `photonfarm infer --buffers` shows.

    Nothing is written to the store. Views between those of the file lie on a Catmull–Rom spline through them.
    """
    from photonfarm.renderer.jobs.path_buffers import write_buffers
    from photonfarm.shared.scene.camera_path import CameraPath

    if (path is None) == (orbit is None):
        raise click.UsageError("one of --camera-path and --orbit is required")
    along = orbit or CameraPath.load(path or Path())
    with waiting(partial(click.echo, err=True), f"rendering buffers of {scene}"):
        frames = write_buffers(store, scene, modification, along, out)
    click.echo(f"{out}: {frames} frames")


@click.command("measure-frames")
@store_option
@click.option("--scene", required=True, metavar="ID", help="A scene of the store: its id, how it begins, or its name.")
@click.option("--row", "rows", type=click.IntRange(0), multiple=True, required=True,
              help="A complete sample, whose configuration and view are measured; may be repeated.")  # fmt: skip
@click.option("--kept", type=click.IntRange(1), multiple=True, default=(1,), show_default=True, metavar="K",
              help="Time a half-estimate of one of K pixels; may be repeated.")  # fmt: skip
@click.option("--timed", type=click.IntRange(1), default=9, show_default=True, metavar="FRAMES",
              help="Frames to time, after some that do not count.")  # fmt: skip
@click.option("--points", type=click.IntRange(1), metavar="P",
              help="Time the first P points of the base cloud, those that a network uses.  [default: all]")  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), default="frames.npz", show_default=True)
@ended_by_ctrl_c()
def measure_frames(
    store: str | Path,
    scene: str,
    rows: tuple[int, ...],
    kept: tuple[int, ...],
    timed: int,
    points: int | None,
    out: Path,
) -> None:
    """Measure what the parts of a frame cost here, on one core, and what kind of surface each pixel shows.

    Nothing is written to the store. Give rows of at least two configurations, so that edits are measured as between
    samples.
    """
    from photonfarm.renderer.scene import backend

    backend.load(threads=1)
    from photonfarm.renderer.measure.frame_costs import write_frame_costs

    with waiting(partial(click.echo, err=True), f"timing {timed} frames"):
        costs = write_frame_costs(store, scene, rows, kept, timed, points, out)
    parts = {**costs.medians(), **{f"render_s 1/{k}": s for k, s in costs.render_medians().items()}}
    click.echo(", ".join(f"{name} {seconds:.4f}" for name, seconds in parts.items()))
    click.echo(f"{out}: {len(rows)} rows, {timed} timed frames")


@click.command()
@click.argument("spec")
@click.option(
    "--seconds",
    type=click.IntRange(1, 86400),
    default=60,
    show_default=True,
    help="Processor time for all of it, with loading and compiling; a kept measurement is reused if it was given at "
    "least as long.",
)
@click.option("--write", is_flag=True, help="Put what gains into SPEC's file; samples planned before keep theirs.")
@click.option("--again", is_flag=True, help="Measure anew, also if this scene has been measured here.")
@json_option
@ended_by_ctrl_c()
def scene_plan(spec: str, seconds: int, write: bool, again: bool, as_json: bool) -> None:
    """Choose how SPEC's light is sampled: by its content, and by a short measurement of error and time."""
    from photonfarm.renderer.scene import backend
    from photonfarm.shared.scene.spec_loading import find_spec, load_spec

    loaded = load_spec(spec)
    backend.load(threads=1)
    from photonfarm.renderer.strategy.output import spec_file
    from photonfarm.renderer.strategy.output.printed import lines
    from photonfarm.renderer.strategy.plan import make_plan

    file = spec_file.writable(spec) if write else find_spec(spec)
    plan = make_plan(loaded, file.parent, seconds=seconds, again=again, log=partial(click.echo, err=True))
    click.echo(json.dumps(plan.document(), indent=2) if as_json else "\n".join(lines(plan)))
    if write:
        if plan.changes:
            spec_file.write(file, plan.changes)
        for table in plan.settings:
            click.echo(f"{file}: [{table}] {'written' if table in plan.changes else 'stays as it is'}", err=True)


@click.command()
@click.argument("spec")
@click.option("--frames", type=click.IntRange(1, 1000), default=6, show_default=True,
              help="Random configurations to measure, a view of each, after some that do not count.")  # fmt: skip
@click.option("--seconds", type=click.FloatRange(0, min_open=True),
              help="Processor time for all of it; less of it, fewer views.  [default: no limit]")  # fmt: skip
@click.option("--again", is_flag=True, help="Measure anew, also if this scene has been measured here.")
@json_option
@ended_by_ctrl_c()
def scene_cost(spec: str, frames: int, seconds: float | None, again: bool, as_json: bool) -> None:
    """Measure what samples of SPEC cost on this machine, in core-seconds, and how noisy they are.

    Half a minute for a small room, minutes for a large one. `configuration` is taken by each configuration, `view` by
    each view of it, `pass` by each sample of such a view, and `spp` by each sample per pixel of that.
    """
    from photonfarm.renderer.scene import backend
    from photonfarm.shared.scene.spec_loading import find_spec, load_spec

    loaded = load_spec(spec)
    backend.load(threads=1)
    from photonfarm.renderer.measure.sample_costs import find_or_measure

    log = partial(click.echo, err=True)
    limit = math.inf if seconds is None else seconds
    costs = find_or_measure(loaded, find_spec(spec).parent, frames, again=again, log=log, seconds=limit)
    click.echo(costs.json() if as_json else costs.line())


@click.command()
@click.argument("spec")
@click.option("--target", type=click.FloatRange(0, 1, min_open=True, max_open=True), default=0.45, show_default=True,
              help="Display mean: that of clip(exposure · I, 0, 1)^(1/2.2) over all pixels.")  # fmt: skip
@click.option("--frames", type=click.IntRange(2, 1000), default=24, show_default=True,
              help="Random configurations to render, a view of each.")  # fmt: skip
@json_option
@ended_by_ctrl_c()
def scene_exposure(spec: str, target: float, frames: int, as_json: bool) -> None:
    """Propose an exposure for SPEC, from a quick render of random views; nothing is written.

    How far views differ in brightness decides how well it is known; more of them help.
    """
    from photonfarm.renderer.scene import backend
    from photonfarm.shared.scene.spec_loading import find_spec, load_spec

    loaded = load_spec(spec)
    backend.load(threads=1)
    from photonfarm.renderer.measure.exposure import propose

    log = partial(click.echo, err=True)
    with waiting(log, f"proposing an exposure for {loaded.name}"):
        found = propose(loaded, find_spec(spec).parent, log, target=target, frames=frames)
    click.echo(json.dumps(found.document(), indent=1) if as_json else found.line())


@click.command()
@click.argument("spec")
@click.option("--write", is_flag=True, help="Put it into SPEC's file; the scene then has another id, and new views.")
@json_option
@ended_by_ctrl_c()
def scene_free_space(spec: str, write: bool, as_json: bool) -> None:
    """Measure where SPEC's cameras may stand: in the open, by rays, and in no movable group's box.

    With it in the spec, `submit` plans no view from inside a solid or from outside the room, and camera paths are kept
    out of them.
    """
    from photonfarm.renderer.scene import backend
    from photonfarm.shared.scene.spec_loading import find_spec, load_spec

    loaded = load_spec(spec, measured_again=True)
    backend.load(threads=1)
    from photonfarm.renderer.measure.free_cells import measure
    from photonfarm.renderer.strategy.output import spec_file

    file = spec_file.writable(spec) if write else find_spec(spec)
    found = measure(loaded, file.parent, partial(click.echo, err=True))
    click.echo(json.dumps(found.entry()) if as_json else found.line())
    if write:
        spec_file.write(file, {"view": {"free_space": found.entry()}})
        click.echo(f"{file}: [view.free_space] written", err=True)


@click.command()
@click.argument("path", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), metavar="SPEC",
              help="The spec to write; the scene goes into a folder beside it.  [default: as PATH]")  # fmt: skip
@click.option("--up", type=click.Choice(["x", "y", "z"]),
              help="The axis that points up.  [default: as the file says, or else y]")  # fmt: skip
@json_option
def scene_import(path: Path, out: Path | None, up: str | None, as_json: bool) -> None:
    """Make a spec of a scene of another program, and a copy of the scene that photonfarm can render.

    PATH is a scene of Mitsuba (.xml, of versions 0.6 to 3), glTF (.gltf, .glb) or OBJ (.obj, with its .mtl), or what
    Blender reads (.blend, .usd, .fbx), where there is one: docs/own-scene.md says how. Furniture, lights, views and the
    exposure are proposed; all of it can be changed in the spec.
    """
    from photonfarm.renderer.scene import backend

    backend.load(threads=1)
    from photonfarm.renderer.importing.importer import AXES, import_scene

    made = import_scene(path, out, None if up is None else AXES[up], partial(click.echo, err=True))
    if as_json:
        click.echo(json.dumps(made.document(), indent=1))
        return
    for line in (*made.notes, *made.found):
        click.echo(line)
    command = f"photonfarm up {quote(str(made.spec))} --modifications 64"
    click.echo(f"{made.spec} and {made.folder} are written; see it by: {command}")


@click.command()
@click.option("--quick", is_flag=True, help="Small images, mostly one pair of settings: about two minutes.")
@click.option("--only", multiple=True, metavar="ROW", help="This row (1 … 36) or scene alone; may be repeated.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="First seed; 0 is a seed.")
@click.option("--threads", type=click.IntRange(1), default=1, show_default=True, help="Threads of Dr.Jit.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default="stability", show_default=True,
              help="Folder of stability.md, stability.json, stability.png and, of failures, the renders.")  # fmt: skip
@ended_by_ctrl_c()
def report_stability(quick: bool, only: tuple[str, ...], seed: int, threads: int, out: Path) -> None:
    """Render 36 rows of hard scenes with `bdpt` and compare each with its truth; exit code 1 if one fails."""
    from photonfarm.renderer.scene import backend

    backend.load(threads)
    from photonfarm.renderer.verify import report, rows

    try:
        scenes = rows.chosen(only, quick=quick)
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="--only") from error
    out.mkdir(parents=True, exist_ok=True)  # now: what cannot be written should not be rendered first
    found = report.examine(scenes, quick=quick, seed=seed, failures=out / "failures", log=partial(click.echo, err=True))
    arguments = ["--quick"] * quick + [f"--only {row}" for row in only] + [f"--seed {seed}"] * (seed != 0)
    report.write(found, out, " ".join(["photonfarm report stability", *arguments]))
    click.echo(out / "stability.md")
    sys.exit(0 if found.passed else 1)


@click.command()
@click.argument("scene", metavar="SPEC_OR_SCENE")
@store_option
@click.option("--row", type=click.IntRange(0), required=True, help="A sample, by its row in the store.")
@click.option("--pass", "pass_number", type=click.IntRange(0), metavar="P",
              help="Another pass of its view, stored or not.  [default: that of the row]")  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE",
              help="Also write A and B to FILE.npz or FILE.exr, or a picture of their mean to FILE.png.")  # fmt: skip
@json_option
def render(scene: str, store: str | Path, row: int, pass_number: int | None, out: Path | None, as_json: bool) -> None:
    """Render a sample again, from its seeds, and compare it with the stored one; the store stays as it is.

    On the same kind of machine, with the same versions, it is equal to the bit. Elsewhere it differs by rounding.

    Exit codes: 0 equal to the bit, or the store does not have this pass; 1 it differs, by no more than chance (a block
    z-test); 4 it differs by more.
    """
    from photonfarm.renderer.jobs.repeat import check_suffix, repeat

    if out is not None:
        check_suffix(out)
    found = repeat(store, scene, row, pass_number, partial(click.echo, err=True))
    if out is not None:
        found.write(out)
        click.echo(f"written to {out}", err=True)
    click.echo(json.dumps(found.document(), indent=1) if as_json else found.line())
    sys.exit(found.exit_code)


@click.command()
@click.argument("spec")
@json_option
@ended_by_ctrl_c()
def scene_shapes(spec: str, as_json: bool) -> None:
    """List the shapes of SPEC, or of a Mitsuba scene file (.xml): ids, groups, materials, triangles, lights, boxes."""
    from photonfarm.renderer.check import shapes
    from photonfarm.shared.cli import show

    found = shapes.listed(spec)
    if as_json:
        show.print_json([shape.document() for shape in found])
        return
    show.print_table((shape.row() for shape in found), shapes.HEAD)
    unnamed = sum(not shape.id for shape in found)
    if unnamed:
        click.echo(f"{unnamed} of {len(found)} shapes have no id, without which no group can name them", err=True)


@click.command()
@click.argument("spec")
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), default="check.html", show_default=True,
              help="The page.")  # fmt: skip
@json_option
@ended_by_ctrl_c()
def scene_check(spec: str, out: Path, as_json: bool) -> None:
    """Look at SPEC and its scene, and say what cannot be right: a page (HTML), and each finding with its line.

    The page shows plan and elevation, sixteen random configurations, every shape, and what cameras see. Nothing is
    written to a store. The exit code is 0 whatever is found, as long as the spec can be used.
    """
    if out.suffix not in (".html", ".htm"):
        raise click.BadParameter(f"{str(out)!r}: it is a page; name it like check.html", param_hint="--out")
    from photonfarm.renderer.scene import backend
    from photonfarm.shared.cli import show
    from photonfarm.shared.scene.spec_lines import SpecLines
    from photonfarm.shared.scene.spec_loading import find_spec, load_spec

    loaded, file = load_spec(spec), find_spec(spec)
    backend.load()
    from photonfarm.renderer.check import page, scene_check

    check, lines = scene_check.check(loaded, file.parent, partial(click.echo, err=True)), SpecLines.of(file)
    page.write(check, lines, out)
    if as_json:
        show.print_json([finding.document(lines) for finding in check.findings])
        return
    for finding in check.findings:
        click.echo(f"{'warning' if finding.serious else 'note'}: {finding.line(lines)}")
    click.echo(f"{out}: {len(check.findings) or 'no'} finding{'' if len(check.findings) == 1 else 's'}")
