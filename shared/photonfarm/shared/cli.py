"""The command `photonfarm`, and those of its verbs that need neither Mitsuba nor torch."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import click
from click.core import ParameterSource
from rich import markup
from rich.console import Console

from photonfarm.shared.errors import PhotonfarmError, StoreError
from photonfarm.shared.settings import file_defaults
from photonfarm.shared.verbs import Umbrella, options_by_command

Command = TypeVar("Command", bound=Callable[..., Any])


@click.group(cls=Umbrella, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(package_name="photonfarm-shared", prog_name="photonfarm")
@click.option("--config", type=click.Path(path_type=Path), envvar="PHOTONFARM_CONFIG", default="photonfarm.toml",
              show_default=True, help="Defaults for options, a table per verb.")  # fmt: skip
@click.pass_context
def umbrella(ctx: click.Context, config: Path) -> None:
    """Unbiased training data for neural light transport, and training on it while it grows.

    Options come from the command line, else from PHOTONFARM_… variables, else from the configuration file. Results go
    to stdout, talk goes to stderr. Exit codes: 0 done, 2 wrong usage, 3 bad spec or request, 4 store, 5 Redis, 6 this
    machine cannot render, 7 incomplete, 8 training diverged, 130 `up` after Ctrl-C, 1 anything else.
    """
    named = ctx.get_parameter_source("config") is not ParameterSource.DEFAULT
    if named or config.is_file():
        ctx.default_map = file_defaults(config, options_by_command(umbrella))


def main(args: list[str] | None = None) -> None:
    """Run the command line; an error of ours becomes one sentence and its exit code."""
    try:
        umbrella(args, prog_name="photonfarm")
    except PhotonfarmError as error:
        _fail(str(error), error.exit_code)
    except OSError as error:  # a file that a user named, and nobody closer to it could say more
        _fail(f"{error.filename or 'a file'}: {error.strerror or error}", StoreError.exit_code)


def _fail(sentence: str, exit_code: int) -> NoReturn:
    console = Console(stderr=True, soft_wrap=True)
    console.print("[bold red]photonfarm:[/]", markup.escape(sentence), highlight=False)
    sys.exit(exit_code)


# --------------------------------------------------------------------------------------------------- options they share


class StorePlace(click.Path):
    """A folder, as a Path; or the URL of a bucket, as it is written."""

    name = "folder or url"

    def __init__(self) -> None:
        super().__init__(path_type=Path, file_okay=False)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The Path or the URL; fails for a URL that is not that of a bucket."""
        from photonfarm.shared.store.storage import SCHEMES, is_url

        if not is_url(value):
            return super().convert(value, param, ctx)
        scheme, _, bucket = value.partition("://")
        if scheme not in SCHEMES or not bucket.strip("/"):
            self.fail(f"{value!r} is neither a folder nor {'://…, '.join(SCHEMES)}://… with a bucket.", param, ctx)
        return value


def store_option(command: Command) -> Command:
    """`--store`, the sample store."""
    return click.option(
        "--store", type=StorePlace(), metavar="DIR|URL", envvar="PHOTONFARM_STORE", default="store", show_default=True,
        help="The sample store: a folder, or s3://bucket/prefix (credentials: the AWS_… variables).",
    )(command)  # fmt: skip


def redis_option(command: Command) -> Command:
    """`--redis URL`, the queue's server; its password may come from the file that a variable names."""
    return click.option(
        "--redis", "redis_url", envvar="PHOTONFARM_REDIS_URL", default="redis://localhost:6379/0", show_default=True,
        help="The queue's Redis. A password is refused here, as command lines can be read by all; it belongs into the "
        "file that PHOTONFARM_REDIS_PASSWORD_FILE names, and is the user photonfarm's unless the URL names another: "
        "redis://default@host for a Redis with requirepass.", show_envvar=True, callback=_with_password,
    )(command)  # fmt: skip


def _with_password(ctx: click.Context, param: click.Parameter, url: str) -> str:
    if ctx.get_parameter_source(param.name or "") is ParameterSource.COMMANDLINE:
        _refuse_password(url)
    if not (file := os.environ.get("PHOTONFARM_REDIS_PASSWORD_FILE")):
        return url
    from photonfarm.shared.queue import with_password_of

    return with_password_of(Path(file), url)


def _refuse_password(url: str) -> None:
    from photonfarm.shared.queue import has_password

    if has_password(url):
        raise click.BadParameter(
            "a password on the command line can be read by everybody on this machine, and stays in the shell's "
            "history; give the URL without it, and put the password into a file that PHOTONFARM_REDIS_PASSWORD_FILE "
            "names. (A URL with a password may stand in PHOTONFARM_REDIS_URL, or as `redis` in the configuration file.)"
        )


def json_option(command: Command) -> Command:
    """`--json`: machine-readable results."""
    return click.option("--json", "as_json", is_flag=True, help="Print JSON.")(command)


