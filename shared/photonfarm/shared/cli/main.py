"""The command `photonfarm`: its verbs, its configuration file, and its exit codes."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

import click
from click.core import ParameterSource
from rich import markup
from rich.console import Console

from photonfarm.shared.cli.settings import file_defaults
from photonfarm.shared.cli.verbs import Umbrella, options_by_command
from photonfarm.shared.core.errors import PhotonfarmError, QueueError, StoreError

STOPPED = 130
"""The exit code after Ctrl-C, as shells give it."""

CONFIG_VARIABLE = "PHOTONFARM_CONFIG"


@click.group(cls=Umbrella, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(package_name="photonfarm-shared", prog_name="photonfarm")
@click.option("--config", type=click.Path(path_type=Path), envvar=CONFIG_VARIABLE, default="photonfarm.toml",
              show_default=True, help="Defaults for options, a table per verb.")  # fmt: skip
@click.pass_context
def umbrella(ctx: click.Context, config: Path) -> None:
    """Unbiased training data for neural light transport, and training on it while it grows.

    Options come from the command line, else from PHOTONFARM_… variables, else from the configuration file. Results go
    to stdout, all other messages go to stderr. Exit codes: 0 done, 2 wrong usage, 3 bad spec or request, 4 store, 5
    Redis, 6 this machine cannot render, 7 incomplete, 8 training diverged, 9 SLURM, 130 Ctrl-C, 1 anything else.
    """
    named = ctx.get_parameter_source("config") is not ParameterSource.DEFAULT
    if named or config.is_file():
        ctx.default_map = file_defaults(config, options_by_command(umbrella))
    if ctx.get_parameter_source("config") is ParameterSource.COMMANDLINE:
        ctx.with_resource(_told_to_child_processes(config))


@contextmanager
def _told_to_child_processes(config: Path) -> Iterator[None]:
    """Name the configuration file in our environment, so that verbs that this verb starts read the same one."""
    before = os.environ.get(CONFIG_VARIABLE)
    os.environ[CONFIG_VARIABLE] = str(config.absolute())
    try:
        yield
    finally:
        del os.environ[CONFIG_VARIABLE]
        if before is not None:
            os.environ[CONFIG_VARIABLE] = before


def main(args: list[str] | None = None) -> None:
    """Run the command line; an error of ours, and Ctrl-C, become one sentence and an exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # for terminals that lack × and …
    try:
        sys.exit(umbrella.main(args, prog_name="photonfarm", standalone_mode=False) or 0)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except click.Abort:
        _fail("stopped by Ctrl-C; what is stored stays", STOPPED)
    except PhotonfarmError as error:
        _fail(str(error), error.exit_code)
    except OSError as error:  # a file that a user named, and no code closer to it knew more
        _fail(f"{error.filename or 'a file, or the output'}: {error.strerror or error}", StoreError.exit_code)
    except Exception as error:
        if not _is_of_redis(error):
            raise
        _fail(f"Redis failed: {error}", QueueError.exit_code)


def _is_of_redis(error: Exception) -> bool:
    """Whether an error is one of Redis; whoever met one has imported its package, which takes its time."""
    redis = sys.modules.get("redis")
    return redis is not None and isinstance(error, redis.RedisError)


def _fail(sentence: str, exit_code: int) -> NoReturn:
    console = Console(stderr=True, soft_wrap=True)
    console.print("[bold red]photonfarm:[/]", markup.escape(sentence), highlight=False)
    sys.exit(exit_code)
