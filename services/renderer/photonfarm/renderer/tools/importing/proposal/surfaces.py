"""All triangles of a loaded scene, and their connected pieces, in a frame whose third axis points up.

Letters: S shapes, F faces, N pieces, T groups of pieces, M points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from photonfarm.core.errors import SpecError
from photonfarm.renderer.tools.importing.imported import Vector

Points = NDArray[np.float64]
"""Coordinates (…, 3): two along the floor, in the order of the world's axes, and the height."""

Labels = NDArray[np.int64]

SECTIONS = 24
"""The sections of round shapes, of which a scene may have thousands: 576 triangles of a sphere, within 1 % of it."""

SAMPLES_PER_CELL = 4.0
"""Points on a surface for each area of a cell's side, so that few cells that it crosses have none."""

MOST_SAMPLES = 2_000_000


class Box(NamedTuple):
    """A box in the frame."""

    low: Points  # (3,)
    high: Points  # (3,)


@dataclass(frozen=True, slots=True)
class Frame:
    """The axes of the world, with the one that points up as the last."""

    up: Vector

    @property
    def _rows(self) -> NDArray[np.float64]:
        across = np.delete(np.eye(3), int(np.argmax(np.abs(self.up))), axis=0)
        return np.vstack([across, self.up])

    def inward(self, world: NDArray[Any]) -> Points:
        """World coordinates (…, 3) in the frame."""
        return world.astype(np.float64) @ self._rows.T

    def world(self, points: Points) -> NDArray[np.float64]:
        """Coordinates of the frame in the world."""
        return points @ self._rows

    def box(self, box: Box) -> Box:
        """A box of the frame, in the world."""
        corners = self.world(np.stack(box))
        return Box(corners.min(axis=0), corners.max(axis=0))


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """The triangles of a scene, in the frame."""

    ids: list[str]  # of the shapes, in the scene's order
    emits: NDArray[np.bool_]  # (S,)
    corners: Points  # (F, 3 corners, 3)
    shape: NDArray[np.int32]  # (F,)
    area: NDArray[np.float64]  # (F,)
    facing_up: NDArray[np.float64]  # (F,): the height component of the normal, without its sign
    lights: Points  # (L, 3): where lights without a shape are

    @classmethod
    def of(cls, scene: Any, frame: Frame) -> Self:
        """The surfaces of a Mitsuba scene; raises SpecError for one of no extent."""
        from photonfarm.renderer.scene.base_cloud import geometry_of

        shapes = scene.shapes()
        geometry = geometry_of(shapes, {}, SECTIONS)
        corners = frame.inward(geometry.vertices)[geometry.faces]
        if not np.isfinite(corners).all() or not len(corners) or not np.ptp(corners.reshape(-1, 3), axis=0).any():
            raise SpecError("the scene has no extent; nothing can be rendered")
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(across, axis=1)
        facing = np.abs(across[:, 2]) / np.maximum(length, 1e-30)
        emits = np.array([shape.is_emitter() for shape in shapes])
        ids, lights = [shape.id() for shape in shapes], frame.inward(_lights_without_shape(scene))
        return cls(ids, emits, corners, geometry.face_shape, length / 2, facing, lights)

    @property
    def extent(self) -> Box:
        """The box around all."""
        return Box(self.corners.min(axis=(0, 1)), self.corners.max(axis=(0, 1)))

    def main(self) -> Box:
        """The box around what makes up the scene: without its lights, and what is above or below it far away.

        That is what is separated from a larger surface by more than the length of all that is below.
        """
        low, high = bounds(self.shape, len(self.ids), self.corners.min(axis=1), self.corners.max(axis=1))
        chosen = np.flatnonzero(~self.emits if not self.emits.all() else self.emits)
        order = chosen[np.argsort(low[chosen, 2])]
        lower, upper = np.minimum.accumulate(low[order]), np.maximum.accumulate(high[order])
        gap = low[order[1:], 2] - upper[:-1, 2] > (upper - lower).max(axis=1)[:-1]
        part = np.concatenate([[0], np.cumsum(gap)])
        area = np.bincount(self.shape, self.area, len(self.ids))[order]
        kept = order[part == np.argmax(np.bincount(part, area))]
        return Box(low[kept].min(axis=0), high[kept].max(axis=0))


def _lights_without_shape(scene: Any) -> NDArray[np.float64]:
    """Where the points, spots and projectors of a scene are, (L, 3); of these, projectors have no box."""
    import mitsuba as mi

    lights = [each for each in scene.emitters() if mi.has_flag(each.flags(), mi.EmitterFlags.DeltaPosition)]
    places = [box.min if (box := each.bbox()).valid() else each.world_transform().translation() for each in lights]
    return np.array([np.array(place).ravel() for place in places], np.float64).reshape(-1, 3)


def bounds(label: NDArray[np.integer[Any]], count: int, lower: Points, upper: Points) -> tuple[Points, Points]:
    """The corners (count, 3) around all boxes of a label (N,), by their corners (N, 3)."""
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, label, lower)
    np.maximum.at(high, label, upper)
    return low, high


