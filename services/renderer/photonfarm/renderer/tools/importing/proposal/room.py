"""The room that a scene shows from within: its floor, its ceiling and its sides, found by rays; or what is outdoors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.scene.surroundings import NONE, surroundings
from photonfarm.renderer.tools.importing.proposal.surfaces import Box, Frame, Points, Surfaces

RAYS = 512  # from each point of view
ROUNDS, VIEWPOINTS = 3, 48  # how often points of view are chosen anew, and how many: so that niches are seen too
FACING = 0.9  # up to this cosine between normal and axis, surfaces count as floor, ceiling or wall
SIDE_SHARE = 0.08  # of hits on surfaces that face inwards: the outermost place that has as many is a side of the room
BEYOND = 0.15  # of all hits: where more lie beyond a place, that is no side, and the room is open there
OPEN_SHARE = 0.5  # of steep rays: there is a ceiling if more hit something
LEVEL = 0.5  # rays up to 30 degrees above the horizon count as level
BACKS = 0.95  # of hits: where more are backs of surfaces, the point of view is inside of a thing, and not of a room
PART = 0.6  # of the scene: what is smaller, or shows more backs of surfaces, is a room only if something is in it
GROUND = 0.25  # of rays from above: there is ground where as many meet one level
THICK = 0.25  # of the height of all that is there: the ground, which may be a slab, is not higher
AROUND = 1.5  # of the size of what stands outdoors: how far the surroundings reach beyond it
RISES = 0.75  # of its lengths: the least height of what is outdoors, so that cameras look down on it
NEAR_FLOOR = 0.03  # of the room's height: flat surfaces as near to the floor are the floor, or lie on it


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """A box that the room's inner surfaces lie on."""

    low: Points  # (3,)
    high: Points  # (3,); its height is that of what stands there, in a scene without a ceiling
    has_ceiling: bool
    is_stage: bool = False  # nothing encloses it, and it has no ground: what is there is seen from outside
    is_doubtful: bool = False  # it may be the inside of something that is to be seen from outside
    subject: Box | None = None  # outdoors, the box around all that stands on the ground

    @property
    def size(self) -> Points:
        """Its two lengths and its height, (3,)."""
        return self.high - self.low

    @property
    def height(self) -> float:
        """The distance from the floor to the ceiling; of what lies flat, a share of its length."""
        return float(max(self.size[2], 0.01 * self.size.max()))

    @property
    def floor(self) -> float:
        """The height of the floor."""
        return float(self.low[2])


class _Hits(NamedTuple):
    origin: Points  # (N, 3)
    direction: Points  # (N, 3)
    distance: NDArray[np.float64]  # (N,); infinite without a hit
    normal: Points  # (N, 3), towards the ray's origin
    is_back: NDArray[np.bool_]  # (N,): whether it is a surface's back that was hit


def find_room(scene: Any, surfaces: Surfaces, frame: Frame, camera: Points | None, others: Sequence[Room] = ()) -> Room:
    """The room around the camera, or around a point that is chosen; what is outdoors where nothing encloses that.

    `others` are rooms that the point must not be in.
    """
    rng, main, around = np.random.default_rng(0), surfaces.main(), outdoors(scene, surfaces, frame)
    if camera is not None:
        outside = ((camera < main.low) | (camera > main.high)).any()
        camera = None if outside or _find_in_solid(scene, frame, camera[None])[0] else camera
    within = around.subject or main
    viewpoints = _best_viewpoint(scene, frame, within, rng, others) if camera is None else camera[None]
    if not len(viewpoints):
        return around
    seen = []
    for _ in range(ROUNDS):
        seen.append(_cast(scene, frame, viewpoints, rng))
        if not np.isfinite(seen[-1].distance).any():
            break
        viewpoints = _along(seen[-1], rng)
    hit, height = np.isfinite(seen[0].distance), seen[0].direction[:, 2]
    level = (height > 0) & (height < LEVEL)
    backs = seen[0].is_back[hit].mean() if hit.any() else 1.0
    if camera is None and (hit[level].mean() < OPEN_SHARE or backs > BACKS):
        return around
    low, high, has_ceiling = _sides(_Hits(*map(np.concatenate, zip(*seen, strict=True))), main)
    doubtful = camera is None and bool((high - low).prod() < PART * (main.high - main.low).prod() or backs > PART)
    return Room(low, high, has_ceiling, is_doubtful=doubtful)


