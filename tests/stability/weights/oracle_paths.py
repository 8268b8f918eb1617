"""Joined paths as the oracle takes them: positions, normals and densities in float64.

Shape letters: N complete paths; k edges.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from photonfarm.renderer.bdpt.guiding.grid import Grid
from photonfarm.renderer.bdpt.lights.emission import Lights
from tests.stability.weights.joined_paths import JoinedPaths, Pinhole, TechniqueCounts, gain, steps
from tests.stability.weights.oracle import F64, OraclePaths


def stored(lights: Lights, joined: JoinedPaths, lens: Pinhole) -> OraclePaths:
    """The complete paths for the oracle: positions, normals and densities of Mitsuba, the rest from first principles.

    The rest: densities of light paths' starts from areas, cones and the scene's radius, the camera's from its field of
    view, the choice of lights from the table and the point's cell.
    """
    st, kept = steps(joined, lens), np.array(joined.complete)
    sis = [bounce.si for bounce in joined.bounces]
    position = _columns(kept, [joined.light.p, *(si.p for si in sis), mi.Point3f(*lens.position.tolist())])
    normal = _columns(kept, [joined.on_light.n, *(si.n for si in sis), mi.Normal3f(0, 0, 1)])
    nothing = mi.Float(0)
    primary = position[:, -2] - position[:, -1]
    cos_lens = primary @ lens.axis / np.linalg.norm(primary, axis=1)
    area, delta = _column(kept, joined.is_area), _column(kept, joined.light.delta)
    infinite = _column(kept, joined.light.at_infinity)
    index = _column(kept, joined.index)
    next_event, emission = _light_densities(lights, joined, kept, index, position, normal)
    return OraclePaths(
        position=position,
        normal=normal,
        to_light=_columns(kept, [*st.to_light, nothing]),
        to_eye=_columns(kept, [*st.to_eye, nothing]),
        delta=_columns(kept, [mi.Bool(False), *(bounce.delta for bounce in joined.bounces), mi.Bool(False)]),
        turn=_columns(kept, [mi.Float(1), *(bounce.turn for bounce in joined.bounces), mi.Float(1)]),
        infinite=infinite,
        distant=_column(kept, joined.light.d),
        hittable=~delta,
        light_has_cosine=area,
        next_event=next_event,
        emission=emission,
        camera=1 / (lens.film_area * cos_lens**3),
    )


def _light_densities(
    lights: Lights, joined: JoinedPaths, kept: Any, index: Any, position: F64, normal: F64
) -> tuple[F64, F64]:
    """(density of v₀ under next event estimation from v₁, of a light path's start per area and direction)."""
    chosen, started = _selection(lights, index, position[:, 1])
    emitter, reference = joined.emitter, dr.zeros(mi.Interaction3f)
    reference.p = joined.bounces[0].si.p
    ds = mi.DirectionSample3f(mi.PositionSample3f(joined.on_light))
    ds.d, ds.dist = joined.light.d, dr.norm(joined.light.p - reference.p)
    per_angle = _column(kept, dr.select(joined.light.delta, 1, emitter.pdf_direction(reference, ds, joined.complete)))
    area, infinite = _column(kept, joined.is_area), _column(kept, joined.light.at_infinity)
    offset = position[:, 1] - position[:, 0]
    r2 = (offset**2).sum(axis=1)
    cosine = np.abs((normal[:, 0] * offset).sum(axis=1)) / np.sqrt(r2)
    next_event = chosen * per_angle * np.where(area, cosine / r2, 1)

    surface = _column(kept, dr.select(joined.is_area, emitter.get_shape().surface_area(), 1))
    cutoff = np.array(lights.cos_cutoff, np.float64)[index % max(len(np.array(lights.cos_cutoff)), 1)]
    disk = np.pi * float(lights.radius[0]) ** 2
    emission = np.where(
        area, 1 / (surface * np.pi), np.where(infinite, per_angle / disk, 1 / (2 * np.pi * (1 - cutoff)))
    )
    return next_event, started * emission * _column(kept, gain(lights, joined))


def _selection(lights: Lights, index: Any, seen_from: F64) -> tuple[F64, F64]:
    """(probability of each light for next event estimation at these points, for light paths)."""
    if lights.selection is None:
        return np.ones(len(index)), np.ones(len(index))
    table = np.array(lights.selection.pmf, np.float64).reshape(-1, lights.count)
    return table[_cell(lights.selection.grid, seen_from), index], table.mean(axis=0)[index]


def _cell(grid: Grid, point: F64) -> Any:
    """The number of the cell that each point [N, 3] lies in."""
    lower, size = (np.array(v, np.float64).ravel() for v in (grid.lower, grid.size))
    x, y, z = np.clip((point - lower) / size, 0, grid.side - 0.5).astype(int).T
    return (z * grid.side + y) * grid.side + x


def usefulness(counts: TechniqueCounts, paths: OraclePaths) -> F64:
    """[N, k + 1]: usefulness of the last light vertex of each technique, by its position and normal; 1 if none is."""
    found = np.ones(paths.to_eye.shape)
    if counts.useful is None:
        return found
    table = np.array(counts.useful.table, np.float64)
    for s in range(2, paths.edges):
        n = paths.normal[:, s - 1]
        axis = np.abs(n).argmax(axis=1)
        kind = 2 * axis + (np.take_along_axis(n, axis[:, None], 1)[:, 0] < 0)
        found[:, s] = table[_cell(counts.useful.grid, paths.position[:, s - 1]) * 6 + kind]
    return found


def _columns(kept: Any, values: list[Any]) -> Any:
    return np.stack([_column(kept, value) for value in values], axis=1)


def _column(kept: Any, value: Any) -> Any:
    """The values of the kept lanes, [N] or [N, 3], float64 unless of another kind."""
    array = np.array(value)
    array = array.T if array.ndim == 2 else array
    array = np.broadcast_to(array, (len(kept), *array.shape[1:])) if len(array) == 1 else array
    return array[kept].astype(np.float64) if array.dtype == np.float32 else array[kept]
