"""The room that a scene shows from within: its floor, its ceiling and its sides, found by rays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.importing.proposal.surfaces import Frame, Points, Surfaces
from photonfarm.shared.core.errors import SpecError

RAYS = 512
"""The rays from each point of view."""

ROUNDS, VIEWPOINTS = 3, 48
"""How often the points of view are chosen anew, and how many they are: so that niches are seen too."""

FACING = 0.9
"""Surfaces count as floor, ceiling or wall up to this cosine between normal and axis."""

SIDE_SHARE = 0.08
"""The outermost place that has this share of the hits on surfaces that face inwards is a side of the room."""

BEYOND = 0.15
"""No place is a side beyond which more than this share of all hits lie: there the room is open."""

OPEN_SHARE = 0.5
"""There is a ceiling if more than this share of steep rays hit something."""

LEVEL, BACKS = 0.5, 0.95
"""Rays within 30 degrees of the horizon count as level; where more than that share of all hits are backs of surfaces,
the point of view is inside of a thing, and not of a room."""


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """A box that the room's inner surfaces lie on."""

    low: Points  # (3,)
    high: Points  # (3,); its height is that of what stands there, in a scene without a ceiling
    has_ceiling: bool
    is_stage: bool = False  # nothing encloses: what is there is seen from outside

    @property
    def size(self) -> Points:
        """Its two lengths and its height, (3,)."""
        return self.high - self.low

    @property
    def height(self) -> float:
        """The distance from the floor to the ceiling."""
        return float(self.high[2] - self.low[2])

    @property
    def floor(self) -> float:
        """The height of the floor."""
        return float(self.low[2])


@dataclass(frozen=True, slots=True, eq=False)
class _Hits:
    origin: Points  # (N, 3)
    direction: Points  # (N, 3)
    distance: NDArray[np.float64]  # (N,); infinite without a hit
    normal: Points  # (N, 3), towards the ray's origin
    is_back: NDArray[np.bool_]  # (N,): whether it is a surface's back that was hit

    @property
    def found(self) -> NDArray[np.bool_]:
        return np.isfinite(self.distance)

    @property
    def position(self) -> Points:
        return self.origin[self.found] + self.distance[self.found, None] * self.direction[self.found]


def find_room(scene: Any, surfaces: Surfaces, frame: Frame, camera: Points | None) -> Room:
    """The room around the camera, or around a point that is chosen; raises SpecError for a scene of no extent."""
    rng = np.random.default_rng(0)
    low, high = surfaces.corners.min(axis=(0, 1)), surfaces.corners.max(axis=(0, 1))
    if not np.isfinite(low).all() or max(high - low) <= 0:
        raise SpecError("the scene has no extent; nothing can be rendered")
    within = bool(camera is not None and ((camera >= low) & (camera <= high)).all())
    viewpoints = camera[None] if camera is not None and within else _best_viewpoint(scene, frame, low, high, rng)
    seen = []
    for _ in range(ROUNDS):
        hits = _cast(scene, frame, viewpoints, rng)
        seen.append(hits)
        if not hits.found.any():
            break
        viewpoints = _along(hits, rng)
    if camera is None and _is_stage(seen[0]):
        return Room(low, high, has_ceiling=False, is_stage=True)
    return _room(seen, low, high)


def _is_stage(hits: _Hits) -> bool:
    """Whether there is no room: most rays along the ground leave the scene, or all that they meet are backs."""
    level = np.abs(hits.direction[:, 2]) < LEVEL
    return bool(hits.found[level].mean() < OPEN_SHARE or hits.is_back[hits.found].mean() > BACKS)


def _best_viewpoint(scene: Any, frame: Frame, low: Points, high: Points, rng: np.random.Generator) -> Points:
    """A point (1, 3) from which most rays hit something, and what they hit is far."""
    steps = [(np.arange(n) + 0.5) / n for n in (8, 8, 4)]
    grid = low + (high - low) * np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    hits = _cast(scene, frame, grid, rng, rays=64)
    distance = hits.distance.reshape(len(grid), -1)
    enclosed = np.isfinite(distance).mean(axis=1)
    reach = np.median(np.where(np.isfinite(distance), distance, 0), axis=1)
    reach[enclosed < 0.9 * enclosed.max()] = 0
    return grid[[int(np.argmax(reach))]]