def outdoors(scene: Any, surfaces: Surfaces, frame: Frame) -> Room:
    """The ground with what stands on it, and some room around that; a stage where there is no ground."""
    low, high = surfaces.main()
    level = NEAR_FLOOR * (high[2] - low[2]) + 1e-6 * float((high - low).max())
    steps = np.stack(np.meshgrid(*(np.arange(32) + 0.5,) * 2, indexing="ij"), axis=-1).reshape(-1, 2) / 32
    above = np.column_stack([low[:2] + steps * (high - low)[:2], np.full(len(steps), high[2] + 10 * level)])
    met = above[:, 2] - trace(scene, frame, above, np.tile([0.0, 0.0, -1.0], (len(above), 1)))[0]
    levels = np.sort(met[met < low[2] + THICK * (high[2] - low[2]) + level])
    share = (np.searchsorted(levels, levels + 2 * level) - np.arange(len(levels))) / len(met)
    if share.max(initial=0) < GROUND:
        return Room(low, high, has_ceiling=False, is_stage=True)
    lowest = levels[np.argmax(share >= GROUND)]
    floor = float(np.median(met[(met >= lowest) & (met < lowest + 2 * level)]))
    tops = surfaces.corners[:, :, 2].max(axis=1)
    rising = surfaces.corners[(tops > floor + level) & (tops <= high[2])].reshape(-1, 3)
    first, last = (rising.min(axis=0), rising.max(axis=0)) if len(rising) else (low, high)
    reach = AROUND * float((last - first).max())
    low, high = np.maximum(low, first - reach), np.minimum(high, last + reach)
    low[2], high[2] = floor, max(last[2], floor + RISES * float(np.sqrt((high - low)[:2].prod())))
    return Room(low, high, has_ceiling=False, subject=Box(np.array([*first[:2], floor]), last))


def _find_in_solid(scene: Any, frame: Frame, points: Points) -> NDArray[np.bool_]:
    """Which points (N, 3) are in a solid, (N,)."""
    return np.asarray(surroundings(scene, frame.world(points).astype(np.float32)).solid != NONE)


def _best_viewpoint(scene: Any, frame: Frame, within: Box, rng: np.random.Generator, others: Sequence[Room]) -> Points:
    """The point from which most rays hit something far away, in no solid and no other room: (1, 3), or (0, 3)."""
    steps = [(np.arange(n) + 0.5) / n for n in (8, 8, 4)]
    shares = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = within.low + (within.high - within.low) * shares
    hits = _cast(scene, frame, grid, rng, rays=64)
    distance, back = (values.reshape(len(grid), -1) for values in (hits.distance, hits.is_back))
    met = np.isfinite(distance)
    enclosed = met.mean(axis=1)
    solid = _find_in_solid(scene, frame, grid)
    enclosed[solid & ((back & met).sum(axis=1) > PART * met.sum(axis=1))] = -1
    for room in others:
        enclosed[((grid > room.low) & (grid < room.high)).all(axis=1)] = -1
    reach = np.median(np.where(met, distance, 0), axis=1)
    reach[enclosed < 0.9 * enclosed.max()] = -1
    return grid[[int(np.argmax(reach))] if (enclosed >= 0).any() else []]


def _along(hits: _Hits, rng: np.random.Generator) -> Points:
    """Points on the way to what was hit."""
    hit = np.flatnonzero(np.isfinite(hits.distance))
    chosen = rng.choice(hit, min(VIEWPOINTS, len(hit)), replace=False)
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
    """Distances (N,) to the first surfaces, infinite without one, and their normals (N, 3), which point to the front.

    That is where shading normals point: of a mirrored rectangle the corners turn round, and its front does not.
    """
    import drjit as dr
    import mitsuba as mi

    from photonfarm.renderer.scene.arrays import points

    o, d = (points(frame.world(x).astype(np.float32)) for x in (origin, direction))
    si = scene.ray_intersect(mi.Ray3f(o=o, d=mi.Vector3f(d), time=0, wavelengths=[]))
    normal = dr.select(si.is_valid(), si.n * dr.sign(dr.dot(si.n, si.sh_frame.n)), 0)
    distance = np.array(dr.select(si.is_valid(), si.t, dr.inf), np.float64)
    return distance, frame.inward(np.array(normal, np.float64).T)


def _sides(hits: _Hits, within: Box) -> tuple[Points, Points, bool]:
    """The corners (3,) of the room that was seen, and whether it has a ceiling."""
    (low, high), hit = within, np.isfinite(hits.distance)
    if not hit.any():
        return low, high, False
    position, normal = (hits.origin + hits.distance[:, None] * hits.direction)[hit], hits.normal[hit]
    steep = hits.direction[:, 2] > 0.7  # within 45 degrees of up
    has_ceiling = bool(steep.any() and hit[steep].mean() > OPEN_SHARE)
    room_low, room_high = low.copy(), high.copy()
    for axis in range(3):
        for sign, bound in ((1, room_low), (-1, room_high)):
            facing = position[sign * normal[:, axis] > FACING, axis]
            side = _side(sign * facing, float(high[axis] - low[axis]))
            if side is None or (sign * position[:, axis] < side).mean() > BEYOND:
                side = float(np.percentile(sign * position[:, axis], 0.5))
            bound[axis] = sign * side
    if not has_ceiling:
        top = min(np.percentile(position[:, 2], 99.5), high[2])
        room_high[2] = max(top, room_low[2] + 0.3 * (room_high - room_low)[:2].max())
    wrong = room_low >= room_high
    room_low[wrong], room_high[wrong] = low[wrong], high[wrong]
    return room_low, room_high, has_ceiling


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
    return float(np.median(values[(bins == first) | (bins == first + 1)]))
