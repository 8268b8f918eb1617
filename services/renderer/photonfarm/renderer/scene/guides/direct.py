"""Light that arrives straight from lights, at points and at surfaces that reflect it.

Shape letters: L lit points, N rays.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from photonfarm.core.keys import Key, Stream
from photonfarm.core.records import F32
from photonfarm.renderer.bdpt.lights.emission import Lights, hit_densities, read_lights, sample_direct
from photonfarm.renderer.bdpt.recording import loop_once
from photonfarm.renderer.scene.arrays import floats, points, rows
from photonfarm.renderer.scene.gbuffer import diffuse_reflectance, reflects_here
from photonfarm.renderer.scene.guides.pattern import (
    SUB_PIXELS,
    GuideSettings,
    PatternSampler,
    pattern_of,
    shift_pattern,
)
from photonfarm.renderer.scene.materials import has_other_lobes
from photonfarm.scene.spec import GuideSpec

if TYPE_CHECKING:
    from photonfarm.renderer.bdpt.recording import Recorder


def point_light(
    scene: Any, position: F32, normal: F32, key: Key, wanted: GuideSpec, recorder: Recorder | None = None
) -> F32:
    """Direct irradiance (L, 3) of points, on the side of their normals; 0 without light samples.

    It takes one shadow ray for each of 16 points of the pattern, shifted by a random vector of each point's own. With a
    `recorder` of `irradiance` Python runs only once.
    """
    if not wanted.light_samples or not scene.emitters():
        return np.zeros_like(position)
    lights, pattern = read_lights(scene), pattern_of(0)
    u = (Stream(key, "point light").uniform(len(position), 1, 3) + pattern) % 1
    at, facing = (np.repeat(each, SUB_PIXELS, axis=0) for each in (position, normal))
    arguments = lights, points(at), points(facing), [floats(column) for column in u.reshape(-1, 3).T]
    traced = functools.partial(recorder, (len(at), lights.kinds)) if recorder else irradiance
    irradiances = traced(scene, None, *arguments)
    mean: F32 = rows(irradiances, len(position), SUB_PIXELS).mean(axis=1, dtype=np.float64).astype(np.float32)
    return mean


def irradiance(scene: Any, _: Any, lights: Lights, position: Any, normal: Any, u: list[Any]) -> Any:
    """The irradiance of each point by one sample of the lights, on the side of its normal (Color3f)."""
    count = dr.width(position)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.p, si.n, si.t = position, mi.Normal3f(normal), dr.ones(mi.Float, count)
    si.sh_frame = mi.Frame3f(si.n)
    light = sample_direct(lights, si, PatternSampler(u), dr.full(mi.Bool, True, count))
    cosine = dr.dot(si.n, light.d)
    shadow = dr.select(light.at_infinity, si.spawn_ray(light.d), si.spawn_ray_to(light.p))
    lit = light.valid & (cosine > 0)
    lit &= ~scene.ray_test(shadow, lit)
    arriving = dr.select(lit, light.radiance_over_density * cosine, 0)
    dr.eval(arriving)
    return arriving


# -------------------------------------------------------------------------------------------------------- on surfaces


@dataclass(frozen=True, slots=True)
class RayArrival:
    """How rays reached a surface."""

    met: Any  # Bool: there is a surface
    direction: Any  # Vector3f: of the ray that meets it
    followed: Any  # UInt32: surfaces passed on the way


@dataclass(slots=True)
class _Sum:
    """Loop variables of the sums over light samples."""

    index: Any  # UInt32
    diffuse: Any  # Color3f
    whole: Any  # Color3f


@dataclass(slots=True)
class ReflectedLight:
    """Reflected direct light."""

    diffuse: Any  # Color3f: by a white diffuse surface
    whole: Any  # Color3f: by the surface as it is

    def __add__(self, more: ReflectedLight) -> ReflectedLight:
        return ReflectedLight(self.diffuse + more.diffuse, self.whole + more.whole)


@dataclass(frozen=True, slots=True)
class _Surface:
    """A surface that reflects direct light."""

    scene: Any
    lights: Lights
    si: Any  # SurfaceInteraction3f
    normal: Any  # Normal3f: turned to where the ray comes from
    direction: Any  # Vector3f: of that ray
    diffuse: Any  # Bool: its diffuse lobe reflects
    other: Any  # Bool: it has other lobes
    settings: GuideSettings


def direct_light(
    scene: Any, lights: Lights | None, si: Any, seen: RayArrival, pattern: Any, shift: Any, settings: GuideSettings
) -> ReflectedLight:
    """Direct light reflected by a surface: as if it were white and diffuse, and by all of its lobes."""
    nothing = ReflectedLight(mi.Color3f(0), mi.Color3f(0))
    if lights is None or not settings.light_samples:
        return nothing
    flags = si.bsdf().flags()
    reached = seen.met & (seen.followed + 2 <= settings.max_depth)
    diffuse = reached & reflects_here(si) & mi.has_flag(flags, mi.BSDFFlags.DiffuseReflection)
    other = reached & has_other_lobes(flags) & settings.glossy
    at = _Surface(
        scene, lights, si, turn_towards(si.sh_frame.n, seen.direction), seen.direction, diffuse, other, settings
    )
    return _sample_lights(at, pattern, shift) + (_sample_bsdf(at, pattern, shift) if settings.glossy else nothing)


def _sample_lights(at: _Surface, pattern: Any, shift: Any) -> ReflectedLight:
    """The mean over shadow rays to points of lights; other lobes get the share of the balance heuristic."""
    count = at.settings.light_samples
    context, bsdf, si = mi.BSDFContext(), at.si.bsdf(), at.si

    def body(s: _Sum) -> tuple[_Sum]:
        light = sample_direct(
            at.lights, si, PatternSampler(shift_pattern(pattern, shift, s.index)), at.diffuse | at.other
        )
        shadow = dr.select(light.at_infinity, si.spawn_ray(light.d), si.spawn_ray_to(light.p))
        lit = light.valid & ~at.scene.ray_test(shadow, light.valid)
        cosine = dr.dot(at.normal, light.d)
        reflects = at.diffuse & lit & (cosine > 0) & (dr.dot(si.n, light.d) * dr.dot(si.n, at.direction) < 0)
        white = dr.select(reflects, light.radiance_over_density * cosine * dr.inv_pi, 0)
        whole = mi.Color3f(0)
        if at.settings.glossy:
            value, density = bsdf.eval_pdf(context, si, si.to_local(light.d), at.other & lit)
            share = dr.select(light.delta, 1, count * light.density / (count * light.density + density))
            whole = dr.select(at.other & lit, value * light.radiance_over_density * share, 0)
        return (_Sum(s.index + 1, s.diffuse + white, s.whole + whole),)

    width = dr.width(at.diffuse)
    start = _Sum(dr.zeros(mi.UInt32, width), dr.zeros(mi.Color3f, width), dr.zeros(mi.Color3f, width))
    (sums,) = loop_once(state=(start,), cond=lambda s: s.index < count, body=body, labels=("sum",), label="shadow rays")
    diffuse = sums.diffuse / count
    of_diffuse = dr.select(at.other, 0, diffuse_reflectance(si, at.diffuse) * diffuse)
    return ReflectedLight(diffuse, sums.whole / count + of_diffuse)


def _sample_bsdf(at: _Surface, pattern: Any, shift: Any) -> ReflectedLight:
    """The light of one ray along a sample of the BSDF, with the share that shadow rays leave."""
    u = shift_pattern(pattern, shift, mi.UInt32(at.settings.light_samples))
    bs, weight = at.si.bsdf().sample(mi.BSDFContext(), at.si, u[0], mi.Point2f(u[1], u[2]), at.other)
    ray = at.si.spawn_ray(at.si.to_world(bs.wo))
    hit = at.scene.ray_intersect(ray, active=at.other)
    emitter = hit.emitter(at.scene, at.other)
    by_light, _ = hit_densities(at.scene, at.lights, emitter, hit, ray.o, at.si.p, at.other)
    is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    share = dr.select(is_delta, 1, bs.pdf / (bs.pdf + at.settings.light_samples * by_light))
    emitted = emitter.eval(hit, at.other)
    return ReflectedLight(mi.Color3f(0), dr.select(at.other & (dr.max(emitted) > 0), weight * emitted * share, 0))


def turn_towards(normal: Any, direction: Any) -> Any:
    """The normal on the side that a ray along `direction` comes from."""
    return dr.select(dr.dot(normal, direction) > 0, -normal, normal)
