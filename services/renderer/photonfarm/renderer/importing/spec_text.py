"""The spec of an imported scene: TOML with comments, to be read and changed by hand."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.importing.changes import Changes
from photonfarm.renderer.importing.proposal.proposed import RADIANCE, Box, Ceiling, Movable, Proposal
from photonfarm.renderer.importing.proposal.surfaces import Frame
from photonfarm.renderer.strategy.output.spec_file import put

WIDTH = 110

MOST_NOTES = 10
"""The most sentences about what was changed that the spec repeats; the command prints all."""

DEPTH, HALF_SPP = 10, 16


@dataclass(slots=True)
class SpecText:
    """What the spec says; free space and exposure are put in when they are known."""

    name: str
    file: str  # of the scene, relative to the spec
    source: str  # the name of what was imported
    frame: Frame
    proposal: Proposal
    shapes: list[list[str]]  # the ids of each movable's shapes
    changes: Changes
    ceiling: Ceiling | None = None
    free_space: dict[str, Any] | None = None
    exposure: float = 1.0
    _lines: list[str] = field(default_factory=list)

    def text(self) -> str:
        """The whole file."""
        self._lines = []
        self._put_head()
        for movable, shapes in zip(self.proposal.movables, self.shapes, strict=True):
            self._put_movable(movable, shapes)
        if self.ceiling is not None:
            self._put_ceiling(self.ceiling)
        self._put_view()
        self._put_settings()
        text = "\n".join(self._lines) + "\n"
        return put(text, {"view": {"free_space": self.free_space}}, where=self.name) if self.free_space else text

    def _put_head(self) -> None:
        size = self.proposal.room.size
        self._say(
            f"Made by `photonfarm scene import` from {self.source}. Everything here is a proposal: change what you "
            "like. Lengths are in the scene's units; docs/scene-spec.md lists every key."
        )
        if self.free_space:
            self._say(
                "After a change of origin, look_at or near, or of a group's shapes or at, run "
                "`photonfarm scene free-space SPEC --write` again, which measures where cameras may stand."
            )
        lengths = [self._number(length) for length in size]
        self._say(f"The room is about {lengths[0]} × {lengths[1]}, and {lengths[2]} high.")
        for change in list(self.changes)[:MOST_NOTES]:
            self._say(str(change))
        self._lines += [
            f"name = {json.dumps(self.name)}",
            f"scene.file = {json.dumps(self.file, ensure_ascii=False)}",
            f"exposure = {self.exposure:.3g}  # a fixed factor for pictures and losses, from a quick render",
            "points = 16384  # of the base point cloud",
            "",
        ]

    def _put_movable(self, movable: Movable, shapes: list[str]) -> None:
        moves = bool((movable.box.low != movable.box.high).any())
        kind = "lights" if movable.thing.emits else "objects"
        hangs = "hangs from the ceiling" if movable.thing.hangs else "stands on the floor"
        self._say(f"{movable.thing.name}: {hangs}{'' if moves else '; there is no free place to move it to'}")
        x, y, z = self._point(movable.thing.size)
        self._lines += [f"[[{kind}]]", f"name = {json.dumps(movable.thing.name)}  # {x} × {y} × {z}"]
        self._lines += self._ids(shapes)
        self._lines += [f"at = {self._vector(movable.at)}", f"box = {self._box(movable.box)}"]
        self._lines += ["removal_probability = 0.2", ""] if kind == "objects" else [""]

    def _put_ceiling(self, ceiling: Ceiling) -> None:
        self._say("The scene has no light of its own that would do, so this one is added under the ceiling.")
        size = ", ".join(self._number(length) for length in ceiling.size)
        radiance = ", ".join(f"{part:g}" for part in RADIANCE)
        self._lines += [
            "[[lights]]",
            'name = "ceiling-light"',
            f"at = {self._vector(ceiling.at)}",
            f"box = {self._box(ceiling.box)}",
            f"rectangle = {{ size = [{size}], radiance = [{radiance}] }}",
            "",
        ]

    def _put_view(self) -> None:
        room = self.proposal.room
        up = ", ".join(f"{part:g}" for part in self.frame.up)
        far = 4 * float(np.linalg.norm(room.size))
        self._say("Cameras: a position in the first box, a point to look at in the second, both uniform.")
        self._lines += [
            "[view]",
            f"origin = {self._box(self.proposal.origin)}",
            f"look_at = {self._box(self.proposal.look_at)}",
            "fov_deg = 70  # along the width",
            f"up = [{up}]",
            f"near = {0.004 * room.height:.2g}",
            f"far = {far:.3g}",
            "",
        ]

    def _put_settings(self) -> None:
        self._lines += [
            "[film]",
            "width = 128  # multiples of 8",
            "height = 128",
            "",
            "[transport]  # `photonfarm scene plan SPEC --write` measures what this scene needs",
            f"max_depth = {DEPTH}  # edges of a path",
            f"half_spp = {HALF_SPP}  # samples per pixel of each of the halves A and B",
            "",
            "[photons]",
            "paths = 1024",
            "depth = 4",
        ]

    # ----------------------------------------------------------------------------------------------------- pieces

    def _say(self, sentence: str) -> None:
        self._lines += [f"# {line}" for line in textwrap.wrap(sentence, WIDTH, break_long_words=False)]

    def _ids(self, shapes: Iterable[str]) -> list[str]:
        quoted = [json.dumps(shape, ensure_ascii=False) for shape in shapes]
        line = f"shapes = [{', '.join(quoted)}]"
        if len(line) <= WIDTH:
            return [line]
        wrapped = textwrap.wrap(", ".join(quoted), WIDTH, break_long_words=False, break_on_hyphens=False)
        return ["shapes = [", *(f"    {part}" for part in wrapped), "]"]

    def _number(self, value: float) -> str:
        decimals = max(0, 3 - int(np.floor(np.log10(self.proposal.room.height))))
        return f"{round(float(value), decimals) + 0.0:g}"

    def _point(self, point: NDArray[np.float64]) -> list[str]:
        return [self._number(abs(part)) for part in self.frame.world(point)]

    def _vector(self, point: NDArray[np.float64]) -> str:
        return f"[{', '.join(self._number(part) for part in self.frame.world(point))}]"

    def _box(self, box: Box) -> str:
        low, high = self.frame.box(box.low, box.high)
        corners = [", ".join(map(self._number, corner)) for corner in (low, high)]
        return f"{{ min = [{corners[0]}], max = [{corners[1]}] }}"