@dataclass(frozen=True, slots=True, eq=False)
class Pieces:
    """Connected parts of shapes, with points on them."""

    label: Labels  # (F,): the piece of each face
    shape: Labels  # (N,): the shape of each piece
    low: Points  # (N, 3)
    high: Points  # (N, 3)
    area: NDArray[np.float64]  # (N,)
    flat: NDArray[np.float64]  # (N,): the share of its area that lies flat
    sample: Points  # (M, 3): points on all surfaces
    sample_piece: Labels  # (M,)
    sample_flat: NDArray[np.bool_]  # (M,): whether it is on a face that lies flat

    @classmethod
    def of(cls, surfaces: Surfaces, cell: float, widest: float) -> Self:
        """The pieces of all shapes, with points about half a cell apart, or more on faces above `widest`²."""
        label = _connect(surfaces)
        count = int(label.max()) + 1
        low, high = bounds(label, count, surfaces.corners.min(axis=1), surfaces.corners.max(axis=1))
        shape = np.zeros(count, np.int64)
        shape[label] = surfaces.shape
        flat = surfaces.facing_up > 0.9
        area = np.bincount(label, surfaces.area, count).astype(np.float64)
        level = np.bincount(label, surfaces.area * flat, count) / np.maximum(area, 1e-30)
        face, sample = _samples(surfaces, cell, widest)
        return cls(label, shape, low, high, area, level, sample, label[face], flat[face])

    def touching(self, cell: float, among: NDArray[np.bool_], owner: Labels) -> Labels:
        """Numbers (N,) of what touches and has the same owner; −1 for pieces that are not `among` those asked for.

        Pieces touch if points on them share a cell of one of two grids, which are half a cell apart.
        """
        chosen = among[self.sample_piece]
        piece = self.sample_piece[chosen]
        cells = len(among) + _cells(self.sample[chosen], cell, owner[piece])
        return number_components(np.column_stack([np.tile(piece, 2), cells]), len(among), among)

    def contacts(self, cell: float, group: Labels, above: float = -np.inf) -> Any:
        """The number of cells `above` a height where groups (N,) meet, and where each is: sparse, (T + 1, T + 1).

        Its last row and column are those of the group −1.
        """
        chosen, count = self.sample[:, 2] > above, int(group.max(initial=-1)) + 1
        label = np.where(group < 0, count, group)[self.sample_piece[chosen]]
        cells = _cells(self.sample[chosen], cell, np.zeros_like(label))
        shape = (count + 1, int(cells.max(initial=0)) + 1)
        is_in = coo_matrix((np.ones(len(cells), np.int64), (np.tile(label, 2), cells)), shape).tocsr()
        is_in.data[:] = 1
        return is_in @ is_in.T


def _cells(position: Points, size: float, owner: Labels) -> Labels:
    """The numbers of the cells that points (M, 3) of owners (M,) are in, of one grid and then of another, (2 M,)."""
    shifted = np.concatenate([position / size, position / size + 0.5])
    key = _hash_rows([*np.floor(shifted).astype(np.int64).T, np.tile(owner, 2), np.repeat([0, 1], len(owner))])
    return np.unique(key, return_inverse=True)[1]


def number_components(pairs: Labels, count: int, among: NDArray[np.bool_]) -> Labels:
    """Consecutive numbers (count,) of what pairs (K, 2) connect; −1 for what is not `among` what counts.

    Pairs may name others, from `count` on, which connect as well.
    """
    nodes = max(count, int(pairs.max(initial=-1)) + 1)
    edges = coo_matrix((np.ones(len(pairs), np.int8), tuple(pairs.T)), (nodes, nodes))
    _, label = connected_components(edges, directed=False)
    made = np.full(count, -1, np.int64)
    made[among] = np.unique(label[:count][among], return_inverse=True)[1]
    return made


def _connect(surfaces: Surfaces) -> Labels:
    """The connected piece of each face; corners in one place are one corner."""
    corners, count = surfaces.corners.reshape(-1, 3), len(surfaces.shape)
    extent = float(np.ptp(corners, axis=0).max()) or 1.0
    place = np.round(corners / (1e-6 * extent)).astype(np.int64)
    key = _hash_rows([*place.T, np.repeat(surfaces.shape.astype(np.int64), 3)])
    corner = np.unique(key, return_inverse=True)[1]
    pairs = np.column_stack([np.repeat(np.arange(count), 3), count + corner])
    return number_components(pairs, count, np.ones(count, np.bool_))


def _hash_rows(columns: list[Labels]) -> Labels:
    """One number for each row of whole numbers; different rows have the same one with a chance of 2⁻⁶⁴."""
    mixed = np.zeros(len(columns[0]), np.uint64)
    for column in columns:
        mixed = (mixed ^ column.astype(np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    return mixed.view(np.int64)


def _samples(surfaces: Surfaces, cell: float, widest: float) -> tuple[Labels, Points]:
    """Faces (M,) and points on them (M, 3): the middle of each face, and random ones by area."""
    rng = np.random.default_rng(0)
    wanted = np.minimum(surfaces.area, widest**2) * SAMPLES_PER_CELL / cell**2
    wanted *= min(1.0, MOST_SAMPLES / max(wanted.sum(), 1.0))
    face = np.repeat(np.arange(len(wanted)), rng.poisson(wanted))
    share = rng.uniform(size=(2, len(face)))
    u, v = np.where(share.sum(axis=0) > 1, 1 - share, share)
    corner = surfaces.corners[face]
    inner = corner[:, 0] + u[:, None] * (corner[:, 1] - corner[:, 0]) + v[:, None] * (corner[:, 2] - corner[:, 0])
    every = np.arange(len(wanted))
    return np.concatenate([every, face]), np.concatenate([surfaces.corners.mean(axis=1), inner])
