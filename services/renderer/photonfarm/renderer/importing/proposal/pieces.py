"""Surfaces taken apart into connected pieces, and pieces that touch put together. Letters: F faces, N pieces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from photonfarm.renderer.importing.proposal.surfaces import Points, Surfaces, bounds

Labels = NDArray[np.int64]

SAMPLES_PER_CELL = 4.0
"""Points on a surface for each area of a cell's side, so that few cells that it crosses have none."""

MOST_SAMPLES = 2_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Pieces:
    """Connected parts of shapes, with points on them."""

    count: int  # N
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
        count, label = _connected(surfaces)
        low, high = bounds(label, count, surfaces.corners.min(axis=1), surfaces.corners.max(axis=1))
        shape = np.zeros(count, np.int64)
        shape[label] = surfaces.shape
        flat = surfaces.facing_up > 0.9
        area = np.bincount(label, surfaces.area, count).astype(np.float64)
        face, sample = _samples(surfaces, cell, widest)
        level = np.bincount(label, surfaces.area * flat, count) / np.maximum(area, 1e-30)
        return cls(count, label, shape, low, high, area, level, sample, label[face], flat[face])

    def touching(self, cell: float, among: NDArray[np.bool_], owner: Labels) -> Labels:
        """Numbers (N,) of what touches and has the same owner; −1 for pieces that are not `among` those asked for.

        Pieces touch if points on them share a cell of one of two grids, which are half a cell apart.
        """
        piece = self.sample_piece
        chosen = among[piece]
        shared, _ = _shared(self.sample[chosen], cell, piece[chosen], owner[piece[chosen]])
        return numbered(shared, self.count, among)

    def contacts(self, cell: float, group: Labels, above: float = -np.inf) -> tuple[Labels, Labels, Labels]:
        """Pairs (K, 2) of groups (N,) that touch, in how many cells (K,), and the group of each cell.

        Pieces of group −1, and all that is not `above` a height, are ignored.
        """
        chosen = (group[self.sample_piece] >= 0) & (self.sample[:, 2] > above)
        label = group[self.sample_piece[chosen]]
        shared, owned = _shared(self.sample[chosen], cell, label, np.zeros_like(label))
        unique, times = np.unique(np.sort(shared, axis=1), axis=0, return_counts=True)
        return unique, times.astype(np.int64), owned


def _shared(position: Points, cell: float, label: Labels, owner: Labels) -> tuple[Labels, Labels]:
    """Pairs (K, 2) of neighbours in the list of labels of each cell and owner, and the labels of all cells."""
    pairs, owned = [np.zeros((0, 2), np.int64)], [np.zeros(0, np.int64)]
    for shift in (0.0, 0.5):
        place = np.floor(position / cell + shift).astype(np.int64)
        key, found = _distinct(_hashed([*place.T, owner]), label)
        same = key[1:] == key[:-1]
        pairs.append(np.stack([found[:-1][same], found[1:][same]], axis=1))
        owned.append(found)
    return np.concatenate(pairs), np.concatenate(owned)


def _distinct(key: Labels, label: Labels) -> tuple[Labels, Labels]:
    """The distinct pairs of keys and labels, in order; ten times as fast as numpy's `unique` of rows."""
    order = np.lexsort((label, key))
    key, label = key[order], label[order]
    new = np.ones(len(key), np.bool_)
    new[1:] = (key[1:] != key[:-1]) | (label[1:] != label[:-1])
    return key[new], label[new]


def numbered(pairs: Labels, count: int, among: NDArray[np.bool_]) -> Labels:
    """Consecutive numbers (count,) of what pairs connect, in order; −1 for what is not `among` what counts."""
    _, label = connected_components(graph(pairs, count), directed=False)
    made = np.full(count, -1, np.int64)
    made[among] = np.unique(label[among], return_inverse=True)[1]
    return made


def graph(pairs: Labels, count: int) -> Any:
    """The graph of pairs (K, 2) of numbers below `count`, for scipy."""
    return coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), (count, count))


def _connected(surfaces: Surfaces) -> tuple[int, Labels]:
    """The number of connected pieces, and the piece of each face; corners in one place are one corner."""
    corners = surfaces.corners.reshape(-1, 3)
    extent = float((corners.max(axis=0) - corners.min(axis=0)).max()) or 1.0
    place = np.round(corners / (1e-6 * extent)).astype(np.int64)
    key = _hashed([*place.T, np.repeat(surfaces.shape.astype(np.int64), 3)])
    _, vertex = np.unique(key, return_inverse=True)
    vertex = vertex.reshape(-1, 3)
    pairs = np.concatenate([vertex[:, :2], vertex[:, 1:]]).astype(np.int64)
    _, label = connected_components(graph(pairs, int(vertex.max()) + 1), directed=False)
    _, face_label = np.unique(label[vertex[:, 0]], return_inverse=True)
    return int(face_label.max()) + 1, face_label.astype(np.int64)


def _hashed(columns: list[Labels]) -> Labels:
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
    u, v = rng.uniform(size=(2, len(face)))
    fold = u + v > 1
    u, v = np.where(fold, 1 - u, u), np.where(fold, 1 - v, v)
    corner = surfaces.corners[face]
    inner = corner[:, 0] + u[:, None] * (corner[:, 1] - corner[:, 0]) + v[:, None] * (corner[:, 2] - corner[:, 0])
    every = np.arange(len(wanted))
    return np.concatenate([every, face]), np.concatenate([surfaces.corners.mean(axis=1), inner])
