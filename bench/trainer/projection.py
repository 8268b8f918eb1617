"""Which points the projection keeps, against a brute-force oracle.

    python -m bench.trainer.projection [--scene room living-room ...] [--views 24] [--points 16384] [--judged 512]
        [--out docs/results]

Random views of random configurations, as the product samples them. In each, points that land in the image are judged in
float64 against every triangle, and by the trainer's `footprint` with each way to tell what is occluded. The ready rooms
are found under PHOTONFARM_SCENES. Exit code 0, or 2 if a scene is not there (the others are measured all the same).
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any, get_args

import torch

from bench.harness import results
from bench.trainer.projection_rooms import Counts, LoadedRoom, Viewed
from photonfarm.core.errors import SpecError
from photonfarm.trainer.runs.settings import Occlusion

TARGET_ROOMS = ("living-room", "living-room-2", "dining-room", "veach-ajar")
SCENES = ("room", *TARGET_ROOMS, "kitchen", "bathroom")
RECALL, LEAK = 0.99, 0.01
SIZE = 256  # the supplement's
RULES: tuple[Occlusion, ...] = get_args(Occlusion)


@dataclass
class RoomCounts:
    """What was counted in one room, over all views."""

    scene: str
    triangles: int
    judged: int = 0
    counts: dict[str, Counts] = field(default_factory=lambda: dict.fromkeys((*RULES, "moved"), Counts()))
    query_s: list[float] = field(default_factory=list)  # of each view

    def add(self, viewed: Viewed, room: LoadedRoom) -> None:
        """Count one view."""
        self.judged += len(viewed.judged)
        self.query_s.append(viewed.query_s)
        kept = {rule: viewed.kept(room.optics(rule))[viewed.judged] for rule in RULES}
        for rule in RULES:
            self.counts[rule] += Counts.of(viewed.truth, kept[rule])
        moved = viewed.moved[viewed.judged]
        self.counts["moved"] += Counts.of(viewed.truth & moved, kept["exact"] & moved)

    def document(self) -> dict[str, Any]:
        """The page's figures as JSON."""
        shares = {name: asdict(c) | {"recall": c.recall, "leak": c.leak} for name, c in self.counts.items()}
        return asdict(self) | {"counts": shares}


def measure(name: str, options: argparse.Namespace) -> RoomCounts:
    """All views of one room. Raises SpecError where it is not there."""
    room = LoadedRoom.load(name, options.points, SIZE)
    found = RoomCounts(name, len(room.geometry.faces))
    for viewed in room.views(options.views, options.judged):
        found.add(viewed, room)
    return found


# ---------------------------------------------------------------------------------------------------------------- page


def met(counts: Counts) -> bool:
    return counts.recall >= RECALL and counts.leak <= LEAK


def verdict(rooms: Iterable[RoomCounts]) -> str:
    """The rules that meet the target, and in how many rooms each does."""
    of = [found for found in rooms if found.scene in TARGET_ROOMS]
    if not of:
        return "None of the target's rooms was measured."
    names = ", ".join(found.scene for found in of)
    lines = [f"The target, recall ≥ {RECALL:.0%} and leak ≤ {LEAK:.0%} in {names}, is met", ""]
    for rule in RULES:
        counts = [found.counts[rule] for found in of]
        recalls, leaks = [c.recall for c in counts], [c.leak for c in counts]
        told = f"by `{rule}`{', the default,' if rule == 'exact' else ''} in {sum(map(met, counts))} of {len(of)}"
        told = f"**{told}**" if all(map(met, counts)) else told
        ranges = f"recall {min(recalls):.1%} … {max(recalls):.1%}, leak {min(leaks):.1%} … {max(leaks):.1%}"
        lines.append(f"- {told}: {ranges}")
    return "\n".join(lines)


def rooms_table(rooms: Iterable[RoomCounts]) -> str:
    """Recall and leak in percent; bold where both meet the target."""

    def pair(counts: Counts) -> str:
        text = f"{counts.recall:.1%} / {counts.leak:.1%}"
        return f"**{text}**" if met(counts) else text

    lines = [
        [found.scene, f"{found.triangles:,}", f"{found.judged:,}", f"{found.counts['exact'].seen:,}"]
        + [pair(found.counts[rule]) for rule in RULES]
        + [pair(found.counts["moved"]) if found.counts["moved"].seen else ""]
        for found in rooms
    ]
    header = ["room", "triangles", "points judged", "of these seen", *RULES, "exact, moved objects"]
    return results.table(header, lines)


def page(rooms: list[RoomCounts], options: argparse.Namespace) -> str:
    query_ms = 1e3 * statistics.median(s for found in rooms for s in found.query_s)
    return f"""# Projection: which points are kept

{verdict(rooms)}

`exact` takes what the renderer has found by a ray to each point, and stored, which is {query_ms:.1f} ms of CPU time and
{options.points // 8:,} bytes a view. The other rules look at the depth buffer. The page of
[a training step](train_step.md) has what projection costs a network.

## Which points are kept

Recall / leak; bold: the target is met. **Recall**: share kept of the points in the image that are seen. **Leak**: share
of the points kept that are not seen. {options.views} random views of each room at {SIZE}², two of each random
configuration, and up to {options.judged:,} random points in the image of each, judged by brute force: the line from the
eye to the point against every triangle, in float64 and without Mitsuba.

{rooms_table(rooms)}

Why no rule on a depth buffer will do (ε = 1e-3, near and far of the specs):

- **window**, the supplement's, lets pass behind a surface at depth z all that is no deeper than
  1 / (1/z − ε (1/near − 1/far)): with near = 0.01 that is 1.3 units at z = 3, and everything at z = 10. So backs of
  furniture, what is in cupboards, and the next room leak.
- **linear** and **relative** lose points of slanted surfaces, whose depth differs within a pixel.
- **surface**, ours, continues the surface of a pixel as a plane, and errs where that is none: a pixel with an edge in
  it has one depth, which is wrong for what it shows beyond. Leaves and slats finer than a pixel are all edges."""


def main() -> int:
    parser = results.parser(__doc__)
    parser.add_argument("--scene", nargs="+", default=list(SCENES), choices=SCENES)
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--points", type=int, default=16384)
    parser.add_argument("--judged", type=int, default=512, help="points of each view (512)")
    options = parser.parse_args()
    from photonfarm.renderer.scene import backend

    backend.load(threads=1)
    torch.set_num_threads(1)
    rooms, missing = [], False
    for name in options.scene:
        try:
            rooms.append(measure(name, options))
        except SpecError as error:
            print(f"projection: {error}", file=sys.stderr)
            missing = True
    if not rooms:
        return 2
    values = {"torch": torch.__version__, "views": options.views, "points": options.points}
    values |= {"rooms": [found.document() for found in rooms]}
    results.write("projection", page(rooms, options), values, options.out)
    return 2 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
