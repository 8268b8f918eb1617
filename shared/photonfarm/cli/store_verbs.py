"""The verbs `photonfarm store …`, which need neither Mitsuba, torch nor Redis."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click
from click.decorators import FC

from photonfarm.cli.options import arrangement_options, json_option, like_option, store_option
from photonfarm.core.errors import IncompleteError, StoreError

if TYPE_CHECKING:
    from photonfarm.scene.arrangement import Shot


OF_A_SCENE = "[--scene ID] [OPTIONS]"
"""Options in a usage line, so that it says how one scene is named: as an option, and not as an argument."""


def _scene_option(which: str = "This scene alone", *, required: bool = False) -> Callable[[FC], FC]:
    """`--scene ID`, one scene of the store."""
    text = f"{which}: its id, how it begins, or its name."
    return click.option("--scene", metavar="ID", required=required, help=text)


tell = partial(click.echo, err=True)
"""Says whom a verb waits for."""


@click.command(options_metavar=OF_A_SCENE)
@store_option
@_scene_option()
@click.option("--repair", is_flag=True, help="Set what is damaged aside, to be written again.")
@click.option(
    "--joined-from",
    metavar="OTHER",
    help="With --repair: the store, a folder or bucket, from which damaged plans of a join are written again.",
)
@json_option
def check(store: str | Path, scene: str | None, repair: bool, joined_from: str | None, as_json: bool) -> None:
    """Read everything that is stored, and say what is wrong with it; without --repair nothing is written.

    Every checksum, every file that a marker names, every number: NaN, infinite, black, repeated seeds, halves A and B
    that differ by more than chance, views that see only back faces. It reads at any time.

    --repair moves damaged jobs to the store's folder `quarantine`, each with a record of why, so that workers find them
    missing and render them again. Damaged inputs of a plan it copies there, and writes them again from the plan's
    request; those of a `store join` from the store that was joined, which --joined-from names, and which is only read.
    It only moves files; in a bucket, a move is a copy and then a delete. For that it has the scene for itself: it waits
    for the jobs in hand, and workers and trainers of the scene wait for it.

    Exit codes: 0 nothing is wrong, 7 what was wrong has been set aside, and is written again or will be by the workers,
    4 something is wrong (also where --repair does not help, which the text says).
    """
    from photonfarm.cli import show_store
    from photonfarm.store import Store
    from photonfarm.store.check.check import check_store
    from photonfarm.store.read.find import scene_named

    if joined_from and not repair:
        raise click.UsageError("--joined-from: only --repair writes plans again; give both")
    opened = Store(store)
    scene_id = None if scene is None else scene_named(opened, scene)
    with show_store.progress() as on_progress:
        report = check_store(
            opened,
            scene_id,
            when=datetime.now(UTC).isoformat(timespec="seconds"),
            repair=repair,
            joined_from=Store(joined_from) if joined_from else None,
            on_progress=on_progress,
            on_wait=tell,
        )
    show_store.print_check(report, as_json)
    sys.exit(report.exit_code)


@click.command(options_metavar=OF_A_SCENE)
@store_option
@_scene_option()
@arrangement_options()
@like_option
@click.option("--row", type=click.IntRange(0), help="The sample in a row.")
@click.option("--job", type=click.IntRange(0), help="The samples of a job.")
@click.option(
    "--tolerance",
    type=click.FloatRange(0),
    default=1e-3,
    show_default=True,
    help="How far a position may be from the one given, in scene units; 0: bit by bit.",
)
@click.option("--limit", type=click.IntRange(1), default=20, show_default=True, help="Samples to print.")
@json_option
def find(
    store: str | Path,
    scene: str | None,
    asked: Shot,
    like: str | None,
    row: int | None,
    job: int | None,
    tolerance: float,
    limit: int,
    as_json: bool,
) -> None:
    """Look samples up by what they are: their rows, passes, files, and whether they are complete.

    Conditions narrow each other; without any, all samples are listed. The nearest come first. Groups that are not named
    may stand anywhere; --move is from where a group was modelled.
    """
    from photonfarm.cli import show_store
    from photonfarm.store import Store
    from photonfarm.store.read.find import Query, find_samples, scene_named

    opened = Store(store)
    query = Query.of(asked=asked, like=like, row=row, job=job, tolerance=tolerance)
    ids = opened.scene_ids() if scene is None else [scene_named(opened, scene)]
    show_store.print_matches(find_samples(opened, ids, query, limit=limit), store, as_json)


@click.command(options_metavar=OF_A_SCENE)
@store_option
@_scene_option()
@like_option
@click.option("--row", type=click.IntRange(0), help="The view of the sample in a row.")
@click.option(
    "--least",
    type=click.IntRange(1),
    default=1,
    show_default=True,
    help="Leave out views with fewer complete passes: only what was topped up is merged.",
)
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), required=True, help="A folder.")
@json_option
def merge(
    store: str | Path,
    scene: str | None,
    like: str | None,
    row: int | None,
    least: int,
    out: Path,
    as_json: bool,
) -> None:
    """Merge all complete passes of views into reference images: FOLDER/<view key>.npz.

    Each is a NumPy archive of `mean`, `m2`, `half_a`, `half_b` and `standard_error`, (H, W, 3) float64 linear radiance,
    and the number of `passes`, of two independent halves each. Exact, and the same in any order; merge again when more
    passes have arrived. Without conditions all views are merged.

    Exit codes: 0 some view was merged, 7 none yet, as samples or passes are missing, 4 no sample that is planned fits.
    """
    from photonfarm.cli.show import print_json
    from photonfarm.store import Store
    from photonfarm.store.read.find import Query, find_samples, scene_named
    from photonfarm.store.read.merge import merge_views, write_views

    opened = Store(store)
    query = Query.of(like=like, row=row)
    ids = opened.scene_ids() if scene is None else [scene_named(opened, scene)]
    merged = (each for scene_id in ids for each in merge_views(opened.scene(scene_id), query, least))
    written = []
    for each in write_views(merged, out):
        written.append(each)
        if not as_json:
            passes = "1 pass" if each.passes == 1 else f"{each.passes} passes"
            error = f"standard error of a value {each.standard_error:.2g} (RMS)"
            click.echo(f"{each.file}: {passes}, mean {each.mean:.4g}, {error}")
    if as_json:
        print_json([asdict(each) for each in written])
    if not written:
        if not find_samples(opened, ids, query, limit=1).count:
            raise StoreError("no sample that is planned fits; `photonfarm store find` shows what there is")
        what = "no complete sample fits" if least == 1 else f"no view that fits has {least} complete passes (--least)"
        raise IncompleteError(f"{what}; `photonfarm store find` shows what there is")


@click.command()
@click.argument("other")
@store_option
@_scene_option("This scene of OTHER alone")
@json_option
def join(other: str, store: str | Path, scene: str | None, as_json: bool) -> None:
    """Copy the complete samples of the store OTHER, a folder or bucket, into this one, which may be new.

    Scenes are joined by their ids: samples that are here already are left out. Jobs that are planned here and not
    rendered yet are filled in where OTHER has all of their samples; the others are left to workers, and counted. Every
    byte is checked on the way. It may be stopped and repeated at any time. It has each scene for itself meanwhile: it
    waits for the jobs in hand, and workers and trainers of the scene wait for it. OTHER is only read.

    Exit codes: 0 all that OTHER has complete is planned here, and copied but for what is counted; 4 a store cannot be
    read or written, and what is copied stays.
    """
    from photonfarm.cli import show_store
    from photonfarm.farm.join import join as join_stores

    with show_store.progress("copied") as show:
        result = join_stores(
            store, other, scene, on_progress=lambda name, done, jobs: show(name, done, jobs, 0), on_wait=tell
        )
    show_store.print_joined(result, as_json)


@click.command()
@store_option
@_scene_option("The scene", required=True)
@click.option(
    "--plan", type=click.IntRange(0), help="The plan's number.  [default: the last one with samples to forget]"
)
@json_option
def withdraw(store: str | Path, scene: str, plan: int | None, as_json: bool) -> None:
    """Forget what a plan holds and nobody has rendered; what is rendered stays.

    It waits for the jobs in hand; the others leave the queue as workers meet them. The same samples may be planned
    again later. Refused where a later plan has passes of the plan's views: withdraw that one first.
    """
    from photonfarm.cli import show_store
    from photonfarm.store import Store
    from photonfarm.store.model.withdrawal import withdraw as withdraw_plan
    from photonfarm.store.read.find import scene_named

    opened = Store(store)
    result = withdraw_plan(opened.scene(scene_named(opened, scene)), plan, on_wait=tell)
    show_store.print_withdrawn(result, as_json)


@click.command()
@store_option
@_scene_option("The scene", required=True)
@click.option("--yes", is_flag=True, help="Do not ask.")
@json_option
def forget(store: str | Path, scene: str, yes: bool, as_json: bool) -> None:
    """Delete a scene with all that is planned and rendered of it. This cannot be undone.

    It says what there is, and asks; without a terminal it wants --yes. It waits for the jobs in hand; others leave the
    queue as workers meet them. A trainer of the scene ends.
    """
    from photonfarm.cli import show_store
    from photonfarm.cli.show import print_json
    from photonfarm.core.formatting import format_count
    from photonfarm.store import Store
    from photonfarm.store.model.withdrawal import forget as forget_scene
    from photonfarm.store.read.find import scene_named

    opened = Store(store)
    scene_id = scene_named(opened, scene)
    if not yes:
        question = f"Delete {show_store.describe_contents(opened, scene_id)} of {store}?"
        if not sys.stdin.isatty():
            raise click.UsageError(f"{question} Without a terminal to ask, --yes is required.")
        if not click.confirm(question, err=True):
            raise click.ClickException("nothing is deleted")
    result = forget_scene(opened, scene_id, on_wait=tell)
    if as_json:
        print_json(asdict(result))
    else:
        click.echo(f"scene {result.scene_id} is forgotten, with {format_count(result.jobs, 'rendered job')}")
