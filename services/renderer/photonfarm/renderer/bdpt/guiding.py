"""Guided starts of light paths: a table of where and in which direction light leaves for what the camera sees."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

TILES = 8
_AXIS = (0.2672612419, 0.5345224838, 0.8017837257)


def frame(n: mi.Vector3f) -> mi.Frame3f:
    """A frame about n that depends on it continuously, except at two directions that no scene has by chance."""
    s = dr.normalize(dr.cross(mi.Vector3f(*_AXIS), n))
    return mi.Frame3f(s, dr.cross(n, s), n)


@dataclass(slots=True)
class Guide:
    """Probabilities of the cells of the N lights' start squares."""

    side: int  # K: cells along each axis of a light's square of directions
    split: int  # P: cells along each axis of its square of positions
    cdf: mi.Float64  # [T]: running sums, light after light, cells in Morton's order
    gain: mi.Float  # [T]: probability over that of the default sampling
    slot: mi.UInt32  # by registry id: number of the light
    splits: mi.UInt32  # [N]: 1 where positions are split

    @property
    def per_light(self) -> int:
        return (self.side * self.split) ** 2


@dataclass(slots=True)
class Tally:
    """Squares of what light paths add to pixels, by start cell and image tile."""

    sums: mi.Float  # [T · TILES²]
    starts: mi.Float  # [T]

    def add(self, cell: mi.UInt32, tile: mi.UInt32, value: mi.Spectrum, active: mi.Bool) -> None:
        grey = (value[0] + value[1] + value[2]) / 3
        dr.scatter_add(self.sums, dr.square(grey), cell * (TILES * TILES) + tile, active)


@dataclass(slots=True)
class TallySplat:
    splat: Any
    tally: Tally
    cell: Any = None

    def add(self, position: mi.Point2f, value: mi.Spectrum, active: mi.Bool) -> None:
        self.splat.add(position, value, active)
        inside = active & dr.all((position >= 0) & (position < mi.ScalarVector2f(self.splat.width, self.splat.height)))
        x, y = mi.UInt32(position.x * (TILES / self.splat.width)), mi.UInt32(position.y * (TILES / self.splat.height))
        self.tally.add(self.cell, y * TILES + x, value * self.splat.scale, inside)


def spread_bits(x: mi.UInt32) -> mi.UInt32:
    for shift, bits in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        x = (x | (x << shift)) & bits
    return x


def gather_bits(x: mi.UInt32) -> mi.UInt32:
    for shift, bits in ((0, 0x55555555), (1, 0x33333333), (2, 0x0F0F0F0F), (4, 0x00FF00FF), (8, 0x0000FFFF)):
        x = (x | (x >> shift)) & bits
    return x


def morton(u: mi.Point2f, side: int) -> mi.UInt32:
    x = mi.UInt32(dr.clip(u.x * side, 0, side - 0.5))
    y = mi.UInt32(dr.clip(u.y * side, 0, side - 0.5))
    return dr.minimum(spread_bits(x) | (spread_bits(y) << 1), side * side - 1)


def square_of(guide: Guide, lights: Any, slot: mi.UInt32, n: mi.Vector3f, d: mi.Vector3f, x: mi.Point3f) -> mi.Point2f:
    """The point of the guided square from which a light sends light along ``d`` to ``x``."""
    from photonfarm.renderer.bdpt.emission import AREA, DIRECTION, INFINITE, POSITION

    u = mi.Point2f(0)
    if lights.has(AREA):
        local = frame(n).to_local(d)
        u = mi.warp.uniform_disk_to_square_concentric(mi.Point2f(local.x, local.y))
    if lights.has(INFINITE) or lights.has(DIRECTION):
        local = frame(-d).to_local(x - lights.centre) / lights.radius
        far = mi.warp.uniform_disk_to_square_concentric(mi.Point2f(local.x, local.y))
        u = dr.select(lights.is_kind(slot, INFINITE) | lights.is_kind(slot, DIRECTION), far, u)
    if lights.has(POSITION):
        axis = dr.gather(mi.Vector3f, lights.axis, slot)
        cos_cutoff = dr.gather(mi.Float, lights.cos_cutoff, slot)
        local = mi.Frame3f(axis).to_local(d)
        phi = dr.atan2(local.y, local.x) / dr.two_pi
        near = mi.Point2f((1 - local.z) / (1 - cos_cutoff), phi - dr.floor(phi))
        u = dr.select(lights.is_kind(slot, POSITION), near, u)
    return u


def gain_of(
    guide: Guide, lights: Any, emitter: mi.EmitterPtr, n: mi.Vector3f, d: mi.Vector3f, x: mi.Point3f,
    uv: mi.Point2f, active: mi.Bool = True
) -> mi.Float:
    """Density of light paths that leave an emitter along ``d`` to ``x``, over that of the default sampling."""
    slot = dr.gather(mi.UInt32, guide.slot, dr.reinterpret_array(mi.UInt32, emitter))
    u = square_of(guide, lights, slot, n, d, x)
    cell = morton(u, guide.side)
    if guide.split > 1:
        cell += dr.select(dr.gather(mi.UInt32, guide.splits, slot) > 0, morton(uv, guide.split), 0) * guide.side**2
    return dr.gather(mi.Float, guide.gain, slot * guide.per_light + cell, active)


