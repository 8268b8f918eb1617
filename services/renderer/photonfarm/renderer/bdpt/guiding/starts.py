"""The table by which light paths start: probabilities of lights and of cells of their squares.

Index letters: N lights, K² cells of a light's square of directions, P² cells of its square of positions. Cells are
numbered light after light, along Morton's curve of directions, then along that of positions: T = N·K²·P² in all. A
light path's number chooses its cell and its point in it, so that paths of close numbers still start alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.bdpt.guiding.grid import cell_of
from photonfarm.renderer.bdpt.randomness import Sampler, corner_of, point_on_curve

F64 = NDArray[np.float64]

MOST_CELLS = 1 << 14
"""The most cells of a table: more would learn little and cost memory."""


def table_of(values: F64, count: int, what: str) -> mi.Float:
    """So many values as device data. Raises ValueError unless all are finite and above 0."""
    if values.shape != (count,) or not (np.isfinite(values).all() and (values > 0).all()):
        raise ValueError(
            f"bdpt: a {what} has the shape {values.shape}; ({count},) finite numbers above 0 are required, or light "
            "would be lost"
        )
    return mi.Float(values.tolist())


@dataclass(frozen=True, slots=True)
class Layout:
    """How many cells a table has."""

    lights: int  # N
    directions: int  # K, a power of two
    positions: int  # P, a power of two

    @classmethod
    def of(cls, lights: int) -> Layout:
        """The layout for so many lights."""
        directions, positions = 32, 4
        while lights * (directions * positions) ** 2 > MOST_CELLS and positions > 1:
            positions //= 2
        while lights * (directions * positions) ** 2 > MOST_CELLS and directions > 1:
            directions //= 2
        return cls(lights, directions, positions)

    @property
    def cells_per_light(self) -> int:
        """The number of cells of one light, K²·P²."""
        return (self.directions * self.positions) ** 2

    @property
    def cells(self) -> int:
        """The number of all cells, T."""
        return self.lights * self.cells_per_light


@dataclass(frozen=True, slots=True, eq=False)
class StartGuide:
    """What was learned: by which factor more light paths should start in a cell than by default."""

    layout: Layout
    gain: mi.Float  # [T], above 0; only their proportions matter

    @classmethod
    def of(cls, layout: Layout, gain: F64) -> StartGuide:
        """A guide of gains [T]. Raises ValueError unless all are finite and above 0."""
        return cls(layout, table_of(gain, layout.cells, "table of a guide's gains"))

    @classmethod
    def neutral(cls, layout: Layout) -> StartGuide:
        """The guide that changes no probability."""
        return cls.of(layout, np.ones(layout.cells))


@dataclass(slots=True)
class GuidedStarts:
    """A guide with the lights of a scene as they are now. Tables "by id" are indexed by the emitter's registry id."""

    layout: Layout
    cdf: mi.Float64  # [T]: running sums of probabilities
    gain: mi.Float  # [T]: probability over that of the default; over the positions' mean where these are not guided
    number: mi.UInt32  # by id: the light's number among the N
    rectangle: mi.UInt32  # [N]: 1 for lights whose positions are guided

    @classmethod
    def bind(
        cls, guide: StartGuide, probability: mi.Float, ids: Sequence[int], rectangles: Sequence[bool]
    ) -> GuidedStarts:
        """The table for lights with default probabilities [N], in device memory, without host synchronisation.

        Raises ValueError for a guide of another number of lights.
        """
        layout = guide.layout
        if layout.lights != len(ids):
            raise ValueError(
                f"bdpt: the guide was learned with {layout.lights} lights, the scene has {len(ids)}; learn another one"
            )
        rectangle = mi.UInt32([int(is_rectangle) for is_rectangle in rectangles])
        light = dr.arange(mi.UInt32, layout.cells) // layout.cells_per_light
        places = layout.positions**2
        gain = guide.gain
        if places > 1:
            mean = dr.repeat(dr.block_sum(gain, places), places) / places
            gain = dr.select(dr.gather(mi.UInt32, rectangle, light) > 0, gain, mean)
        table = mi.Float64(gain) * mi.Float64(dr.gather(mi.Float, probability, light) / layout.cells_per_light)
        cdf = dr.cumsum(table)
        total = dr.gather(mi.Float64, cdf, mi.UInt32(layout.cells - 1))
        gain = dr.select(total > 0, mi.Float(mi.Float64(gain) / total), 0)
        number = dr.zeros(mi.UInt32, max(ids) + 1)
        dr.scatter(number, dr.arange(mi.UInt32, len(ids)), mi.UInt32(list(ids)))
        dr.eval(cdf, gain, number, rectangle)
        return cls(layout, cdf, gain, number, rectangle)

    def number_of(self, emitter: mi.EmitterPtr) -> mi.UInt32:
        """The numbers of emitters among the N; 0 for the null pointer."""
        return dr.gather(mi.UInt32, self.number, dr.reinterpret_array(mi.UInt32, emitter))

    def gain_at(self, light: mi.UInt32, direction: mi.Point2f, position: mi.Point2f, active: mi.Bool) -> mi.Float:
        """The density of starts at points of a light's squares, over that of the default."""
        layout = self.layout
        cell = light * layout.directions**2 + cell_of(direction, layout.directions)
        if layout.positions > 1:
            place = cell_of(position, layout.positions)
            cell = cell * layout.positions**2 + dr.select(self._is_rectangle(light), place, 0)
        return dr.gather(mi.Float, self.gain, cell, active)

    def draw(self, path: mi.UInt32, paths: mi.UInt32, rng: Sampler) -> DrawnStart:
        """Starts of the light paths ``path`` among ``paths`` [1]."""
        layout, last = self.layout, self.layout.cells - 1
        # 48 bits: a cell may be far smaller than a path's share of [0, 1), and a Float would know few places in it
        fine = mi.Float64(rng.next_1d()) + mi.Float64(rng.next_independent()) / (1 << 24)
        below = mi.Point2f(rng.next_independent(), rng.next_independent())
        place = (mi.Float64(path) + fine) / mi.Float64(paths)
        target = place * dr.gather(mi.Float64, self.cdf, mi.UInt32(last))
        cell = mi.UInt32(dr.binary_search(0, last, lambda i: dr.gather(mi.Float64, self.cdf, i) <= target))
        start = dr.gather(mi.Float64, self.cdf, dr.maximum(cell, 1) - 1, cell > 0)
        rest = (target - start) / (dr.gather(mi.Float64, self.cdf, cell) - start)  # the place in the cell, in [0, 1)
        inside = point_on_curve(mi.UInt32(dr.clip(rest, 0, 1 - 2.0**-33) * 4294967296.0), below)
        square = cell // layout.positions**2
        light = square // layout.directions**2
        direction = (corner_of(square - light * layout.directions**2) + inside) / layout.directions
        position = rng.next_2d()
        if layout.positions > 1:
            corner = corner_of(cell - square * layout.positions**2)
            position = dr.select(self._is_rectangle(light), (corner + position) / layout.positions, position)
        return DrawnStart(light, cell, direction, position, dr.gather(mi.Float, self.gain, cell))

    def _is_rectangle(self, light: mi.UInt32) -> mi.Bool:
        return dr.gather(mi.UInt32, self.rectangle, light) > 0


@dataclass(slots=True)
class DrawnStart:
    """Where light paths start."""

    light: mi.UInt32  # number among the N
    cell: mi.UInt32  # number among the T
    direction: mi.Point2f  # point of the square of directions
    position: mi.Point2f  # point of the square of positions
    gain: mi.Float  # the density of such starts over that of the default


def rectangles(emitters: Sequence[Any]) -> list[bool]:
    """Whether each light is a rectangle, whose texture coordinates say where on it a point lies."""
    shapes = [emitter.get_shape() for emitter in emitters]
    return [shape is not None and shape.class_name() == "Rectangle" for shape in shapes]
