"""The verbs `scene`, `submit`, `top-up`, `reconcile`, `status`, `redis` and `up`: without Mitsuba and without torch."""

from __future__ import annotations

import os
import sys
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import click
from click.core import ParameterSource

from photonfarm.cli.options import (
    RunFolder,
    arrangement_options,
    device_option,
    json_option,
    names_redis,
    no_queue_option,
    redis_option,
    request_options,
    retry_option,
    run_option,
    shot_file_options,
    start_options,
    store_option,
)
from photonfarm.core.errors import say_install
from photonfarm.plan.hold_out import HOLD_OUT

if TYPE_CHECKING:
    from photonfarm.plan.chosen import Chosen
    from photonfarm.plan.request import Request
    from photonfarm.scene.arrangement import Shot


@click.group()
def scene() -> None:
    """Scene specs."""


@scene.command("show")
@click.argument("spec")
@json_option
def scene_show(spec: str, as_json: bool) -> None:
    """Check SPEC (a scene.toml, or the name of a ready one) and show what it says."""
    from photonfarm.cli import show
    from photonfarm.scene.spec import Emitters
    from photonfarm.scene.spec_loading import load_spec

    loaded = load_spec(spec)
    show.print_scene(loaded, as_json)
    if not as_json and loaded.emitters != Emitters():
        click.echo(f"\nthe scene's own lights: {loaded.emitters}")


@click.command()
@click.argument("spec")
@request_options
@start_options
@arrangement_options()
@store_option
@redis_option
@no_queue_option
@retry_option
@click.option(
    "--halves-from",
    metavar="ID",
    help="The scene whose halves jobs take over; it may differ in buffers, "
    "guides, photons and points alone.  [default: the one that has most]",
)
@click.option(
    "--dry-run",
    is_flag=True,
    help="Say what would be planned, its size and cost, and what should teach more at that cost; write nothing.",
)
@click.option("--no-measure", is_flag=True, help="With --dry-run: leave out cost and suggestion.")
@click.option(
    "--workers", type=click.IntRange(1), help="That will render: for the dry run's time and the size of jobs."
)
@shot_file_options
@device_option
@json_option
def submit(
    spec: str,
    store: str | Path,
    redis_url: str,
    no_queue: bool,
    retry: bool,
    halves_from: str | None,
    dry_run: bool,
    no_measure: bool,
    workers: int | None,
    cameras: Path | None,
    configurations: Path | None,
    as_json: bool,
    row: int | None,
    like: str | None,
    asked: Shot,
    request: Request,
    shard_rows: int | None,
) -> None:
    """Plan samples of SPEC and queue them; what is planned already is not planned again.

    SPEC is a scene.toml, or the name of a ready one: room and cornell are built in, others need their files.

    Where something is said to stand somewhere, or a camera, --passes of that one view are planned: all others stay at
    rest, or as --row or --like has them.

    --cameras and --configurations plan what files say instead of random samples: each configuration by its own camera,
    or by all of --cameras, or from --views random places.
    """
    from photonfarm.cli import show
    from photonfarm.farm import dry_run as dry
    from photonfarm.farm import submission
    from photonfarm.farm.devices import AUTO, DEVICE_VARIABLE, is_card_wanted
    from photonfarm.farm.hold_out_checks import find_hold_out_warning
    from photonfarm.farm.renderer_verbs import collect_doubts
    from photonfarm.plan.chosen import Chosen
    from photonfarm.scene.arrangement import Shot
    from photonfarm.scene.plausibility import warnings
    from photonfarm.scene.shot_files import read_shots
    from photonfarm.scene.spec_loading import NamedSpec
    from photonfarm.store.read.find import find_start

    named, log = NamedSpec.load(spec), partial(click.echo, err=True)
    wanted: Request | Chosen = request
    if (row, like, asked, cameras, configurations) == (None, None, Shot(), None, None):
        doubts = [*filter(None, [find_hold_out_warning(named.spec, store, request)])]
    else:
        start = find_start(store, named.spec.scene_id, row, like) or (None, None)
        modification = asked.apply(named.spec, start[0])
        if cameras or configurations:
            _refuse_given("files say what is planned", "modifications", "camera", "look_at", "fov")
            _refuse_given("is of random views; --cameras has them all", *(("views", "seed") if cameras else ()))
            # of random views one is looked at, so that frames are numbered as by `infer`
            files, counts = (named.spec, cameras, configurations, modification), (request.views_per_modification, 1)
            chosen, shown = (read_shots(*files, views=count, seed=request.seed) for count in counts)
        else:
            _refuse_given("is of random samples; one view of one configuration is asked for", *RANDOM)
            shown = chosen = [(modification, asked.view(named.spec, start[1]))]
        doubts = collect_doubts(named, shown, log)
        wanted = Chosen.of_all(named.spec, chosen, request.passes)
    for warning in (*warnings(named), *doubts):
        click.echo(f"warning: {warning}", err=True)
    result: submission.Submission
    on_card = is_card_wanted(os.environ.get(DEVICE_VARIABLE) or AUTO)
    how: dict[str, Any] = {"shard_rows": shard_rows, "on_card": on_card}
    if dry_run:
        result = dry.rehearse(named, store, wanted, measure=not no_measure, log=log, workers=workers, **how)
    else:
        url = None if no_queue else redis_url
        result = submission.submit(
            named,
            store,
            url,
            wanted,
            retry=retry,
            workers=workers or submission.WORKERS,
            halves_from=halves_from,
            **how,
        )
    show.print_submission(result, as_json)


