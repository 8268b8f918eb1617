"""The command `photonfarm`: its verbs, its configuration file, and its exit codes.

Verbs are entry points of the group `photonfarm.commands`, each imported only when it is used. The entry point "scene"
is the verb `photonfarm scene`, a group, and "scene.plan" is a subcommand of it.
"""

from __future__ import annotations

import difflib
import io
import os
import re
import sys
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from importlib.metadata import EntryPoint, entry_points, requires
from pathlib import Path
from typing import Any, NoReturn

import click
from click.core import ParameterSource
from rich import markup
from rich.console import Console

from photonfarm.core.errors import PhotonfarmError, QueueError, SpecError, StoreError, say_install
from photonfarm.core.processes import GROUP

Options = Mapping[str, Mapping[str, str]]
"""The options of each verb, and of each subcommand as "verb.subcommand": names without dashes → parameters."""

EVERY_VERB = "all"
"""The table of what holds for every verb. It needs no place above the tables, where TOML would not take `store` beside
a table [store.check]."""


def file_defaults(path: Path, options: Options) -> dict[str, Any]:
    """Defaults by verb from a TOML file: a table per verb; the table `all` holds for every verb that has its keys.

    Keys above all tables do the same, and `all` overrules them. A subcommand's table is `[verb.subcommand]`; its
    defaults are stored under its name among those of its verb. Raises SpecError for a file that cannot be read, and for
    a verb or an option that does not exist.
    """
    try:
        tables = tomllib.loads(path.read_text())
    except OSError as error:
        raise SpecError(f"{path}: cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise SpecError(f"{path}: is not a readable TOML file: {error}") from error
    defaults: dict[str, Any] = {verb: {} for verb in options if "." not in verb}
    common = tables.pop(EVERY_VERB, {})
    if not isinstance(common, dict):
        raise SpecError(f"{path}: {EVERY_VERB} = {common!r}: is the table [{EVERY_VERB}], of options of every verb")
    named = [key for key, value in tables.items() if key in options and isinstance(value, dict)]
    above = {key: value for key, value in tables.items() if key not in named}
    for key, value in (above | common).items():
        takers = [verb for verb, known in options.items() if key in known]
        if not takers or isinstance(value, dict):
            place = f"{EVERY_VERB}.{key}" if key in common else key
            rule = "no option of any verb" if key in common else "neither a verb with a table nor an option of any verb"
            raise SpecError(f"{path}: {place} = {value!r}: is {rule}")
        for verb in takers:
            _of(defaults, verb)[options[verb][key]] = value
    for verb in named:
        _read_table(path, verb, tables[verb], options, defaults)
    return defaults


def _read_table(path: Path, verb: str, table: Mapping[str, Any], options: Options, defaults: dict[str, Any]) -> None:
    for key, value in table.items():
        if isinstance(value, dict) and f"{verb}.{key}" in options:
            _read_table(path, f"{verb}.{key}", value, options, defaults)
            continue
        if key not in options[verb]:
            known = ", ".join(sorted(options[verb])) or "none"
            raise SpecError(f"{path}: {verb}.{key} = {value!r}: options of {verb.replace('.', ' ')} are {known}")
        _of(defaults, verb)[options[verb][key]] = value


def _of(defaults: dict[str, Any], verb: str) -> dict[str, Any]:
    """The defaults of one verb or subcommand."""
    for name in verb.split("."):
        defaults = defaults.setdefault(name, {})
    return defaults


_BARE = {"store": "Look into the sample store, check it, and repair it."}
"""The help texts of groups that have no entry point of their own."""


@cache
def _find_verbs() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=GROUP)}


