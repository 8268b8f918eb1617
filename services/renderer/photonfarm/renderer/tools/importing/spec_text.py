"""The spec of an imported scene: TOML with comments, to be read and changed by hand."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from photonfarm.renderer.tools.importing.changes import Changes, name_some
from photonfarm.renderer.tools.importing.proposal.proposed import RADIANCE, Proposal, View
from photonfarm.renderer.tools.importing.proposal.surfaces import Box, Frame, Points
from photonfarm.renderer.tools.spec_file import put

WIDTH = 110

OFF = 0.02
"""A box that is farther than this share of the room's height from where its thing stands is said to be."""

MOST_NOTES = 10
"""The most sentences about what was changed that the spec repeats; the command prints all."""

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
    shapeless: list[str]  # the names of lights that have no shape
    changes: Changes
    view: View
    adds_light: bool = False
    free_space: dict[str, Any] | None = None
    exposure: float = 1.0

    def text(self) -> str:
        """The whole file."""
        room, view = self.proposal.room, self.view
        corners = np.concatenate([*self.proposal.extent, *view.origin]).reshape(-1, 3)
        reach = max(4 * np.linalg.norm(room.size), np.linalg.norm(np.ptp(corners, axis=0)))
        lights = _comment(*(f"Lights: {sentence}." for sentence in self._describe_fixed_lights()))
        text = f"""\
{_comment(*self._head())}\
name = {json.dumps(self.name)}
scene.file = {json.dumps(self.file, ensure_ascii=False)}
exposure = {self.exposure:.3g}  # a fixed factor for pictures and losses, from a quick render
points = 16384  # of the base point cloud

{"".join(self._groups())}{lights and lights + chr(10)}\
# Cameras: a position in the first box, a point to look at in the second, both uniform.
[view]
origin = {self._box(view.origin)}
look_at = {self._box(view.look_at)}
fov_deg = 70  # along the width
up = [{", ".join(f"{part:g}" for part in self.frame.up)}]
near = {0.004 * room.height:.2g}
far = {reach:.3g}

[film]
width = 128  # multiples of 8
height = 128

[transport]  # `photonfarm scene plan SPEC --write` measures what this scene needs
max_depth = 10  # edges of a path
half_spp = 16  # samples per pixel of each of the halves A and B

[photons]
paths = 1024
depth = 4

[guides]
lights_in_glass = true  # what glass reflects of lamps and sky
"""
        return put(text, {"view": {"free_space": self.free_space}}, where=self.name) if self.free_space else text

    def describe(self) -> list[str]:
        """What is proposed, a line each."""
        moves = self.proposal.movables
        things = [movable.thing.name for movable in moves if not movable.thing.emits]
        lamps = [movable.thing.name for movable in moves if movable.thing.emits]
        static = "nothing was found that stands by itself"
        if not self.source.lower().endswith(".xml") and not self.proposal.room.is_stage:
            static += ", and no object is split: separate it in your program, by loose parts, to let these move"
        if self.source.lower().endswith(".obj"):
            static += "; if the scene lies on its side, try --up z, as OBJ does not say what is up"
        lights = [f"{name_some(lamps, len(lamps))} may move"] * bool(lamps) + list(self._describe_fixed_lights())
        lights += ["one is added above what cameras see"] * self.adds_light
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

    def _describe_fixed_lights(self) -> Iterator[str]:
        for reason, names in self.proposal.stays.items():
            yield f"{name_some(names)}: {'stays' if len(names) == 1 else 'stay'}, {reason}"
        if self.shapeless:
            yield f"{name_some(self.shapeless)}: cannot move, as a spec moves shapes"

    def _head(self) -> Iterator[str]:
        yield (
            f"Made by `photonfarm scene import` from {self.source}. Everything here is a proposal: change what you "
            "like. Lengths are in the scene's units; docs/scene-spec.md lists every key."
        )
        if self.free_space:
            yield (
                "After a change of origin, look_at or near, or of a group's shapes or at, run "
                "`photonfarm scene free-space SPEC --write` again, which measures where cameras may stand."
            )
        yield f"{self._extent().capitalize()}."
        yield from map(str, sorted(self.changes, key=lambda change: change.effect is None)[:MOST_NOTES])

    def _groups(self) -> Iterator[str]:
        moved = zip(self.proposal.movables, self.shapes, strict=True)
        for (thing, box), shapes in sorted(moved, key=lambda one: one[0].thing.emits):
            x, y, z = map(self._number, thing.size)
            place = "hangs from the ceiling" if thing.hangs else "stands on the floor"
            off = float(np.maximum(box.low - thing.at, thing.at - box.high)[:2].max())
            is_off = off > OFF * self.proposal.room.height
            where = f"; its box begins {self._number(off)} from there, clear of what stays" if is_off else ""
            where = where if (box.low != box.high).any() else "; there is no free place to move it to"
            named = f"{json.dumps(thing.name)}  # {x} × {y}, and {z} high; it {place}{where}"
            own = f"shapes = {json.dumps(shapes, ensure_ascii=False)}"
            end = "" if thing.emits else "removal_probability = 0.2\n"
            yield self._group("lights" if thing.emits else "objects", named, own, thing.at, box) + end + "\n"
        if self.adds_light:
            light = self.proposal.light
            size, radiance = ", ".join(map(self._number, light.size)), ", ".join(f"{part:g}" for part in RADIANCE)
            own = f"rectangle = {{ size = [{size}], radiance = [{radiance}] }}"
            yield _comment("The scene has no light of its own that reaches what cameras see, so this one is added.")
            yield self._group("lights", '"ceiling-light"', own, (light.box.low + light.box.high) / 2, light.box) + "\n"

    def _group(self, kind: str, name: str, own: str, at: Points, box: Box) -> str:
        place = ", ".join(map(self._number, self.frame.world(at)))
        return f"[[{kind}]]\nname = {name}\n{own}\nat = [{place}]\nbox = {self._box(box)}\n"

    def _number(self, value: float) -> str:
        """A length to about a thousandth of the room's height, however far from the origin it is."""
        decimals = max(0, 3 - int(np.floor(np.log10(self.proposal.room.height))))
        written = f"{round(float(value), decimals) + 0.0:.{decimals}f}"
        return written.rstrip("0").rstrip(".") if decimals else written

    def _box(self, box: Box) -> str:
        corners = [", ".join(map(self._number, corner)) for corner in self.frame.box(box)]
        return f"{{ min = [{corners[0]}], max = [{corners[1]}] }}"


def _comment(*sentences: str) -> str:
    lines = [line for one in sentences for line in textwrap.wrap(one, WIDTH, break_long_words=False)]
    return "".join(f"# {line}\n" for line in lines)
