"""What the figures of each room were measured on: what was rendered and why so, what it cost, and at which commits."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Sequence

from experiments.rooms import Room
from photonfarm.core.formatting import format_markdown_table
from photonfarm.trainer.metrics.image_metrics import NOT_AVAILABLE

WIDTH = 120  # characters of a line


def format_rooms(rooms: Sequence[Room]) -> str:
    """The images of each room, and how they were rendered."""
    head = (
        "experiment",
        "images trained on",
        "held out",
        "spp",
        "references",
        "noise of targets, linear MSE",
        "connections",
        "light ratio",
        "light samples",
    )
    return format_markdown_table(head, [_describe_rendering(room) for room in rooms])


def _describe_rendering(room: Room) -> list[str]:
    card, evaluation = room.document["dataset"], room.document["evaluation"]
    trained_on = sorted({run["trained_on"] for run in room.document["runs"].values()})
    images, references, guides = room.spent("samples"), evaluation["references"], card.get("guides")
    return [
        room.name,
        " or ".join(map(str, trained_on)),
        " or ".join(f"{images['rows'] - count}" for count in reversed(trained_on)),
        f"{card['spp_per_sample']}",
        f"{references['views']} views, {references['spp']} spp" if references else NOT_AVAILABLE,
        f"{evaluation['noise_floor']:.3g}",
        f"{card['transport']['connections']}",
        f"{card['transport']['light_ratio']:g}",
        f"{guides['light_samples']}" if guides else NOT_AVAILABLE,
    ]


def format_costs(rooms: Sequence[Room]) -> str:
    """What each room took, and whether the machine was quiet."""
    head = (
        "experiment",
        "images, core-s",
        "reference passes",
        "passes, core-s",
        "MB in all",
        "edit, ms",
        "load average of 1, 5, 15 min",
    )
    return format_markdown_table(head, [_describe_cost(room) for room in rooms])


def _describe_cost(room: Room) -> list[str]:
    images, passes, edit = room.spent("samples"), room.spent("top-up"), room.document["edit_seconds"]
    return [
        room.name,
        f"{images['core_seconds']:.0f}",
        f"{passes['rows']}",
        f"{passes['core_seconds']:.0f}",
        f"{room.document['dataset']['bytes'] / 1e6:.0f}",
        NOT_AVAILABLE if edit is None else f"{1e3 * edit:.0f}",
        ", ".join(f"{average:.1f}" for average in room.document["machine"]["load_average"]),
    ]


def format_descriptions(rooms: Sequence[Room]) -> str:
    """A list of the rooms: what moves, why they are rendered so, who is credited for them, and commits."""
    return "\n".join(wrap(_describe(room), "- ", "  ") for room in rooms)


def _describe(room: Room) -> str:
    document, owed = room.document, room.document["dataset"]["credits"]
    scene = "" if owed is None else f" Scene: “{owed['title']}” by {owed['author']}, {owed['licence']}."
    commits = ", ".join(room.commits())
    trained = f"Trained at commit {commits}" if commits else "At which commit it was trained was not recorded"
    return (
        f"**{room.name}** ({document['title']}): {document['about']}{scene} {trained}; its report was "
        f"read at commit {document['commit']}."
    )


def summarise(rooms: Sequence[Room], of: Callable[[Room], str]) -> str:
    """What holds of most rooms, and then what holds of the others, with their names."""
    rooms_by_text: dict[str, list[str]] = {}
    for room in rooms:
        rooms_by_text.setdefault(of(room), []).append(room.name)
    most = max(rooms_by_text, key=lambda what: len(rooms_by_text[what]))
    others = [f"{', '.join(which)}: {what}" for what, which in rooms_by_text.items() if what != most]
    return f"{most} ({'; '.join(others)})" if others else most


def wrap(text: str, first: str = "", others: str = "") -> str:
    """A paragraph in lines of at most WIDTH characters after `first` and `others`; code and links are not broken."""
    whole = re.sub(r"`[^`]*`|\[[^\]]*\]", lambda match: match[0].replace(" ", "\0"), text)
    filled = textwrap.fill(
        whole, WIDTH, initial_indent=first, subsequent_indent=others, break_long_words=False, break_on_hyphens=False
    )
    return filled.replace("\0", " ")
