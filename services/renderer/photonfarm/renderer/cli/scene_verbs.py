"""Verbs of scenes: `check`, `import`, `shapes` show or make one; `cost`, `exposure`, `free-space`, `plan` measure."""

from __future__ import annotations

import json
import math
from functools import partial
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

import click

from photonfarm.cli.options import device_option, json_option, shot_file_options
from photonfarm.core.processes import end_on_ctrl_c
from photonfarm.core.waiting import WorkLog, tell_waiting

if TYPE_CHECKING:
    from photonfarm.scene.spec import SceneSpec


@click.command()
@click.argument("path", type=click.Path(path_type=Path))
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="SPEC",
    help="The spec to write; the scene goes into a folder beside it.  [default: in this folder, named as PATH]",
)
@click.option(
    "--up", type=click.Choice(["x", "y", "z"]), help="The axis that points up.  [default: as the file says, or else y]"
)
@click.option(
    "--accept",
    multiple=True,
    metavar="NAME",
    help="A change of the picture that may be made: by its name, as the refusal gives it; geometry, light or "
    "colour for all of a kind. May be given several times.",
)
@json_option
def scene_import(path: Path, out: Path | None, up: str | None, accept: tuple[str, ...], as_json: bool) -> None:
    """Make a spec of a scene of another program, and a copy of the scene that photonfarm can render.

    PATH is a scene of Mitsuba (.xml, of versions 0.6 to 3), glTF (.gltf, .glb) or OBJ (.obj, with its .mtl), or what
    Blender reads (.blend, .usd, .fbx), where there is one: docs/own-scene.md says how. Furniture, lights, views and the
    exposure are proposed; all of it can be changed in the spec.

    What the file says and photonfarm cannot render is said. Where the picture would differ for it, nothing is written,
    unless --accept names it.
    """
    from photonfarm.cli import show
    from photonfarm.renderer.scene import backend

    backend.load(threads=1)
    from photonfarm.renderer.tools.importing.importer import AXES, import_scene

    made = import_scene(path, out, None if up is None else AXES[up], partial(click.echo, err=True), accept)
    if as_json:
        show.print_json(made.document())
        return
    for line in (*map(str, made.changes), *made.found):
        click.echo(line)
    shown = quote(str(made.spec.with_name(f"{made.spec.stem}-out")))
    command = f"photonfarm up {quote(str(made.spec))} --modifications 64 --train-steps 0 --out {shown}"
    click.echo(f"{made.spec} and {made.folder} are written; see it by: {command}")


@click.command()
@click.argument("spec")
@click.option(
    "--out", type=click.Path(path_type=Path, dir_okay=False), default="check.html", show_default=True, help="The page."
)
@shot_file_options
@device_option
@json_option
@end_on_ctrl_c()
def scene_check(spec: str, out: Path, cameras: Path | None, configurations: Path | None, as_json: bool) -> None:
    """Look at SPEC and its scene, and say what cannot be right: a page (HTML), and each finding with its line.

    The page shows plan and elevation, sixteen random configurations, every shape, and what cameras see. Nothing is
    written to a store. The exit code is 0 whatever is found, as long as the spec can be used.

    With --cameras or --configurations only what these files say is looked at, and no page is made: what is outside its
    box, or otherwise as no random sample shows it, and what stands in a wall.
    """
    if out.suffix not in (".html", ".htm"):
        raise click.BadParameter(f"{str(out)!r}: it is a page; name it like check.html", param_hint="--out")
    from photonfarm.cli import show
    from photonfarm.renderer.scene import backend
    from photonfarm.scene.spec_loading import NamedSpec, SpecLines

    named, say = NamedSpec.load(spec), partial(click.echo, err=True)
    if cameras or configurations:
        from photonfarm.scene.shot_files import read_shots

        shots = read_shots(named.spec, cameras, configurations)
        backend.load(threads=1)
        from photonfarm.renderer.tools.check.scene_check import doubt_shots

        doubts = doubt_shots(named, shots, say)
        click.echo(json.dumps(doubts, indent=1) if as_json else "\n".join(doubts or ["nothing is doubtful"]))
        return
    backend.load()
    from photonfarm.renderer.tools.check.scene_check import check, write

    made, lines = check(named, say), SpecLines.of(named.file)
    write(made, lines, out)
    if as_json:
        show.print_json([finding.document(lines) for finding in made.findings])
        return
    for finding in made.findings:
        click.echo(f"{'warning' if finding.serious else 'note'}: {finding.line(lines)}")
    click.echo(f"{out}: {len(made.findings) or 'no'} finding{'' if len(made.findings) == 1 else 's'}")


@click.command()
@click.argument("spec")
@json_option
@end_on_ctrl_c()
def scene_shapes(spec: str, as_json: bool) -> None:
    """List the shapes of SPEC, or of a Mitsuba scene file (.xml): ids, groups, materials, triangles, lights, boxes."""
    from photonfarm.cli import show
    from photonfarm.renderer.scene import backend

    backend.load(threads=1)
    from photonfarm.renderer.tools.check import shapes

    with tell_waiting(partial(click.echo, err=True), f"loading the shapes of {spec}"):
        facts = shapes.list_shapes(spec)
    if as_json:
        show.print_json([shape.document() for shape in facts])
        return
    show.print_table((shape.row() for shape in facts), shapes.HEAD)
    unnamed = sum(not shape.id for shape in facts)
    if unnamed:
        click.echo(f"{unnamed} of {len(facts)} shapes have no id, without which no group can name them", err=True)