RANDOM = ("modifications", "views", "seed")
"""The options of random samples."""


def _refuse_given(why: str, *names: str) -> None:
    """Raise UsageError for options of other samples than those that a person chooses."""
    ctx = click.get_current_context()
    for name in names:
        if ctx.get_parameter_source(name) is ParameterSource.COMMANDLINE:
            raise click.UsageError(f"--{name.replace('_', '-')}: {why}")


@click.command("top-up")
@click.argument("spec")
@click.option(
    "--spp",
    required=True,
    metavar="[+]N",
    help="Samples per pixel: +64 adds 64 to what is planned of each view, 256 goes up to 256 in all.",
)
@click.option("--where", multiple=True, metavar="CONDITION", help="Which views, instead of all; see above.")
@store_option
@redis_option
@no_queue_option
@retry_option
@click.option("--dry-run", is_flag=True, help="Say what would be planned, and write nothing.")
@json_option
def top_up(
    spec: str,
    spp: str,
    where: tuple[str, ...],
    store: str | Path,
    redis_url: str,
    no_queue: bool,
    as_json: bool,
    **options: bool,
) -> None:
    """Plan more noisy passes of views of SPEC that are planned already, and queue them.

    A pass has 2 × half_spp samples per pixel, so N is rounded up to whole passes. New passes are independent of
    the old ones and share the buffers and photons that are there. Repeating +N adds again; repeating N adds nothing.

    \b
    Conditions, of which a view must meet every one that is given:
      views=first:N      the first N that were planned, of those that meet the others
      view=KEY           the view with this content key, or with one that begins so
      modification=KEY   views of the configuration with this content key, or beginning
      rows=A-B           views that the samples in rows A to B show; rows=A for one
      plan=P             views that plan P brought
      held-out[=SHARE]   views that training with this hold-out never sees (default 0.125)
    """  # noqa: D301 - click wants the character
    from photonfarm.cli import show
    from photonfarm.farm import submission
    from photonfarm.scene.spec_loading import NamedSpec

    url = None if no_queue else redis_url
    result = submission.top_up(NamedSpec.load(spec), store, url, spp, where=where, **options)
    show.print_submission(result, as_json)
    noun = "pass" if result.passes == 1 else "passes"
    click.echo(f"{spp} samples per pixel: {result.passes} {noun} of {result.spp_per_pass} each", err=True)


@click.command()
@store_option
@redis_option
@click.option(
    "--run",
    "runs",
    type=RunFolder(),
    multiple=True,
    help="Folder of a training run; may be repeated.  [default: that of an `up` at work here]",
)
@click.option("--watch", is_flag=True, help="Keep showing it, with rates and time left, until Ctrl-C.")
@json_option
def status(
    store: str | Path, redis_url: str, runs: tuple[Path, ...] = (), watch: bool = False, as_json: bool = False
) -> None:
    """Show what is planned, committed, queued and failed.

    Where `photonfarm up` is at work on the store here, its queue is shown, unless --redis names another.
    """
    from photonfarm.cli import show_farm
    from photonfarm.farm.watch import FarmWatch
    from photonfarm.store import Store

    farm_watch = FarmWatch(Store(store), redis_url, runs, named_redis=names_redis())
    if watch:
        show_farm.keep_watching(farm_watch, store)
        return
    farm = farm_watch.look()
    (show_farm.print_document if as_json else show_farm.print_farm)(farm, store)
    farm.check_read()


@click.command()
@store_option
@redis_option
@json_option
def reconcile(store: str | Path, redis_url: str, as_json: bool) -> None:
    """Queue every job that is planned, and neither committed nor queued, rendered now or failed.

    Idle workers do this by themselves. It is for farms that may have no worker: a timer runs it, and workers are
    started for what is queued. A job whose worker died is queued again once its heartbeat has run out; jobs that
    failed too often wait for `submit --retry`.
    """
    from photonfarm.cli import show
    from photonfarm.core.formatting import format_count
    from photonfarm.queue.connection import connect
    from photonfarm.queue.reconciliation import reconcile as queue_missing
    from photonfarm.store import Store

    opened = Store(store)
    with connect(redis_url) as connection:
        jobs = queue_missing(opened, connection)
    if as_json:
        show.print_json({"queued": jobs})
    else:
        click.echo(f"{format_count(jobs, 'job')} queued")