def choose(guide: Guide, u: mi.Float64) -> tuple[Any, Any, mi.Point2f, mi.Point2f, mi.Float]:
    """(light, cell [T], corner of position cell, point in direction square, gain) at places u in [0, 1)."""
    total = guide.per_light * dr.width(guide.splits)
    last = total - 1
    target = u * dr.gather(mi.Float64, guide.cdf, mi.UInt32(last))
    cell = mi.UInt32(dr.binary_search(0, last, lambda i: dr.gather(mi.Float64, guide.cdf, i) <= target))
    below = dr.gather(mi.Float64, guide.cdf, dr.maximum(mi.Int32(cell) - 1, 0), cell > 0)
    above = dr.gather(mi.Float64, guide.cdf, cell)
    rest = dr.clip((target - below) / (above - below), 0, 1 - 2.0**-40) * 65536.0
    high = mi.UInt32(rest)  # 16 bits along the curve
    rest = (rest - mi.Float64(high)) * 65536.0
    low = mi.UInt32(rest)
    inner = mi.Point2f(
        mi.Float(gather_bits(high)) * 256 + mi.Float(gather_bits(low)),
        mi.Float(gather_bits(high >> 1)) * 256 + mi.Float(gather_bits(low >> 1)),
    ) / 65536
    light = cell // guide.per_light
    within = cell - light * guide.per_light
    position = within // guide.side**2
    direction = within - position * guide.side**2
    corner = mi.Point2f(mi.Float(gather_bits(direction)), mi.Float(gather_bits(direction >> 1)))
    where = mi.Point2f(mi.Float(gather_bits(position)), mi.Float(gather_bits(position >> 1)))
    return light, cell, where, (corner + inner) / guide.side, dr.gather(mi.Float, guide.gain, cell)


def uniform(lights: Any, side: int, split: int) -> Guide:
    """The guide that changes nothing."""
    return of_table(lights, side, split, np.ones((lights.count, split * split * side * side)))


def of_table(lights: Any, side: int, split: int, gain: Any) -> Guide:
    """From gains relative to the default probabilities (normalised here)."""
    p = np.diff(np.concatenate([[0.0], np.array(lights.emit_cdf, np.float64)]))
    p = p / p.sum()
    table = gain * p[:, None] / gain.shape[1]
    total = table.sum()
    gain = gain / total
    cdf = np.cumsum(table.ravel() / total)
    ids = [int(dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(e))[0]) for e in lights.emitters]
    slot = np.zeros(max(ids) + 1, np.uint32)
    slot[ids] = np.arange(len(ids))
    guide = Guide(
        side, split, mi.Float64(cdf.tolist()), mi.Float(gain.ravel().tolist()), mi.UInt32(slot.tolist()),
        mi.UInt32([int(s) for s in lights.split]),
    )
    dr.eval(guide.cdf, guide.gain, guide.slot, guide.splits)
    return guide


def order(side: int) -> Any:
    """[side, side] (y, x) → Morton index."""
    def spread(v: int) -> int:
        return sum(((v >> b) & 1) << (2 * b) for b in range(8))
    return np.array([[spread(x) | spread(y) << 1 for x in range(side)] for y in range(side)])


def learned(lights: Any, side: int, split: int, tally: Tally, image: Any, *, alpha: float, prior: float,
            relative: bool = True, power: float = 0.5) -> Guide:
    """The guide that a tally suggests; ``image`` [H, W, 3]."""
    n = lights.count
    h, w, _ = image.shape
    tiles = image.mean(-1).reshape(TILES, h // TILES, TILES, w // TILES).mean((1, 3)).ravel()
    tiles = tiles
    weight = 1 / (tiles**2 + 0.01 * tiles.mean() ** 2) if relative else np.ones(TILES * TILES) / tiles.mean() ** 2
    sums = np.array(tally.sums, np.float64).reshape(-1, TILES * TILES) @ weight
    starts = np.array(tally.starts, np.float64)
    sums, starts = (v.reshape(n, split**2, side * side) for v in (sums, starts))
    merge = ~np.array(lights.split, bool)
    for v in (sums, starts):
        v[merge] = v[merge].mean(1, keepdims=True)
    o = order(side)
    grid_s, grid_n = sums[..., o], starts[..., o]
    grid_s, grid_n = _blur(grid_s), _blur(grid_n)
    whole = sums.sum((1, 2)) / np.maximum(starts.sum((1, 2)), 1)
    every = sums.sum() / starts.sum()
    whole = (sums.sum((1, 2)) + 8 * every) / (starts.sum((1, 2)) + 8)
    mean = (grid_s + prior * whole[:, None, None, None]) / (grid_n + prior)
    gain = np.empty_like(sums)
    gain[..., o] = mean**power
    p = np.diff(np.concatenate([[0.0], np.array(lights.emit_cdf, np.float64)]))
    p /= p.sum()
    gain /= (gain * p[:, None, None]).sum() / (split**2 * side**2)
    return of_table(lights, side, split, ((1 - alpha) * gain + alpha).reshape(n, -1))


def _blur(v: Any) -> Any:
    for axis in (-1, -2):
        padded = np.concatenate([v.take([0], axis), v, v.take([-1], axis)], axis)
        k = v.shape[axis]
        v = sum(c * padded.take(np.arange(i, i + k), axis) for i, c in enumerate((0.25, 0.5, 0.25)))
    return v
