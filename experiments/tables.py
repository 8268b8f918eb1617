#!/usr/bin/env python3
"""Puts the reports of experiments together: the paper's Tables 1 and 2 over our rooms, and what agrees with them.

    python experiments/tables.py [--size small] [--work build/experiments] [--out docs/results]

Reads WORK/SIZE/NAME/report/report.json of every experiment that has one, and leaves tables.md, tables.json
and tables.png, for the paper's size tables-paper.md and so on. Rooms that the JSON in OUT has, and that have no report
here, stay, and are said on stderr: they may have run elsewhere. Delete a room's entry, and it goes. What was found out
stands in experiments/findings.md, with which the page of the small size begins. Exit code 0, 3 where a report's views
are not independent, or 7 where there is neither a report nor a room that stays.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import get_args

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script this finds its own folder alone

from bench.harness import results
from experiments import equal_time
from experiments.experiment import HERE, Experiment, Part, SizeName, list_names
from experiments.paper_tables import CLOSE, describe_lacking, format_errors, format_further_metrics, format_orders
from experiments.rooms import Room, format_costs, format_descriptions, format_rooms, summarise, wrap
from photonfarm.core.errors import IncompleteError, PhotonfarmError
from photonfarm.trainer.report.contents import FIXED_LIGHTS, MOVABLE_LIGHTS, PublishedTable

PARTS: Mapping[Part, tuple[str, PublishedTable]] = {
    "fixed": ("Table 1: movable objects, fixed lights", FIXED_LIGHTS),
    "movable": ("Table 2: movable objects and lights; the lights that move are all the light", MOVABLE_LIGHTS),
    "daylight": ("The rooms of Table 2 by day: windows and sky add light that does not move", MOVABLE_LIGHTS),
    "vanishing": ("A room of Table 2 with lamps that vanish", MOVABLE_LIGHTS),
    "static": ("Static rooms", {}),
    "ablation": ("The supplement's static ablation", {}),
}
"""The page's parts: title, and the paper's figures."""

_OF_PRESETS = (
    "demodulation 0.2, relative maxima, the logarithm of emission, 2 octaves, exact occlusion, a cosine schedule"
)

RECIPES: Mapping[SizeName, str] = {
    "small": f"{_OF_PRESETS}, averaged weights",
    "card": f"{_OF_PRESETS}, averaged weights, bfloat16",
    "paper": "demodulation 0.2, 2 octaves, exact occlusion",
}
"""What differs from the supplement in the training of its networks, beside the loss."""


def format_page(rooms: Sequence[Room], size: SizeName) -> str:
    """All of it as Markdown. Raises SpecError as `Room.gap` does."""
    parts = [f"# The paper's tables over our rooms, `{size}`", wrap(introduce(rooms, size))]
    best = equal_time.format_best(rooms, equal_time.list_longest(rooms))
    parts.append(OF_TIME.format(picture=f"{name_page(size)}.png", best=best))
    findings = HERE / "findings.md"
    if size == "small" and findings.is_file():
        parts.append(findings.read_text(encoding="utf-8").strip())
    parts.append(explain_reading(rooms, size))
    for part, (title, published) in PARTS.items():
        if of_part := [room for room in rooms if room.experiment.part == part]:
            parts += _format_part(of_part, title, published)
    parts.append(OF_FAMILIES.format(table=equal_time.format_table(rooms)))
    made = (
        f"Timed on {summarise(rooms, Room.machine)}. The reports are made by `make experiments-{size}`, this page by "
        f"`{name_command(size)}`."
    )
    return "\n\n".join([*parts, wrap(made)])


def _format_part(rooms: Sequence[Room], title: str, published: PublishedTable) -> list[str]:
    """The tables of some rooms: pairs, errors, further metrics, and what they were measured on."""
    means = wrap(f"Means over: {', '.join(room.name for room in rooms)}.{describe_lacking(rooms)}")
    return [
        f"## {title}",
        f"### Pairs of networks, by MSE\n\n{format_orders(rooms, published)}",
        f"### Error and time in each room\n\n{OF_ROWS}\n\n{equal_time.format_rows(rooms)}",
        f"### Means over the rooms\n\n{means}\n\n{format_errors(rooms, published)}",
        f"### Further times and metrics\n\n{format_further_metrics(rooms, published)}",
        f"### The rooms\n\n{format_rooms(rooms)}",
        format_costs(rooms),
        format_descriptions(rooms),
    ]


def name_page(size: SizeName) -> str:
    """The name of a size's page."""
    return "tables" if size == "small" else f"tables-{size}"


