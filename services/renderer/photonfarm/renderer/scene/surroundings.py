"""Where points stand in a scene: in the open, inside a solid, or outside, told by rays in 64 directions.

**Inside a solid.** A ray that starts inside a closed surface crosses it an odd number of times, whichever way its
normals point and whether it is two-sided. A point is inside a shape if at least `INSIDE` of its directions cross that
shape an odd number of times. That allows for a missing bottom, and leaves out single sheets such as curtains, floors
and leaves, which at most half of all directions cross. Rays are followed through each shape alone: of two surfaces in
one place, such as a floor and the bottom of what stands on it, a ray in the whole scene meets only one.

A room can be one closed mesh, too. So a shape whose box contains, at rest, the boxes of more than half of all other
shapes is *hollow*: to be inside it is to be in the room. One mesh that holds most of a scene's furniture is taken for a
room.

**Outside.** Outside a room about half of all directions, or more, meet no surface: just outside a wall it is half of
them. The same holds under an open sky, where nothing is wrong with it.

In six furnished rooms of 22 to 856 shapes, a thousand points take 0.1 to 0.9 s of one core: about 2 µs for each
triangle of the shapes that are followed, whose scenes are built at each call. What is missed are cupboards made of
several single sheets, in which a point's `reach` is short.

Shape letters: N points, R rays, S shapes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from photonfarm.core.records import F32
from photonfarm.renderer.scene.arrays import points as mi_points
from photonfarm.scene.groups import Box, shape_ids
from photonfarm.scene.modification import Modification, rest
from photonfarm.scene.view import View

if TYPE_CHECKING:
    from photonfarm.renderer.scene.loaded_scene import LoadedScene

DIRECTIONS = 64

INSIDE = 0.75
"""The share of directions that must cross a shape an odd number of times: from the middle of a cube without a bottom it
is 5/6, beside a sheet 1/2."""

LEAVING = 0.45
"""The share of directions that may meet no surface, of a point in the open."""

NONE = -1

_POINTS = 4096  # at a time, which bounds memory
_CROSSINGS = 256  # followed of a ray, which ends every ray that rounding would let hang on a surface
_STEP = 1e-5  # beyond a crossing, as a share of the scene's diagonal


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """What surrounds points, by 64 rays from each."""

    solid: NDArray[np.int32]  # (N,) the number of the shape that a point is inside of, by the scene's order, or NONE
    leaving: F32  # (N,) the share of directions that meet no surface
    clearance: F32  # (N,) the distance to the nearest surface that a ray meets; inf without one
    reach: F32  # (N,) the median distance to the first surface; inf if half the rays meet none

    @property
    def open(self) -> NDArray[np.bool_]:
        """Whether points are inside no solid, and not outside, (N,)."""
        return (self.solid == NONE) & (self.leaving <= LEAVING)


def surroundings(scene: Any, points: F32, hollow: NDArray[np.bool_] | None = None) -> Surroundings:
    """What surrounds points (N, 3) of a Mitsuba scene in its present state.

    `hollow` (S,) says which shapes are rooms; without it the present boxes tell them, as they do in a scene at rest.
    Edited shapes must have reached the scene (`parameters_changed`).
    """
    boxes = boxes_of(scene.shapes())
    hollow = hollow_boxes(boxes) if hollow is None else hollow
    found = [_next_crossing(scene, *_rays(part)) for part in _parts(points)]
    first = np.concatenate(found).reshape(len(points), DIRECTIONS)
    return Surroundings(
        solid=_solids(scene, boxes, hollow, points),
        leaving=np.isinf(first).mean(axis=1, dtype=np.float32),
        clearance=first.min(axis=1),
        reach=np.sort(first, axis=1)[:, DIRECTIONS // 2],
    )


def boxes_of(shapes: list[Any]) -> F32:
    """The bounding boxes of shapes, (S, 2, 3): their lower and upper corners."""
    corners = [[list(shape.bbox().min), list(shape.bbox().max)] for shape in shapes]
    return np.array(corners, np.float32).reshape(-1, 2, 3)


def hollow_boxes(boxes: F32) -> NDArray[np.bool_]:
    """Which boxes (S, 2, 3) contain more than half of the others, within 1 % of their size, (S,); a single one does."""
    slack = 0.01 * (boxes[:, 1] - boxes[:, 0]).max(axis=1, keepdims=True)
    above = boxes[None, :, 0] >= (boxes[:, 0] - slack)[:, None]
    below = boxes[None, :, 1] <= (boxes[:, 1] + slack)[:, None]
    others = (above & below).all(axis=2).sum(axis=1) - 1
    hollow: NDArray[np.bool_] = (2 * others > len(boxes) - 1) | (len(boxes) == 1)
    return hollow


PARTLY = 0.2
"""The share of a group's box from which on it stands in something."""


