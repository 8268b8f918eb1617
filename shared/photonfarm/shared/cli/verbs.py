"""The verbs of the command line: entry points of the group `photonfarm.commands`, each imported only when it is used.

The entry point "scene" is the verb `photonfarm scene`, a group, and "scene.plan" is a subcommand of it, even if another
distribution provides the verb.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from functools import cache
from importlib.metadata import EntryPoint, entry_points

import click

from photonfarm.shared.core.commands import GROUP

_BARE = {"store": "Look into the sample store, check it, and repair it."}
"""The help texts of groups that have no entry point of their own."""


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
    """A group with subcommands that have entry points of their own."""

    def __init__(self, name: str, own: click.Group | None, below: dict[str, EntryPoint]) -> None:
        """Take the group of the verb's own entry point, None where it has none."""
        super().__init__(name, help=own.help if own else _BARE[name], commands=own.commands if own else None)
        self._below = below

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The verb's own subcommands and those of others."""
        return sorted({*super().list_commands(ctx), *self._below})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The subcommand; that of another distribution is imported only now."""
        entry = self._below.get(cmd_name)
        return super().get_command(ctx, cmd_name) if entry is None else entry.load()


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