def name_command(size: SizeName) -> str:
    """What makes the page of the reports."""
    return f"python experiments/tables.py --size {size}"


def introduce(rooms: Sequence[Room], size: SizeName) -> str:
    """What was run, as the sizes and the reports tell."""
    sizes = summarise(rooms, lambda room: str(room.document["size"]))
    return (
        f"The size `{size}`: {sizes}. {_describe_resolution(rooms)} All networks "
        "and denoisers but OIDN are trained on one room's images alone. denoise_k and oidn 1/k are given 1/k of the "
        "pixels of one noisy half-estimate, oidn n/1 the mean of n of them; none is the input itself, not denoised."
        f"{_describe_cameras(rooms)}"
    )


def _describe_cameras(rooms: Sequence[Room]) -> str:
    """Which rooms are of views that are not drawn any more, if any."""
    without = [room.name for room in rooms if not room.has_free_space]
    if not without:
        return ""
    which = "All rows" if len(without) == len(rooms) else f"The rows of {', '.join(without)}"
    return (
        f" {which} were rendered before the experiments' specs had `view.free_space`: their cameras could stand "
        "inside furniture, and none of their figures is of the specs as they are now."
    )


def _describe_resolution(rooms: Sequence[Room]) -> str:
    """Whether a GPU took part, and what is at the paper's resolution."""
    films = summarise(rooms, lambda room: f"{room.film[0]} × {room.film[1]}")
    at_paper = [room.name for room in rooms if room.film == room.paper_film]
    if len(at_paper) == len(rooms):
        reached = "everything"
    else:
        reached = f"of the rooms only {', '.join(at_paper)}" if at_paper else "nothing here"
    size = f"{reached} is at the paper's resolution; images are {films}."
    if any(room.device.startswith("cuda") for room in rooms):
        return f"A GPU took part: networks ran on {summarise(rooms, lambda room: room.device)}; {size}"
    return f"No GPU was at hand: {size}"


READING = """\
## How to read the tables

**Networks.** Rows named cnn, feature_projection, light_transport and light_transport_photons are the paper's networks
trained by our recipe (a {loss} loss, {recipe}, {rates}), not by the supplement's to the letter; what differs is in
[Train and evaluate](../training.md#presets). Those named guided are ours.

**Errors** are against references in the metric space, clip(exposure · I, 0, 1)^(1/2.2); the references' noise is taken
out of MSE and is in all other metrics. MSE of networks is the mean of all their seeds, and all else is the first
seed's. Intervals are over held-out configurations (95 %, Student's t). FID is of as few images as there are references,
so it can be compared within this page only.

**Pairs.** A cell is how far the first's MSE is above the second's, as a share of the first's (in brackets its 95 %
interval, then each seed's gap; of two networks the seeds that both have). Two networks are told apart where the
interval excludes 0 and all seeds agree on the sign. ≈ is a gap of less than {close:.0f} %; < and > say whose error is
larger.

**Time** is from the scene to the image on one core. The tables of means leave out editing the scene, which all need:
each room's table has it as “edit”. Everywhere else it is included. A column “× light_transport” is the time of a frame
over that of light_transport, without editing.

**The paper's figures** stand in columns named “paper”; they are of four other rooms' average at 256² on the authors'
machine. No value can be compared with ours; of the times only the ratios between networks can. Denoisers' cannot: they
depend on the samples per pixel that are rendered for them, here those of one half, and of small images launching the
renderer costs most.

**Rooms.** Connections and light ratio are settings of `bdpt`, light samples a setting of the guides
([scene spec](../scene-spec.md)). Why they were chosen so stands below the tables, with what moves.

n/a: not measured, or a row that a room lacks. –: not in the paper."""


