"""The spec of an imported scene: TOML with comments, to be read and changed by hand."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.importing.changes import Changes, listed
from photonfarm.renderer.importing.proposal.proposed import RADIANCE, Box, Movable, Proposal, View
from photonfarm.renderer.importing.proposal.surfaces import Frame
from photonfarm.renderer.strategy.output.spec_file import put

WIDTH = 110

MOST_NOTES = 10
"""The most sentences about what was changed that the spec repeats; the command prints all."""

SETTINGS = """\
[film]
width = 128  # multiples of 8
height = 128

[transport]  # `photonfarm scene plan SPEC --write` measures what this scene needs
max_depth = 10  # edges of a path
half_spp = 16  # samples per pixel of each of the halves A and B

[photons]
paths = 1024
depth = 4
"""

UNITS = {"millimetres": (1500, 8000), "centimetres": (150, 800), "inches": (60, 150)}
"""Heights of rooms that tell units other than metres."""


@dataclass(frozen=True, slots=True)
class SpecText:
    """What the spec says. It is never changed: what is measured of one holds for it and its copies with the result."""

    name: str
    file: str  # of the scene, relative to the spec
    source: str  # the name of what was imported
    frame: Frame
    proposal: Proposal
    shapes: list[list[str]]  # the ids of each movable's shapes
    shapeless: list[str]  # the kinds of lights that have no shape
    changes: Changes
    view: View
    adds_light: bool = False
    free_space: dict[str, Any] | None = None
    exposure: float = 1.0

    def text(self) -> str:
        """The whole file."""
        blocks = [*self._head(), *self._movables(), *self._stays(), *self._view()]
        text = "\n".join(blocks) + "\n" + SETTINGS
        return put(text, {"view": {"free_space": self.free_space}}, where=self.name) if self.free_space else text

    def found(self) -> list[str]:
        """What is proposed, a line each."""
        moves = self.proposal.movables
        things = [movable.thing.name for movable in moves if not movable.thing.emits]
        lamps = [movable.thing.name for movable in moves if movable.thing.emits]
        static = "nothing was found that stands by itself (if the scene lies on its side, see --up)"
        lights = [f"{listed(lamps, len(lamps))} may move"] * bool(lamps) + list(self._fixed_lights())
        lights += ["one is added under the ceiling"] * self.adds_light
        return [
            self._extent(),
            f"may move: {', '.join(things) or static}",
            f"lights: {'; '.join(lights) or 'a sky is added'}",
            f"exposure: {self.exposure:g}",
        ]

    def _extent(self) -> str:
        room = self.proposal.room
        x, y, z = (f"{part:.4g}" for part in room.size)
        if room.is_stage:
            return f"no room is found: what is there is {x} × {y} and {z} high, and seen from outside"
        if room.subject is not None:
            return f"outdoors: what stands on the ground is seen from above, in {x} × {y}"
        units = [unit for unit, (low, high) in UNITS.items() if room.has_ceiling and low <= room.height < high]
        guess = "".join(f"; lengths look like {unit}, and stay so" for unit in units)
        return f"room: {x} × {y}, and {z} high{'' if room.has_ceiling else ', without a ceiling'}{guess}"

    def _fixed_lights(self) -> Iterator[str]:
        for reason, names in self.proposal.stays.items():
            yield f"{listed(names)}: {'stays' if len(names) == 1 else 'stay'}, {reason}"
        if self.shapeless:
            yield f"{listed(self.shapeless)}: no shape, so that a spec cannot move it"

    def _head(self) -> Iterator[str]:
        yield from _said(
            f"Made by `photonfarm scene import` from {self.source}. Everything here is a proposal: change what you "
            "like. Lengths are in the scene's units; docs/scene-spec.md lists every key."
        )
        if self.free_space:
            yield from _said(
                "After a change of origin, look_at or near, or of a group's shapes or at, run "
                "`photonfarm scene free-space SPEC --write` again, which measures where cameras may stand."
            )
        yield from _said(f"{self._extent().capitalize()}.")
        for change in sorted(self.changes, key=lambda change: change.effect is None)[:MOST_NOTES]:
            yield from _said(str(change))
        yield f"name = {json.dumps(self.name)}"
        yield f"scene.file = {json.dumps(self.file, ensure_ascii=False)}"
        yield f"exposure = {self.exposure:.3g}  # a fixed factor for pictures and losses, from a quick render"
        yield "points = 16384  # of the base point cloud\n"

    def _movables(self) -> Iterator[str]:
        moved = zip(self.proposal.movables, self.shapes, strict=True)
        for movable, shapes in sorted(moved, key=lambda one: one[0].thing.emits):
            yield from _said(_where(movable))
            size = " × ".join(self._number(abs(part)) for part in self.frame.world(movable.thing.size))
            yield "[[lights]]" if movable.thing.emits else "[[objects]]"
            yield f"name = {json.dumps(movable.thing.name)}  # {size}"
            yield from _ids(shapes)
            yield from self._place(movable.at, movable.box)
            yield "" if movable.thing.emits else "removal_probability = 0.2\n"
        if self.adds_light:
            light = self.proposal.light
            yield from _said("The scene has no light of its own that reaches what cameras see, so this one is added.")
            yield '[[lights]]\nname = "ceiling-light"'
            yield from self._place((light.box.low + light.box.high) / 2, light.box)
            size, radiance = ", ".join(map(self._number, light.size)), ", ".join(f"{part:g}" for part in RADIANCE)
            yield f"rectangle = {{ size = [{size}], radiance = [{radiance}] }}\n"

    def _stays(self) -> Iterator[str]:
        said = [line for sentence in self._fixed_lights() for line in _said(f"Lights: {sentence}.")]
        yield from [*said, ""] if said else []

    def _view(self) -> Iterator[str]:
        room, corners = self.proposal.room, [*self.proposal.extent, *self.view.origin]
        reach = max(4 * np.linalg.norm(room.size), np.linalg.norm(np.ptp(corners, axis=0)))
        yield from _said("Cameras: a position in the first box, a point to look at in the second, both uniform.")
        yield "[view]"
        yield f"origin = {self._box(self.view.origin)}"
        yield f"look_at = {self._box(self.view.look_at)}"
        yield "fov_deg = 70  # along the width"
        yield f"up = [{', '.join(f'{part:g}' for part in self.frame.up)}]"
        yield f"near = {0.004 * room.height:.2g}"
        yield f"far = {reach:.3g}\n"

    def _place(self, at: NDArray[np.float64], box: Box) -> list[str]:
        return [f"at = [{', '.join(map(self._number, self.frame.world(at)))}]", f"box = {self._box(box)}"]

    def _number(self, value: float) -> str:
        """A length to about a thousandth of the room's height, however far from the origin it is."""
        decimals = max(0, 3 - int(np.floor(np.log10(self.proposal.room.height))))
        written = f"{round(float(value), decimals) + 0.0:.{decimals}f}"
        return written.rstrip("0").rstrip(".") if decimals else written

    def _box(self, box: Box) -> str:
        corners = [", ".join(map(self._number, corner)) for corner in self.frame.box(box.low, box.high)]
        return f"{{ min = [{corners[0]}], max = [{corners[1]}] }}"


def _where(movable: Movable) -> str:
    """Where a thing stands, in a sentence."""
    place = "hangs from the ceiling" if movable.thing.hangs else "stands on the floor"
    with_light = ", with its light" if movable.thing.emits and not movable.thing.hangs else ""
    moves = bool((movable.box.low != movable.box.high).any())
    return f"{movable.thing.name}: {place}{with_light}{'' if moves else '; there is no free place to move it to'}"


def _said(sentence: str) -> list[str]:
    return [f"# {line}" for line in textwrap.wrap(sentence, WIDTH, break_long_words=False)]


def _ids(shapes: Iterable[str]) -> list[str]:
    quoted = ", ".join(json.dumps(shape, ensure_ascii=False) for shape in shapes)
    if len(quoted) <= WIDTH - 11:
        return [f"shapes = [{quoted}]"]
    wrapped = textwrap.wrap(quoted, WIDTH, break_long_words=False, break_on_hyphens=False)
    return ["shapes = [", *(f"    {part}" for part in wrapped), "]"]