def look_closer(loaded: LoadedScene, modification: Modification, view: View) -> list[str]:
    """What the present configuration puts into walls, or outside, each as a sentence: groups not at rest, the camera.

    A group's points are 27 in the box around it. Groups that meet are nothing special: placements are drawn so.
    """
    shapes, spec = loaded.scene.shapes(), loaded.spec
    boxes, at_rest = boxes_of(shapes), rest(spec).vector
    found: list[str] = []
    room = boxes[loaded.still]
    low, high = (room[:, 0].min(axis=0), room[:, 1].max(axis=0)) if len(room) else (-np.inf, np.inf)
    slack = 0.01 * np.max(high - low)
    for group, now, before in zip(spec.groups, modification.vector[:, :5], at_rest[:, :5], strict=True):
        own = boxes[[shape.id() in shape_ids(group) for shape in shapes]]
        if np.array_equal(now, before) or not now[3] or not len(own):  # light is in nothing's way
            continue
        corners = own[:, 0].min(axis=0), own[:, 1].max(axis=0)
        if (corners[0] < low - slack).any() or (corners[1] > high + slack).any():
            found.append(f"{group.name} reaches outside the room (all that never moves)")
            continue
        grid = np.stack(np.meshgrid(*[[1 / 6, 1 / 2, 5 / 6]] * 3), axis=-1).reshape(-1, 3)
        solid = loaded.surroundings((corners[0] + grid * (corners[1] - corners[0])).astype(np.float32)).solid
        within = [number for number in solid.tolist() if number != NONE and loaded.still[number]]
        if len(within) > PARTLY * len(solid):
            found.append(f"{group.name} stands in {shapes[max(within, key=within.count)].id()!r}")
    number = int(loaded.surroundings(view.origin[None]).solid[0])
    if number != NONE:
        shape = shapes[number].id()
        owner = next((group.name for group in spec.groups if shape in shape_ids(group)), shape)
        found.append(f"the camera is inside {owner!r}")
    elif (view.origin < low - slack).any() or (view.origin > high + slack).any():
        found.append("the camera is outside the room (all that never moves)")
    elif not have_sight(loaded, view.origin[None])[0]:
        found.append("the camera sees hardly anything of what cameras look at: it is inside of something, or behind it")
    return found


LOOK_AT, SEEN = 64, 0.1
"""The random look-at points, and the share of them that a camera in the open sees."""


def have_sight(loaded: LoadedScene, points: F32) -> NDArray[np.bool_]:
    """Whether points (N, 3) see enough of where cameras look, in the present configuration, (N,)."""
    from photonfarm.renderer.scene.gbuffer import sight_shares

    sees: NDArray[np.bool_] = sight_shares(loaded.scene, points, uniform_in(loaded.spec.view.look_at, LOOK_AT)) >= SEEN
    return sees


def uniform_in(box: Box, count: int) -> F32:
    """Points uniform in a box, always the same, (count, 3)."""
    return (box.low + np.random.default_rng(0).random((count, 3)) * (box.high - box.low)).astype(np.float32)


def directions() -> F32:
    """`DIRECTIONS` unit vectors, spread evenly over the sphere by a Fibonacci lattice."""
    place = np.arange(DIRECTIONS) + 0.5
    height = 1 - 2 * place / DIRECTIONS
    angle = np.pi * (1 + 5**0.5) * place
    across = np.sqrt(1 - height**2)
    return np.stack([across * np.cos(angle), across * np.sin(angle), height], axis=1).astype(np.float32)


def _solids(scene: Any, boxes: F32, hollow: NDArray[np.bool_], points: F32) -> NDArray[np.int32]:
    """The number of the shape that each of points (N, 3) is inside of, or NONE, (N,).

    Of several shapes it is the one that most directions cross an odd number of times. Shapes whose box does not contain
    a point are not tried.
    """
    from photonfarm.renderer.scene.loading import scene_of

    step = np.float32(_STEP * np.linalg.norm(boxes[:, 1].max(axis=0) - boxes[:, 0].min(axis=0)))
    solid, most = np.full(len(points), NONE, np.int32), np.zeros(len(points))
    for number, (shape, (low, high)) in enumerate(zip(scene.shapes(), boxes, strict=True)):
        within = np.flatnonzero(((points > low) & (points < high)).all(axis=1))
        if hollow[number] or not len(within):
            continue
        alone = scene_of([shape])
        share = np.concatenate([_odd(alone, part, step) for part in _parts(points[within])])
        inside = within[(share >= INSIDE) & (share > most[within])]
        solid[inside] = number
        most[within] = np.maximum(most[within], share)
    return solid


def _odd(alone: Any, points: F32, step: np.float32) -> NDArray[np.float64]:
    """The share of directions from points (N, 3) that cross the shape of a scene an odd number of times, (N,)."""
    origin, direction = _rays(points)
    odd = np.zeros(len(origin), np.bool_)
    alive = np.arange(len(origin))
    for _ in range(_CROSSINGS):
        distance = _next_crossing(alone, origin[alive], direction[alive])
        met = np.isfinite(distance)
        alive, distance = alive[met], distance[met]
        if not len(alive):
            break
        odd[alive] ^= True
        origin[alive] += (distance + step)[:, None] * direction[alive]
    share: NDArray[np.float64] = odd.reshape(len(points), DIRECTIONS).mean(axis=1)
    return share


def _parts(points: F32) -> list[F32]:
    """Points (N, 3) in parts of `_POINTS`; one part of none if there is none."""
    return [points[start : start + _POINTS] for start in range(0, max(len(points), 1), _POINTS)]


def _rays(points: F32) -> tuple[F32, F32]:
    """The origins and directions of the rays from points (N, 3), those of a point beside each other, (R, 3) each."""
    return np.repeat(points.astype(np.float32), DIRECTIONS, axis=0), np.tile(directions(), (len(points), 1))


def _next_crossing(scene: Any, origin: F32, direction: F32) -> F32:
    """The distances to the next surfaces, inf without one, (R,)."""
    if not len(origin):
        return np.zeros(0, np.float32)
    hit = scene.ray_intersect_preliminary(mi.Ray3f(o=mi_points(origin), d=mi.Vector3f(mi_points(direction))))
    return np.array(hit.t)
