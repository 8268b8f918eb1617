"""Light that arrives straight from lights, at points and at surfaces that reflect it, and the sample points for that.

Shape letters: L lit points, N rays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from photonfarm.core.keys import Key, Stream
from photonfarm.core.records import F32
from photonfarm.renderer.bdpt.lights.emission import Lights, hit_densities, sample_direct
from photonfarm.renderer.bdpt.recording import call_recorded, loop_once
from photonfarm.renderer.scene.arrays import floats, rows
from photonfarm.renderer.scene.gbuffer import diffuse_reflectance, reflects_here
from photonfarm.renderer.scene.materials import has_other_lobes
from photonfarm.scene.spec import RAYS_PER_PIXEL, GuideSpec

if TYPE_CHECKING:
    from photonfarm.renderer.bdpt.recording import Recorders

FOLLOWED = 8
"""The most mirrors and panes of glass that are followed."""

NO_LIMIT = 1 << 20
"""The edges of a path if the spec sets no limit."""


@dataclass(frozen=True, slots=True)
class GuideSettings:
    """The numbers that a kernel is compiled for."""

    light_samples: int  # of each ray
    followed: int  # the most mirrors and panes
    max_depth: int  # the most edges of a path
    glossy: bool  # whether any surface has lobes that are neither diffuse nor followed
    lights_in_glass: bool  # whether lights are seen by the lobe of glass that is not followed


STEPS = (0.8191725133961645, 0.6710436067037893, 0.5497004779019703)
"""The steps of the additive recurrence R₃, n · steps modulo 1.

They are the powers of 1 / 1.2207…, the root of x⁴ = x + 1 [Roberts, The unreasonable effectiveness of quasirandom
sequences, 2018].
"""


def pattern_of(light_samples: int) -> F32:
    """The points of a pixel before the shift, (N, 3): first those of each light sample, then those of the BSDF."""
    number = np.arange((light_samples + 1) * RAYS_PER_PIXEL)[:, None]
    return (number * np.array(STEPS) % 1).astype(np.float32)


def shifts_of(keys: Sequence[Key], purpose: str, count: int) -> Any:
    """A random shift of the pattern for each of `count` pixels or points, view after view, as Float."""
    return floats(np.concatenate([Stream(key, purpose).uniform(count, 3) for key in keys]))


def shift_pattern(pattern: Any, shift: Any, place: Any) -> Any:
    """The three random numbers (Vector3f) at a place (UInt32) of the pattern, for each lane's shift."""
    u = dr.gather(mi.Vector3f, pattern, place) + shift
    return u - dr.floor(u)


class PatternSampler:
    """A sampler that returns three given numbers: one to choose a light, and two to choose a point on it."""

    def __init__(self, u: Any) -> None:
        self._u = u

    def next_1d(self) -> Any:
        """The first number, which chooses a light."""
        return self._u[0]

    def next_2d(self) -> Any:
        """The other two numbers, which choose a point on the light."""
        return mi.Point2f(self._u[1], self._u[2])


# ---------------------------------------------------------------------------------------------------------- at points


def point_light(
    scene: Any,
    lights: Lights | None,
    position: F32,
    normal: F32,
    keys: Sequence[Key],
    wanted: GuideSpec,
    recorders: Recorders | None = None,
) -> F32:
    """Direct irradiance (K, L, 3) of points, on the side of their normals, for the keys of K views.

    It is 0 without `lights` or light samples.
    It takes one shadow ray for each of 16 points of the pattern, shifted by a random vector of each point's own. With
    `recorders` Python runs only once.
    """
    if lights is None or not wanted.light_samples:
        return np.zeros((len(keys), *position.shape), np.float32)
    shifts = shifts_of(keys, "point light", len(position))
    count = dr.opaque(mi.UInt32, len(position))  # as data: `ViewCameras` says why a kernel needs such a number
    arguments = lights, count, floats(position), floats(normal), shifts, floats(pattern_of(0))
    kind = len(keys), len(position), lights.kinds
    return rows(call_recorded(recorders, irradiance, kind, scene, None, *arguments), len(keys), len(position))