class Verbs(click.Group):
    """A group with subcommands that are entry points, each imported only when it is used."""

    def __init__(self, *arguments: Any, prefix: str = "", **settings: Any) -> None:
        """Take what the names of the entry points begin with, beside what click takes."""
        super().__init__(*arguments, **settings)
        self._prefix = prefix

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The group's own subcommands and the installed ones."""
        below = [name.removeprefix(self._prefix) for name in _find_verbs() if name.startswith(self._prefix)]
        return sorted({*super().list_commands(ctx), *(name.partition(".")[0] for name in below)})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The subcommand, imported only now; None for one that there is not."""
        if "." in cmd_name:
            return None
        name = self._prefix + cmd_name
        entry = _find_verbs().get(name)
        command = entry.load() if entry else super().get_command(ctx, cmd_name)
        if not any(known.startswith(f"{name}.") for known in _find_verbs()):
            return command
        about = command.help if command else _BARE.get(name)
        return Verbs(cmd_name, help=about, commands=getattr(command, "commands", None), prefix=f"{name}.")

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The verb with its name and the arguments behind it; raises UsageError with verbs that resemble an unknown."""
        name = args[0]
        if self.get_command(ctx, name) is None and not ctx.resilient_parsing:
            near = difflib.get_close_matches(name, self.list_commands(ctx))
            near += [known.replace(".", " ") for known in sorted(_find_verbs()) if known.endswith(f".{name}")]
            hint = f" Did you mean {' or '.join(map(repr, near))}?" if near else ""
            raise click.UsageError(f"No such command {name!r}.{hint}", ctx)
        return super().resolve_command(ctx, args)


def options_by_command(umbrella: click.Group) -> dict[str, dict[str, str]]:
    """The options of each verb, and of each subcommand as "verb.subcommand": names without dashes → parameters."""
    return {
        name: {
            flag.lstrip("-"): str(option.name)
            for option in command.params
            if isinstance(option, click.Option)
            for flag in option.opts
        }
        for name, command in _commands(umbrella, "")
    }


def _commands(group: click.Group, prefix: str) -> Iterator[tuple[str, click.Command]]:
    ctx = click.Context(group)
    for name in group.list_commands(ctx):
        command = group.get_command(ctx, name)
        if command is not None:
            yield prefix + name, command
            if isinstance(command, click.Group):
                yield from _commands(command, f"{prefix}{name}.")


FORMERLY = {"--sample": "--row", "--modification": "--place", "--view": "--camera"}
"""What options are called now."""

STOPPED = 130
"""The exit code after Ctrl-C, as shells give it."""

CONFIG_VARIABLE = "PHOTONFARM_CONFIG"


@click.group(cls=Verbs, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(package_name="photonfarm", prog_name="photonfarm")
@click.option(
    "--config",
    type=click.Path(path_type=Path),
    envvar=CONFIG_VARIABLE,
    default="photonfarm.toml",
    show_default=True,
    help="Defaults for options, a table per verb.",
)
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
        ctx.with_resource(_tell_child_processes(config))


@contextmanager
def _tell_child_processes(config: Path) -> Iterator[None]:
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
        if isinstance(error, click.NoSuchOption) and error.ctx is not None:
            now = FORMERLY.get(error.option_name)
            if now and any(now in each.opts for each in error.ctx.command.params):
                said = f"No such option {error.option_name!r}; {now} does what it did."
                error = click.NoSuchOption(error.option_name, said, ctx=error.ctx)
        error.show()
        sys.exit(error.exit_code)
    except click.Abort:
        _fail("stopped by Ctrl-C; what is stored stays", STOPPED)
    except PhotonfarmError as error:
        _fail(str(error), error.exit_code)
    except OSError as error:  # a file that a user named, and no code closer to it knew more
        _fail(f"{error.filename or 'a file, or the output'}: {error.strerror or error}", StoreError.exit_code)
    except ModuleNotFoundError as error:
        if (extra := _extra_of(error.name or "")) is None:
            raise
        _fail(f"this needs the package {error.name}: {say_install(extra)}", click.UsageError.exit_code)
    except Exception as error:
        if not _is_of_redis(error):
            raise
        _fail(f"Redis failed: {error}", QueueError.exit_code)


def _extra_of(package: str) -> str | None:
    """The extra of photonfarm that brings a package; None if none does."""
    for requirement in requires("photonfarm") or ():
        name, _, marker = requirement.partition(";")
        if re.match(package.replace("_", "[-_.]") + r"\b", name, re.IGNORECASE) and (
            extra := re.search(r"extra == .(\w+)", marker)
        ):
            return extra[1]
    return None


def _is_of_redis(error: Exception) -> bool:
    """Whether an error is one of Redis; whoever met one has imported its package, which takes its time."""
    redis = sys.modules.get("redis")
    return redis is not None and isinstance(error, redis.RedisError)


def _fail(sentence: str, exit_code: int) -> NoReturn:
    console = Console(stderr=True, soft_wrap=True)
    console.print("[bold red]photonfarm:[/]", markup.escape(sentence), highlight=False)
    sys.exit(exit_code)