@click.command("redis")
@click.option("--port", type=click.IntRange(1, 65535), default=6379, show_default=True, help="Of this machine alone.")
def redis_server(port: int) -> None:
    """Run a Redis for the queue on this machine, until it is ended: the server that `up` embeds.

    It lets in users of this machine, without a password, and keeps nothing: the queue is filled again from the store.
    """
    from photonfarm.farm.redis_server import become_redis

    become_redis(port)


@click.command()
@click.argument("spec")
@request_options
@store_option
@click.option(
    "--workers",
    type=click.IntRange(1),
    help="Render workers, a core each, or in turn on the cards.  [default: 2; one a card]",
)
@device_option
@run_option
@click.option("--train-steps", type=click.IntRange(0), default=3000, show_default=True, help="0: render only.")
@click.option("--preset", metavar="NAME", help="Of the training, as `train` has it.")
@click.option("--architecture", metavar="NAME", help="Kind of network, as `train` has it.  [default: the preset's]")
@click.option(
    "--set",
    "pairs",
    multiple=True,
    metavar="KEY=VALUE",
    help="Any setting of the training, as `train` has it; may be repeated.",
)
@click.option(
    "--also",
    type=(str, click.IntRange(1)),
    multiple=True,
    metavar="NAME STEPS",
    help="A further network to train meanwhile, in RUN-NAME, and to compare in the report; may be repeated.",
)
@click.option(
    "--hold-out",
    type=click.FloatRange(0, 1, min_open=True, max_open=True),
    default=None,
    help="Share of the configurations never trained on.  "
    f"[default: the run's; of a new one {HOLD_OUT}, or just enough for one configuration of a small plan]",
)
@click.option(
    "--reference-views",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Held-out views that get references, for the report; 0: none.",
)
@click.option(
    "--reference-spp",
    type=click.IntRange(1),
    default=256,
    show_default=True,
    help="Samples per pixel of each reference.",
)
@click.option("--reserve", metavar="SIZE", help="Of the workers, as `work` has it.  [default: 1GB]")
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default="out",
    show_default=True,
    help="Preview and report.",
)
@click.option("--web/--no-web", default=True, show_default=True, help="Serve pages that show it, on this machine.")
def up(spec: str, store: str | Path, request: Request, **options: Any) -> None:
    """Run the whole farm on this machine: an embedded Redis, render workers and the trainer, until all is done.

    Ctrl-C stops it within seconds; the same command goes on from there.
    """
    from photonfarm.cli.show_farm import follow_up
    from photonfarm.farm.devices import AUTO, CPU, DEVICE_VARIABLE, cards_here, worker_devices
    from photonfarm.farm.up import WORKERS, run_farm, trainer_arguments

    try:
        reserve = ["--reserve", options["reserve"]] if options["reserve"] else []
        _check_arguments(["work", "--until-complete", *reserve], "mitsuba", "render")
        named = {f"--{name}": options.pop(name) for name in ("preset", "architecture")}
        given = [word for name, value in named.items() if value is not None for word in (name, value)]
        options["train_options"] = [*given, *(word for pair in options.pop("pairs") for word in ("--set", pair))]
        asked, options["also"] = options["also"], dict(options["also"])
        if len(options["also"]) < len(asked):
            raise click.UsageError("--also names a network twice; each trains in the one folder of its name")
        if options["also"] and not options["train_steps"]:
            raise click.UsageError("--also trains beside a network, and --train-steps 0 trains none")
        for own in ([], *(["--architecture", name] for name in options["also"])) if options["train_steps"] else ():
            trainer = {name: options[name] for name in ("run", "train_steps")}
            trainer |= {"hold_out": options["hold_out"] or HOLD_OUT, "train_options": [*options["train_options"], *own]}
            _check_arguments(trainer_arguments(spec, **trainer), "torch", "train", "--train-steps 0 renders only")
        devices = worker_devices(os.environ.get(DEVICE_VARIABLE) or AUTO, cards_here())
        options["workers"] = options["workers"] or (WORKERS if devices == (CPU,) else len(devices))
        say = partial(click.echo, err=True)
        run_farm(spec, store, request, say, follow_up(store), devices=devices, **options)
    except KeyboardInterrupt:
        click.echo("stopped; the same command goes on from here", err=True)
        sys.exit(130)


def _check_arguments(arguments: list[str], package: str, extra: str, *remedies: str) -> None:
    """Raise UsageError if a verb lacks a package, or would refuse its arguments or its table of the configuration."""
    if find_spec(package) is None:
        missing = f"`photonfarm {arguments[0]}` needs the package {package}: {say_install(extra)}"
        raise click.UsageError("; ".join([missing, *remedies]))
    root = click.get_current_context().find_root()
    verb = cast(click.Command, cast(click.Group, root.command).get_command(root, arguments[0]))
    embedded = ["--redis", "unix:///"]  # like that of the embedded Redis, which wants no password
    verb.make_context(arguments[0], [*arguments[1:], *embedded], parent=root).close()