def _load(spec: str, *, measured_again: bool = False) -> tuple[SceneSpec, Path]:
    """A spec and its file, with Mitsuba loaded as workers load it."""
    from photonfarm.renderer.scene import backend
    from photonfarm.scene.spec_loading import find_spec, load_spec

    loaded = load_spec(spec, measured_again=measured_again)
    backend.load(threads=1)
    return loaded, find_spec(spec)


@click.command()
@click.argument("spec")
@click.option(
    "--frames",
    type=click.IntRange(1, 1000),
    default=6,
    show_default=True,
    help="Random configurations to measure, a view of each, after some that do not count.",
)
@click.option(
    "--seconds",
    type=click.FloatRange(0, min_open=True),
    help="Processor time for all of it; with less time, fewer views.  [default: no limit]",
)
@click.option("--again", is_flag=True, help="Measure anew, also if this scene has been measured here.")
@device_option
@json_option
@end_on_ctrl_c()
def scene_cost(spec: str, frames: int, seconds: float | None, again: bool, as_json: bool) -> None:
    """Measure what samples of SPEC cost on this machine, in core-seconds, and how noisy they are.

    Half a minute for a small room, minutes for a large one. `configuration` is taken by each configuration, `view` by
    each view of it, `pass` by each sample of such a view, and `spp` by each sample per pixel of that.
    """
    loaded, file = _load(spec)
    from photonfarm.renderer.tools.measure.sample_costs import find_or_measure

    log = partial(click.echo, err=True)
    limit = math.inf if seconds is None else seconds
    costs = find_or_measure(loaded, file.parent, frames, again=again, log=log, seconds=limit)
    click.echo(costs.json() if as_json else costs.line())


@click.command()
@click.argument("spec")
@click.option(
    "--target",
    type=click.FloatRange(0, 1, min_open=True, max_open=True),
    default=0.45,
    show_default=True,
    help="Display mean: that of clip(exposure · I, 0, 1)^(1/2.2) over all pixels.",
)
@click.option(
    "--frames",
    type=click.IntRange(2, 1000),
    default=48,
    show_default=True,
    help="Random configurations to render, a view of each.",
)
@device_option
@json_option
@end_on_ctrl_c()
def scene_exposure(spec: str, target: float, frames: int, as_json: bool) -> None:
    """Propose an exposure for SPEC, from a quick render of random views; nothing is written.

    How far views differ in brightness decides how well it is known; more of them help.
    """
    loaded, file = _load(spec)
    from photonfarm.renderer.tools.measure.exposure import propose

    with WorkLog(partial(click.echo, err=True)) as work:
        work.begin(f"loading {loaded.name}")
        proposal = propose(loaded, file.parent, work, target=target, frames=frames)
    click.echo(json.dumps(proposal.document(), indent=1) if as_json else proposal.line())


@click.command()
@click.argument("spec")
@click.option("--write", is_flag=True, help="Put it into SPEC's file; the scene then has another id, and new views.")
@device_option
@json_option
@end_on_ctrl_c()
def scene_free_space(spec: str, write: bool, as_json: bool) -> None:
    """Measure where SPEC's cameras may stand: in the open, by rays, and in no movable group's box.

    With it in the spec, `submit` plans no view from inside a solid or from outside the room, and camera paths are kept
    out of them.
    """
    loaded, file = _load(spec, measured_again=True)
    from photonfarm.renderer.tools import spec_file
    from photonfarm.renderer.tools.measure.free_space import measure

    if write:
        file = spec_file.writable(spec)
    with WorkLog(partial(click.echo, err=True)) as work:
        measured = measure(loaded, file.parent, work.begin)
    click.echo(json.dumps(measured.entry()) if as_json else measured.line())
    if write:
        spec_file.write(file, {"view": {"free_space": measured.entry()}})
        click.echo(f"{file}: [view.free_space] written", err=True)


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
@click.option(
    "--for",
    "purpose",
    type=click.Choice(["training", "images"]),
    default="training",
    show_default=True,
    help="How noise counts: as the trainer's relative loss weighs it, or relative to the brightness of each pixel.",
)
@click.option(
    "--write", is_flag=True, help="Put the settings that gain into SPEC's file; samples planned before keep theirs."
)
@click.option("--again", is_flag=True, help="Measure anew, also if this scene has been measured here.")
@device_option
@json_option
@end_on_ctrl_c()
def scene_plan(spec: str, seconds: int, purpose: str, write: bool, again: bool, as_json: bool) -> None:
    """Choose how SPEC's light is sampled: by its content, and by a short measurement of error and time."""
    loaded, file = _load(spec)
    from photonfarm.renderer.strategy.noise import Purpose
    from photonfarm.renderer.strategy.plan import lines, make_plan
    from photonfarm.renderer.tools import spec_file

    if write:
        file = spec_file.writable(spec)
    log = partial(click.echo, err=True)
    plan = make_plan(loaded, file.parent, Purpose(purpose), seconds=seconds, again=again, log=log)
    click.echo(json.dumps(plan.document(), indent=2) if as_json else "\n".join(lines(plan)))
    if write:
        if plan.changes:
            spec_file.write(file, plan.changes)
        for table in plan.settings:
            click.echo(f"{file}: [{table}] {'written' if table in plan.changes else 'stays as it is'}", err=True)