def _along(hits: _Hits, rng: np.random.Generator) -> Points:
    """Points on the way to what was hit."""
    chosen = rng.choice(np.flatnonzero(hits.found), min(VIEWPOINTS, int(hits.found.sum())), replace=False)
    share = rng.uniform(0.2, 0.8, (len(chosen), 1))
    made: Points = hits.origin[chosen] + share * hits.distance[chosen, None] * hits.direction[chosen]
    return made


def _cast(scene: Any, frame: Frame, viewpoints: Points, rng: np.random.Generator, rays: int = RAYS) -> _Hits:
    """The hits of random rays from each viewpoint."""
    direction = rng.standard_normal((len(viewpoints) * rays, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = np.repeat(viewpoints, rays, axis=0)
    distance, normal = trace(scene, frame, origin, direction)
    along = np.sign((normal * direction).sum(axis=1, keepdims=True))
    return _Hits(origin, direction, distance, normal * -along, along[:, 0] > 0)


def trace(scene: Any, frame: Frame, origin: Points, direction: Points) -> tuple[NDArray[np.float64], Points]:
    """Distances (N,) to the first surfaces, infinite without one, and their normals (N, 3) as modelled."""
    import drjit as dr
    import mitsuba as mi

    from photonfarm.renderer.scene.arrays import points

    o, d = (points(frame.world(x).astype(np.float32)) for x in (origin, direction))
    si = scene.ray_intersect(mi.Ray3f(o=o, d=mi.Vector3f(d), time=0, wavelengths=[]))
    normal = dr.select(si.is_valid(), si.n, 0)
    distance = np.array(dr.select(si.is_valid(), si.t, dr.inf), np.float64)
    return distance, frame.inward(np.array(normal, np.float64).T)


def _room(seen: list[_Hits], low: Points, high: Points) -> Room:
    found = np.concatenate([hits.found for hits in seen])
    if not found.any():
        return Room(low, high, has_ceiling=False)
    position = np.concatenate([hits.position for hits in seen])
    normal = np.concatenate([hits.normal[hits.found] for hits in seen])
    steep = np.concatenate([hits.direction for hits in seen])[:, 2] > 0.7  # within 45 degrees of up
    has_ceiling = bool(steep.any() and found[steep].mean() > OPEN_SHARE)
    room_low, room_high = low.copy(), high.copy()
    for axis in range(3):
        for sign in (1, -1):
            facing = position[sign * normal[:, axis] > FACING, axis]
            side = _side(sign * facing, float(high[axis] - low[axis]))
            if side is None or (sign * position[:, axis] < side).mean() > BEYOND:
                side = float(np.percentile(sign * position[:, axis], 0.5))
            if sign > 0:
                room_low[axis] = side
            elif axis < 2 or has_ceiling:
                room_high[axis] = -side
    if not has_ceiling:
        room_high[2] = max(np.percentile(position[:, 2], 99.5), room_low[2] + 0.3 * (room_high - room_low)[:2].max())
    wrong = room_low >= room_high
    room_low[wrong], room_high[wrong] = low[wrong], high[wrong]
    return Room(room_low, room_high, has_ceiling)


def _side(values: NDArray[np.float64], extent: float) -> float | None:
    """The lowest value at which many hits lie; None if there are next to none."""
    if len(values) < 20:
        return None
    width = max(extent / 400, 1e-9)
    bins = np.floor((values - values.min()) / width).astype(np.int64)
    count = np.bincount(bins)
    near = count + np.pad(count, (0, 1))[1:]
    first = int(np.argmax(near >= SIDE_SHARE * len(values)))
    if near[first] < SIDE_SHARE * len(values):
        return float(np.percentile(values, 2))
    within = values[(bins == first) | (bins == first + 1)]
    return float(np.median(within))