def request_options(command: Command) -> Command:
    """The options that make a request."""
    options = (
        click.option("--modifications", type=click.IntRange(1), default=128, show_default=True,
                     help="Random configurations; a static scene has one, of which modifications × views are planned."),
        click.option("--views", type=click.IntRange(1), default=2, show_default=True, help="Views per configuration."),
        click.option("--passes", type=click.IntRange(1), default=1, show_default=True, help="Noisy passes per view."),
        click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Master seed; 0 is a seed."),
        click.option("--shard-rows", type=click.IntRange(1, 4096), default=None,
                     help="Samples per job, fixed for a scene by its first plan.  [default: 32]"),
    )  # fmt: skip
    for option in reversed(options):
        command = option(command)
    return command


# ---------------------------------------------------------------------------------------------------------------- verbs


@click.group()
def scene() -> None:
    """Scene specs."""


@scene.command("show")
@click.argument("spec")
@json_option
def scene_show(spec: str, as_json: bool) -> None:
    """Check SPEC (a scene.toml, or the name of a ready one) and show what it says."""
    from photonfarm.shared import show
    from photonfarm.shared.scene import Emitters, load_spec

    loaded = load_spec(spec)
    show.scene(loaded, as_json)
    if not as_json and loaded.emitters != Emitters():
        click.echo(f"\nthe scene's own lights: {loaded.emitters}")


@click.command()
@click.argument("spec")
@request_options
@store_option
@redis_option
@click.option("--no-queue", is_flag=True, help="Only write the plan; idle workers find it by themselves.")
@click.option("--retry", is_flag=True, help="Also queue the jobs that were set aside, as they had failed repeatedly.")
@click.option("--dry-run", is_flag=True, help="Say what would be planned, its size and cost, and what should teach "
              "more at that cost; write nothing.")  # fmt: skip
@click.option("--no-measure", is_flag=True, help="With --dry-run: leave out cost and suggestion.")
@json_option
def submit(
    spec: str,
    store: str | Path,
    redis_url: str,
    no_queue: bool,
    retry: bool,
    dry_run: bool,
    no_measure: bool,
    as_json: bool,
    **request: Any,
) -> None:
    """Plan samples of SPEC and queue them; what is planned already is not planned again."""
    from photonfarm.shared import show, submission

    if dry_run:
        from photonfarm.shared.dry_run import rehearse

        tell = partial(click.echo, err=True)
        show.dry_run(rehearse(spec, store, measure=not no_measure, tell=tell, **request), as_json)
    else:
        url = None if no_queue else redis_url
        show.submission(submission.submit(spec, store, url, retry=retry, **request), as_json)


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
@click.option("--no-queue", is_flag=True, help="Only write the plan; idle workers find it by themselves.")
@click.option("--retry", is_flag=True, help="Also queue the jobs that were set aside, as they had failed repeatedly.")
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
    from photonfarm.shared import show, submission

    result = submission.top_up(spec, store, None if no_queue else redis_url, spp, where=where, **options)
    show.submission(result, as_json)
    noun = "pass" if result.passes == 1 else "passes"
    click.echo(f"{spp} samples per pixel: {result.passes} {noun} of {result.spp_per_pass} each", err=True)


@click.command()
@store_option
@redis_option
@json_option
def status(store: str | Path, redis_url: str, as_json: bool) -> None:
    """Show what is planned, committed, queued and failed."""
    from photonfarm.shared import show

    show.status(store, redis_url, as_json)


@click.command()
@click.argument("spec")
@request_options
@store_option
@click.option("--workers", type=click.IntRange(1), default=2, show_default=True, help="Render workers, a core each.")
@click.option("--run", type=click.Path(path_type=Path), default="run", show_default=True, help="The trainer's folder.")
@click.option("--train-steps", type=click.IntRange(0), default=3000, show_default=True, help="0: render only.")
@click.option(
    "--hold-out",
    type=click.FloatRange(0, 1, min_open=True, max_open=True),
    default=0.125,
    show_default=True,
    help="Share of the configurations never trained on; a small plan needs a large one.",
)
@click.option("--reference-views", type=click.IntRange(0), default=0, show_default=True,
              help="Held-out views that get references, for the report; 0: none.")  # fmt: skip
@click.option("--reference-spp", type=click.IntRange(1), default=256, show_default=True,
              help="Samples per pixel of each reference.")  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), default="out", show_default=True, help="Preview and report.")
def up(spec: str, store: str | Path, **options: Any) -> None:
    """Run the whole farm on this machine: an embedded Redis, render workers and the trainer, until all is done.

    Ctrl-C stops it within seconds; the same command goes on from there.
    """
    from photonfarm.shared.up import run_farm

    try:
        run_farm(spec, store, **options)
    except KeyboardInterrupt:
        click.echo("stopped; the same command goes on from here", err=True)
        sys.exit(130)


if __name__ == "__main__":
    main()