def irradiance(
    scene: Any, _: Any, lights: Lights, points: Any, position: Any, normal: Any, shifts: Any, pattern: Any
) -> Any:
    """The irradiance of so many `points` on the side of their normals, once for each shift (Color3f), view after view.

    Positions, normals, shifts and pattern are Float arrays, in which the three numbers of each lie together.
    """
    count = dr.width(shifts) // 3
    lane = dr.arange(mi.UInt32, count)
    place, shift = lane % points, dr.gather(mi.Vector3f, shifts, lane)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.p, si.n = (dr.gather(kind, of, place) for kind, of in ((mi.Point3f, position), (mi.Normal3f, normal)))
    si.t = dr.ones(mi.Float, count)
    si.sh_frame = mi.Frame3f(si.n)

    def add(index: Any, total: Any) -> tuple[Any, Any]:
        light = sample_direct(lights, si, PatternSampler(shift_pattern(pattern, shift, index)), mi.Bool(True))
        cosine = dr.dot(si.n, light.d)
        shadow = dr.select(light.at_infinity, si.spawn_ray(light.d), si.spawn_ray_to(light.p))
        lit = light.valid & (cosine > 0)
        lit &= ~scene.ray_test(shadow, lit)
        return index + 1, total + dr.select(lit, light.radiance_over_density * cosine, 0)

    start = dr.zeros(mi.UInt32, count), dr.zeros(mi.Color3f, count)
    _, total = loop_once(
        state=start, cond=lambda index, _: index < RAYS_PER_PIXEL, body=add, labels=("index", "total"), label="points"
    )
    mean = total / RAYS_PER_PIXEL
    dr.eval(mean)
    return mean


# -------------------------------------------------------------------------------------------------------- on surfaces


@dataclass(slots=True)
class _Sum:
    """Loop variables of the sums over light samples."""

    index: Any  # UInt32
    diffuse: Any  # Color3f: reflected by a white diffuse surface
    whole: Any  # Color3f: reflected by all lobes of a surface that has others


def direct_light(
    scene: Any,
    lights: Lights | None,
    si: Any,
    d: Any,
    reached: Any,
    random: Callable[[Any], Any],
    settings: GuideSettings,
) -> tuple[Any, Any]:
    """Direct light reflected by surfaces that rays along `d` have `reached`: (as if white and diffuse, by all lobes).

    `random` gives three numbers for the light sample of a number (UInt32), and after the last one for the BSDF. The
    results are means over shadow rays to points of lights; lobes that are not diffuse get the share of the balance
    heuristic.
    """
    if lights is None or not settings.light_samples:
        return mi.Color3f(0), mi.Color3f(0)
    count, context, bsdf, normal = settings.light_samples, mi.BSDFContext(), si.bsdf(), turn_towards(si.sh_frame.n, d)
    is_diffuse = reached & reflects_here(si) & mi.has_flag(bsdf.flags(), mi.BSDFFlags.DiffuseReflection)
    other = reached & has_other_lobes(bsdf.flags()) & settings.glossy

    def body(s: _Sum) -> tuple[_Sum]:
        light = sample_direct(lights, si, PatternSampler(random(s.index)), is_diffuse | other)
        shadow = dr.select(light.at_infinity, si.spawn_ray(light.d), si.spawn_ray_to(light.p))
        lit = light.valid & ~scene.ray_test(shadow, light.valid)
        cosine = dr.dot(normal, light.d)
        reflects = is_diffuse & lit & (cosine > 0) & (dr.dot(si.n, light.d) * dr.dot(si.n, d) < 0)
        white = dr.select(reflects, light.radiance_over_density * cosine * dr.inv_pi, 0)
        whole = mi.Color3f(0)
        if settings.glossy:
            value, density = bsdf.eval_pdf(context, si, si.to_local(light.d), other & lit)
            share = dr.select(light.delta, 1, count * light.density / (count * light.density + density))
            whole = dr.select(other & lit, value * light.radiance_over_density * share, 0)
        return (_Sum(s.index + 1, s.diffuse + white, s.whole + whole),)

    width = dr.width(is_diffuse)
    start = _Sum(dr.zeros(mi.UInt32, width), dr.zeros(mi.Color3f, width), dr.zeros(mi.Color3f, width))
    (sums,) = loop_once(state=(start,), cond=lambda s: s.index < count, body=body, labels=("sum",), label="shadow rays")
    diffuse = sums.diffuse / count
    whole = sums.whole / count + dr.select(other, 0, diffuse_reflectance(si, is_diffuse) * diffuse)
    if settings.glossy:
        whole += _sample_bsdf(scene, lights, si, other, random(mi.UInt32(count)), count)
    return diffuse, whole


def _sample_bsdf(scene: Any, lights: Lights, si: Any, active: Any, u: Any, count: int) -> Any:
    """The light of one ray along a sample of the BSDF, with the share that `count` shadow rays leave."""
    bs, weight = si.bsdf().sample(mi.BSDFContext(), si, u[0], mi.Point2f(u[1], u[2]), active)
    ray = si.spawn_ray(si.to_world(bs.wo))
    hit = scene.ray_intersect(ray, active=active)
    emitter = hit.emitter(scene, active)
    by_light, _ = hit_densities(scene, lights, emitter, hit, ray.o, si.p, active)
    is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    share = dr.select(is_delta, 1, bs.pdf / (bs.pdf + count * by_light))
    emitted = emitter.eval(hit, active)
    return dr.select(active & (dr.max(emitted) > 0), weight * emitted * share, 0)


def turn_towards(normal: Any, direction: Any) -> Any:
    """The normal on the side that a ray along `direction` comes from."""
    return dr.select(dr.dot(normal, direction) > 0, -normal, normal)
