"""The verbs of the command line: entry points of the group `photonfarm.commands`, each imported only when it is used.

The entry point "report" is the verb `photonfarm report`, and "report.stability" is a subcommand of it, even if another
distribution provides the verb. A verb that is a command of its own stays one; a verb whose distribution is not
installed becomes a group without a command.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

import click

from photonfarm.shared.core.commands import GROUP

_BARE = {"store": "Look into the sample store, check it, and repair it."}
"""The help texts of groups that are not verbs themselves."""


@cache
def _installed() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=GROUP)}


class Suggesting(click.Group):
    """A group that answers an unknown verb with those that resemble it, also with `store check` to `check`."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The verb with its name and the arguments behind it; raises UsageError for an unknown one."""
        name = args[0]
        if self.get_command(ctx, name) is None and not ctx.resilient_parsing:
            near = difflib.get_close_matches(name, self.list_commands(ctx))
            near += [known.replace(".", " ") for known in sorted(_installed()) if known.endswith(f".{name}")]
            hint = f" Did you mean {' or '.join(map(repr, near))}?" if near else ""
            raise click.UsageError(f"No such command {name!r}.{hint}", ctx)
        return super().resolve_command(ctx, args)


class Umbrella(Suggesting):
    """A group whose verbs are those of the services that are installed."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        """The installed verbs."""
        return sorted({name.partition(".")[0] for name in _installed()})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The verb, imported only now."""
        if cmd_name not in self.list_commands(ctx):
            return None
        entry = _installed().get(cmd_name)
        command = None if entry is None else entry.load()
        prefix = f"{cmd_name}."
        below = {name.removeprefix(prefix): sub for name, sub in _installed().items() if name.startswith(prefix)}
        return Extended(cmd_name, command, below) if below else command


class Extended(Suggesting):
    """A verb with subcommands of other distributions below it."""

    def __init__(self, name: str, own: click.Command | None, below: dict[str, EntryPoint]) -> None:
        """Take the verb as its own distribution has it, None where that is not installed."""
        runs_alone = own is not None and not isinstance(own, click.Group)
        super().__init__(
            name,
            help=own.help if own else _BARE.get(name, f"What the installed services have under `{name}`."),
            params=list(own.params) if own else None,
            commands=own.commands if isinstance(own, click.Group) else None,
            callback=_unless_below(own) if own and runs_alone else own and own.callback,
            invoke_without_command=runs_alone,
            subcommand_metavar="[COMMAND [ARGS]...]" if runs_alone else None,
        )
        self._below = below

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The verb's own subcommands and those of others."""
        return sorted({*super().list_commands(ctx), *self._below})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The subcommand; that of another distribution is imported only now."""
        entry = self._below.get(cmd_name)
        return super().get_command(ctx, cmd_name) if entry is None else entry.load()


def _unless_below(own: click.Command) -> Any:
    """The verb's own callback, used when no subcommand follows; it refuses options that stand before a subcommand."""

    @click.pass_context
    def run(ctx: click.Context, /, **options: Any) -> Any:
        if ctx.invoked_subcommand is None:
            return ctx.invoke(own.callback, **options) if own.callback else None
        for parameter in own.params:
            if ctx.get_parameter_source(str(parameter.name)) is click.core.ParameterSource.COMMANDLINE:
                raise click.UsageError(
                    f"{parameter.opts[0]} belongs behind {ctx.invoked_subcommand!r}, if it has this option", ctx
                )
        return None

    return run


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
