#!/usr/bin/env python3
"""Writes docs/cli.md, every verb of `photonfarm` with its options, from the commands themselves.

`make docs` runs it before it builds the site; the page is not committed.
"""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path

import click

from photonfarm.cli.main import umbrella

PAGE = Path(__file__).parents[1] / "docs/cli.md"

HEAD = """\
# Command line

All verbs of `photonfarm`. The page is made from the code by `scripts/cli_page.py`; `photonfarm VERB --help` prints the
same on a terminal. Variables and a file can set defaults of options: [configuration.md](configuration.md) names them,
and the exit codes.
"""

SHARED = ("store", "redis_url", "as_json")
"""Options of many verbs, which are described once; by the names of their parameters."""

SHARED_HEAD = """\
## Options of many verbs
"""


def build_page() -> str:
    """The whole page."""
    commands = [*_walk_commands(umbrella, "photonfarm")]
    shared = {}
    for command, context in commands:
        for option in command.get_params(context):
            if option.name in SHARED:
                shared.setdefault(option.name, _describe_option(option, context))
    parts = [HEAD, SHARED_HEAD, "\n".join(shared[name] for name in SHARED) + "\n"]
    return "\n".join([*parts, *(part for command, context in commands for part in _describe_command(command, context))])


def _walk_commands(command: click.Command, name: str) -> Iterator[tuple[click.Command, click.Context]]:
    """A command and all that are below it, each with a context that knows its whole name."""
    context = click.Context(command, info_name=name)
    yield command, context
    if isinstance(command, click.Group):
        for verb in command.list_commands(context):
            below = command.get_command(context, verb)
            if below is not None:
                yield from _walk_commands(below, f"{name} {verb}")


def _describe_command(command: click.Command, context: click.Context) -> Iterator[str]:
    """What the page says of one command."""
    yield f"## {context.info_name}\n"
    yield f"    {context.info_name} {' '.join(command.collect_usage_pieces(context))}\n"
    yield _format_paragraphs(command.help or "")
    options = [option for option in command.get_params(context) if isinstance(option, click.Option)]
    options = [option for option in options if "--help" not in option.opts]
    items = [_describe_option(option, context) for option in options if option.name not in SHARED]
    shared = [f"`{option.opts[0]}`" for option in options if option.name in SHARED]
    if shared:
        items.append(f"- {', '.join(shared)}: see [above](#options-of-many-verbs)")
    if items:
        yield "\n".join(items) + "\n"


def _format_paragraphs(text: str) -> str:
    """A help text as Markdown; what click leaves unwrapped becomes code, but for its first line."""
    parts = []
    for part in re.split(r"\n\s*\n", inspect.cleandoc(text)):
        marked, _, unwrapped = part.partition("\b\n")
        head, _, lines = unwrapped.partition("\n")
        parts.append(_wrap(head or marked))
        if lines:
            parts.append(textwrap.indent(textwrap.dedent(lines), "    "))
    return "\n\n".join(parts) + "\n"


def _describe_option(option: click.Parameter, context: click.Context) -> str:
    """An option as an item of a list: how it is written, what it is for, its default, its range and its variable."""
    if not isinstance(option, click.Option):
        raise TypeError(f"{option.name}: only options have help texts")
    metavar = "" if option.is_flag else option.make_metavar(context).replace(" RANGE", "")
    choices = metavar.strip("[]").split("|") if metavar.startswith("[") and "|" in metavar else []
    spelling = ", ".join(option.opts) + (f" {metavar}" if metavar and not choices else "")
    help_text = (option.help or "").strip()
    by_hand = re.findall(r"\[default: (.*?)\]", help_text)
    facts = [f"One of {', '.join(f'`{choice}`' for choice in choices)}."] if choices else []
    facts += [re.sub(r"\s*\[default: .*?\]", "", help_text)]
    facts += [f"Default: {default}." for default in by_hand]
    extra = option.get_help_extra(context)
    if "default" in extra:
        facts.append(f"Default: `{extra['default']}`.")
    if "range" in extra:
        spaced = re.sub(r"[<>]=?", lambda sign: f" {sign[0].replace('<=', '≤').replace('>=', '≥')} ", extra["range"])
        facts.append(f"Allowed: `{spaced}`.")
    if option.envvar:
        facts.append(f"Variable: `{option.envvar}`.")
    if "required" in extra:
        facts.append("Required.")
    return _wrap(f"- `{spelling}`: {' '.join(filter(None, facts))}", hanging="  ")


def _wrap(text: str, hanging: str = "") -> str:
    """Text in lines of at most 120 letters, with what HTML would take for a tag made harmless outside of code."""
    parts = " ".join(text.split()).split("`")
    safe = "`".join(part if i % 2 else part.replace("<", "&lt;") for i, part in enumerate(parts))
    return textwrap.fill(safe, 120, subsequent_indent=hanging, break_long_words=False, break_on_hyphens=False)


if __name__ == "__main__":
    PAGE.write_text(build_page())
