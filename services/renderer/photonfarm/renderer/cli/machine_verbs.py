"""Verbs of a machine that renders: doctor, work."""

from __future__ import annotations

import os
import re
import sys
from functools import partial
from pathlib import Path
from typing import Any

import click

from photonfarm.cli.options import device_option, json_option, redis_option, store_option


@click.command()
@store_option
@redis_option
@device_option
@json_option
def doctor(store: str | Path, redis_url: str, as_json: bool) -> None:
    """Try each part on this machine, and say what to do about what does not work."""
    from rich import markup
    from rich.console import Console

    from photonfarm.cli import show
    from photonfarm.renderer.tools.doctor import examine

    console, checks = Console(soft_wrap=True), []
    for check in examine(store, redis_url, partial(click.echo, err=True)):
        checks.append(check)
        if not as_json:
            mark = "[green]ok[/]  " if check.works else ("[red]FAIL[/]" if check.exit_code else "[yellow]none[/]")
            console.print(f"{mark} [bold]{check.name}[/]: {markup.escape(check.detail)}", highlight=False)
    if as_json:
        show.print_json([{"name": check.name, "works": check.works, "detail": check.detail} for check in checks])
    sys.exit(next((check.exit_code for check in checks if not check.works and check.exit_code), 0))


def _bytes(ctx: click.Context, param: click.Parameter, size: str) -> int:  # noqa: ARG001
    match = re.fullmatch(r"(\d+(?:\.\d+)?) *([kMGT]?)B?", size.strip())
    if match is None:
        raise click.BadParameter(f"{size!r} is not a size; write it like 500MB or 2GB")
    return int(float(match[1]) * 1000 ** " kMGT".index(match[2] or " "))


def _share(ctx: click.Context, param: click.Parameter, text: str | None) -> Any:  # noqa: ARG001
    from photonfarm.core.errors import SpecError
    from photonfarm.queue.job import Share

    try:
        return None if text is None else Share.parse(text)
    except SpecError as error:
        raise click.BadParameter(str(error)) from error


@click.command()
@click.argument("specs", metavar="[SPEC]...", nargs=-1)
@store_option
@redis_option
@click.option(
    "--share",
    callback=_share,
    metavar="K/N",
    help="Work without Redis: take the jobs whose number leaves K when it is divided by N, then what is "
    "left of the others'. K is from 0 to N - 1. SPEC: render these scenes alone.",
)
@click.option("--name", help="Name of this worker, distinct among all.  [default: host and process]")
@click.option(
    "--scene", "scene_id", metavar="ID", help="Work for this scene alone: its id, how it begins, or its name."
)
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
    "--ahead",
    type=click.FloatRange(1),
    metavar="RATIO",
    help="Take no job of a scene while more of its samples are committed than RATIO × those that its trainer has used. "
    "About the first 256 of a scene may always be (jobs are taken and finished whole, by each worker); without a "
    "trainer it stops there. Values below 1 would stop rendering for ever.",
)
@click.option(
    "--deadline",
    "deadline_s",
    type=click.FloatRange(0, min_open=True),
    default=1800.0,
    show_default=True,
    metavar="SECONDS",
    help="End a job that takes longer; it is started up to five times. A worker that was "
    "stopped (SIGSTOP) for so long ends its job when it goes on; others have taken it over by then.",
)
@device_option
@click.option("--quiet", is_flag=True, help="Say only what is wrong.")
@click.option("--check", is_flag=True, help="Only say whether a worker of this host is alive (exit 0) or not (7).")
def work(
    specs: tuple[str, ...],
    store: str | Path,
    redis_url: str,
    scene_id: str | None,
    job: int | None,
    check: bool,
    **settings: Any,
) -> None:
    """Render queued jobs into the store, on one core or one card, until asked to stop; start one for each of them.

    With --share the store alone says what is missing; several workers may then render the same job near the end, and
    the first commit stays.

    A store that does not exist is waited for; --until-complete ends with exit code 4 then. One Redis serves one store.
    Ctrl-C gives the job in hand 5 s to end, a second one ends it at once; it is rendered again then.
    """
    from photonfarm.renderer.worker import worker

    if settings["share"] is not None:
        _check_share(specs, scene_id, job, check, settings["ahead"])
        worker.run_worker(store, scene_id=scene_id, scene_ids=_scene_ids(specs), **settings)
    elif specs:
        raise click.UsageError("SPEC needs --share; a worker with Redis renders one scene by --scene, or all")
    elif check:
        worker.check(redis_url)
    elif job is None:
        worker.run_worker(store, redis_url, scene_id=scene_id, **settings)
    elif scene_id is None:
        raise click.UsageError("--job needs --scene: jobs are numbered within a scene")
    else:
        rendered, seconds = worker.render_job(store, scene_id, job)
        click.echo(f"job {job} rendered and committed in {seconds:.1f} s" if rendered else f"job {job} is committed")


def _check_share(
    specs: tuple[str, ...], scene_id: str | None, job: int | None, check: bool, ahead: float | None
) -> None:
    """Raise UsageError for what does not go with a share."""
    if job is not None or check:
        raise click.UsageError(f"--share and {'--check' if check else '--job'} exclude each other")
    if ahead is not None:
        raise click.UsageError("--ahead needs Redis, where the trainer reports what it has used; --share works without")
    if specs and scene_id is not None:
        raise click.UsageError("give either SPEC or --scene")


def _scene_ids(specs: tuple[str, ...]) -> tuple[str, ...]:
    """The scenes of specs. The child, which has no spec's file, will find scene files that lie beside one."""
    from photonfarm.scene.spec_loading import SCENES_VARIABLE, NamedSpec

    named = [NamedSpec.load(spec) for spec in specs]
    folders = [os.environ.get(SCENES_VARIABLE), *(spec.scenes for spec in named)]
    if any(folders):
        os.environ[SCENES_VARIABLE] = os.pathsep.join(dict.fromkeys(filter(None, folders)))
    return tuple(spec.spec.scene_id for spec in named)
