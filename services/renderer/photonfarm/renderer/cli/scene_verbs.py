"""Verbs that show what a scene holds, or make one: scene check, scene import, scene shapes."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from shlex import quote

import click

from photonfarm.cli.options import device_option, json_option
from photonfarm.core.processes import end_on_ctrl_c
from photonfarm.core.waiting import tell_waiting


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
@device_option
@json_option
@end_on_ctrl_c()
def scene_check(spec: str, out: Path, as_json: bool) -> None:
    """Look at SPEC and its scene, and say what cannot be right: a page (HTML), and each finding with its line.

    The page shows plan and elevation, sixteen random configurations, every shape, and what cameras see. Nothing is
    written to a store. The exit code is 0 whatever is found, as long as the spec can be used.
    """
    if out.suffix not in (".html", ".htm"):
        raise click.BadParameter(f"{str(out)!r}: it is a page; name it like check.html", param_hint="--out")
    from photonfarm.cli import show
    from photonfarm.renderer.scene import backend
    from photonfarm.scene.spec_loading import NamedSpec, SpecLines

    named = NamedSpec.load(spec)
    backend.load()
    from photonfarm.renderer.tools.check.scene_check import check, write

    made, lines = check(named, partial(click.echo, err=True)), SpecLines.of(named.file)
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