def explain_reading(rooms: Sequence[Room], size: SizeName) -> str:
    """What the tables' figures are, and what they can be compared with."""
    loss = summarise(rooms, lambda room: str(room.experiment.size.train["loss"]))
    rates = summarise(rooms, Room.layer_rates)
    paragraphs = READING.format(loss=loss, recipe=RECIPES[size], rates=rates, close=100 * CLOSE).split("\n\n")
    return "\n\n".join(wrap(paragraph) for paragraph in paragraphs)


OF_TIME = """\
## Error against the time of a frame

![MSE over the time of a frame, room by room]({picture})

Ours beside the best denoiser of each moment: the error, the time, and the error as a share of what the best of Open
Image Denoise and the denoisers of the room has at the same time, with its 95 % interval over the views.
`guided_transport` is given no sample of the view; `guided_denoise` is given one half-estimate, or the mean of 4 or 16.
≥ marks frames that take longer than the slowest denoiser. How families are compared is explained
[below](#ours-beside-each-family-at-the-same-time).

{best}"""


OF_ROWS = "MSE ± half its 95 % interval; in brackets the milliseconds of a frame, all charged."


OF_FAMILIES = """\
## Ours beside each family at the same time

Everything is charged: editing the scene, buffers, guides, photons, samples that a denoiser is given, and the network,
on one core. OIDN is given one half-estimate of each pixel, or of one of 4, or the mean of 2 to 16, which are halves A
of further passes; `guided_denoise` one, or the mean of as many, which its line joins; errors are by the halves B of the
references, and what is timed is one image of all these samples. OIDN's three qualities are one family, once by diffuse
albedo and once by reflectance, whose guides take no shadow rays and are charged so. `bdpt` and Mitsuba's `path` are not
denoised. Of a family count those rows that no quicker one has less error than; between two of these the error is taken
to follow a power of the time. Below 1 ours is ahead of the best that the family reaches in the same time. Intervals are
a bootstrap over configurations.

In frames longer than its slowest row, a family is credited with the least error that it has reached by then. Such
ratios are marked ≥: our advantage is at most what they say.

{table}"""


def make_parser() -> argparse.ArgumentParser:
    """The options of the command line."""
    parser = results.parser(__doc__)
    parser.add_argument("--size", choices=get_args(SizeName), default="small")
    parser.add_argument("--work", type=Path, default=results.ROOT / "build/experiments", help="(build/experiments)")
    return parser


def read_rooms(work: Path, size: SizeName, earlier: Path) -> list[Room]:
    """Those that have a report here, and those that an earlier page has.

    Raises IncompleteError where none is.
    """
    try:
        documents = json.loads(earlier.read_text(encoding="utf-8"))["rooms"] if earlier.is_file() else {}
    except (ValueError, KeyError, TypeError) as error:
        raise IncompleteError(f"{earlier}: holds no rooms ({error!r}); move it away, and it is made anew") from error
    rooms = []
    for name in list_names():
        experiment, report = Experiment.load(name, size), work / name / "report/report.json"
        if report.is_file():
            rooms.append(Room.read(experiment, report, results.commit()))
        elif name in documents:
            rooms.append(Room(experiment, documents[name]))
            print(f"{name}: no report in {work}; its rows of {earlier} stay", file=sys.stderr)
    if not rooms:
        raise IncompleteError(f"{work}: holds no report; `make experiments-{size}` makes them")
    return rooms


def main() -> int:
    """Write the page; returns the exit code."""
    told = make_parser().parse_args()
    try:
        rooms = read_rooms(told.work / told.size, told.size, told.out / f"{name_page(told.size)}.json")
        text = format_page(rooms, told.size)
    except PhotonfarmError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    told.out.mkdir(parents=True, exist_ok=True)
    drawn = [room for room in rooms if room.experiment.part != "ablation"] or rooms  # that has no denoisers
    (told.out / f"{name_page(told.size)}.png").write_bytes(equal_time.draw_picture(drawn))
    told_of = {
        "command": name_command(told.size),
        "commit": results.commit(),
        "machine": "each room's own",  # and not the one that this runs on
        "size": told.size,
        "rooms": {room.name: room.document for room in rooms},
    }
    results.save(name_page(told.size), text, told_of, told.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
