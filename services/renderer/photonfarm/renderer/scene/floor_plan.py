"""The room from above: what rays meet that go straight down from where the highest cameras stand.

Every group is seen alone, too, so that a page can show it wherever it is dragged.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from photonfarm.core import pictures
from photonfarm.core.records import F32
from photonfarm.renderer.scene.arrays import points as mi_points
from photonfarm.renderer.scene.gbuffer import seen_reflectance
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.scene.modification import rest

PIXELS = 400
"""The pixels of a plan's longer side."""

GREY = 0.35
"""What surfaces without diffuse reflectance are drawn as."""


@dataclass(frozen=True, slots=True, eq=False)
class FloorPlan:
    """Pictures from above with opacity, (H, W, 4): of all that never moves, and of each group at rest."""

    low: F32  # (3,) the corner of the first pixel, scene units
    high: F32  # (3,) that of the last; heights are those of the floor and of the cut
    across: int  # the axis along the pictures' columns
    down: int  # the axis along their rows, from `low` on
    still: NDArray[np.uint8]
    groups: tuple[NDArray[np.uint8], ...]


def draw_floor_plan(loaded: LoadedScene) -> FloorPlan:
    """The plan of a scene, which is left at rest."""
    spec, at_rest = loaded.spec, rest(loaded.spec)
    height = int(np.argmax(np.abs(spec.view.up)))
    low, high = _extent(loaded)
    across, down = (axis for axis in (0, 1, 2) if axis != height)
    step = max(high[across] - low[across], high[down] - low[down]) / PIXELS
    columns, rows = (max(1, int((high[axis] - low[axis]) / step)) for axis in (across, down))
    origin = np.empty((rows, columns, 3), np.float32)
    origin[..., across] = low[across] + step * (np.arange(columns) + 0.5)
    origin[..., down] = low[down] + step * (np.arange(rows) + 0.5)[:, None]
    up = np.array(spec.view.up)
    origin[..., height] = high[height] if up[height] > 0 else low[height]
    loaded.apply(at_rest.without_groups())
    still = _look_down(loaded.scene, origin, -up)
    groups = []
    for g in range(len(spec.groups)):
        alone = np.arange(len(spec.groups)) == g
        loaded.apply(replace(at_rest, present=alone))
        seen = _look_down(loaded.scene, origin, -up)
        seen[(seen == still).all(axis=-1)] = 0
        groups.append(seen)
    loaded.apply(at_rest)
    return FloorPlan(low, high, across, down, still, tuple(groups))


def _extent(loaded: LoadedScene) -> tuple[F32, F32]:
    """The box around all that does not move and where cameras and groups may stand; up to the highest camera."""
    view, room = loaded.spec.view, loaded.boxes[loaded.still]
    corners = [view.origin.low, view.origin.high, view.look_at.low, view.look_at.high]
    corners += [corner for group in loaded.spec.groups for corner in (group.box.low, group.box.high)]
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    margin = 0.5 * np.max(high - low)  # a ground plane may be far larger than the room
    if len(room):
        low = np.minimum(low, np.maximum(room[:, 0].min(axis=0), low - margin))
        high = np.maximum(high, np.minimum(room[:, 1].max(axis=0), high + margin))
    height = int(np.argmax(np.abs(view.up)))
    if view.up[height] > 0:
        high[height] = view.origin.high[height]
    else:
        low[height] = view.origin.low[height]
    return low.astype(np.float32), high.astype(np.float32)


def _look_down(scene: Any, origin: F32, down: NDArray[np.float64]) -> NDArray[np.uint8]:
    """What rays meet that go down from points (H, W, 3), as a display shows it, (H, W, 4); 0 where nothing is."""
    rays = mi.Ray3f(mi_points(origin.reshape(-1, 3)), mi.Vector3f(down.tolist()))
    si = scene.ray_intersect(rays)
    hit = si.is_valid()
    colour = seen_reflectance(si, hit)
    emits = hit & (si.emitter(scene) != None)  # noqa: E711 - an array of pointers
    colour = dr.select(dr.max(colour) > 0, colour, GREY)
    shade = 0.55 + 0.45 * dr.abs(dr.dot(si.sh_frame.n, mi.Vector3f(down.tolist())))
    colour = dr.select(emits, mi.Color3f(1), colour * shade)
    shown = np.empty((*origin.shape[:2], 4), np.uint8)
    shown[..., :3] = pictures.draw_albedo(np.array(colour).T.reshape(origin.shape).astype(np.float32))
    shown[..., 3] = 255 * np.array(hit).reshape(origin.shape[:2])
    return shown
