"""Rays followed through mirrors and glass, and the surfaces on the way and at the end.

The share of light that a surface reflects or transmits by lobes other than the diffuse one is evaluated by these lobes
alone, through the context's `type_mask`. Subtracting the diffuse reflectance from the total would not work: the coat of
a plastic leaves its base less light, so the difference is too small, and often below 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from photonfarm.renderer.bdpt.lights.emission import Lights
from photonfarm.renderer.bdpt.recording import loop_once
from photonfarm.renderer.scene.gbuffer import diffuse_reflectance, seen_reflectance
from photonfarm.renderer.scene.guides.direct import RayArrival, direct_light, turn_towards
from photonfarm.renderer.scene.guides.pattern import STEPS, SUB_PIXELS, GuideSettings
from photonfarm.renderer.scene.materials import is_pure_delta


def trace(
    scene: Any,
    _: Any,
    lights: Lights | None,
    tables: Any,
    o: Any,
    d: Any,
    reach: Any,
    along: Any,
    shift: Any,
    settings: GuideSettings,
) -> dict[str, Any]:
    """The quantities that `images` averages, by name, for each ray; zeros where there is nothing.

    `tables` are the roughness of BSDFs, their `diffuse_kept`, and three columns of points; rays begin on the near
    plane, whose distance from the eye is `settings.near` / `along`.
    """
    roughness, diffuse_kept, *pattern = tables
    ray = mi.Ray3f(o=o, d=d, maxt=reach, time=0, wavelengths=[])
    first = scene.ray_intersect(ray)
    hit, bsdf, before = first.is_valid(), first.bsdf(), settings.near / along
    number = dr.reinterpret_array(mi.UInt32, bsdf)
    path, last = _follow_to_end(scene, ray, first, before, settings)
    met, is_beyond = last.is_valid(), hit & (path.followed > 0)
    albedo = seen_reflectance(last, met)
    arrives = direct_light(scene, lights, last, RayArrival(met, path.ray.d, path.followed), pattern, shift, settings)
    columns = {
        "hits": dr.select(hit, mi.Float(1), 0),
        "depth": dr.select(hit, settings.near + first.t * along, 0),
        "normal": dr.select(hit, turn_towards(first.sh_frame.n, d), 0),
        "specular": specular_of(bsdf, first, hit, dr.gather(mi.Float, diffuse_kept, number, hit)),
        "roughness": dr.gather(mi.Float, roughness, number, hit),
        "emission": path.emission,
        "direct": path.throughput * albedo * arrives.diffuse,
        "gloss": path.throughput * (arrives.whole - albedo * arrives.diffuse),
        "throughput": dr.select(is_beyond, path.throughput, 0),
        "beyond": dr.select(is_beyond & met, mi.Float(1), 0),
        "beyond_albedo": dr.select(is_beyond & met, albedo, 0),
        "beyond_normal": dr.select(is_beyond & met, turn_towards(last.sh_frame.n, path.ray.d), 0),
        "beyond_depth": dr.select(is_beyond & met, path.length + last.t, 0),
    }
    dr.eval(columns)
    return columns


@dataclass(slots=True)
class _Path:
    """Loop variables of a path through mirrors and glass."""

    active: Any  # Bool: the ray has not been traced yet
    ray: Any  # Ray3f
    throughput: Any  # Color3f
    emission: Any  # Color3f: of all surfaces on the way
    length: Any  # Float: from the eye to the ray's origin
    followed: Any  # UInt32: surfaces passed on the way


def _follow_to_end(scene: Any, ray: Any, first: Any, before: Any, settings: GuideSettings) -> tuple[_Path, Any]:
    """Follow each ray from `first`, which it meets, to the first surface that is no pure mirror, glass or null.

    Returns the path, and that surface.
    """
    active = dr.full(mi.Bool, True, dr.width(ray))
    start = _Path(active, mi.Ray3f(ray), mi.Color3f(1), mi.Color3f(0), mi.Float(before), mi.UInt32(0))
    start = _follow(scene, start, first, settings)
    if not settings.followed:
        return start, first
    (path,) = loop_once(
        state=(start,),
        cond=lambda s: s.active,
        body=lambda s: (_follow(scene, s, scene.ray_intersect(s.ray, active=s.active), settings),),
        labels=("path",),
        label="mirrors and glass",
    )
    led_on = path.followed > 0
    return path, dr.select(led_on, scene.ray_intersect(path.ray, active=led_on), first)


def _follow(scene: Any, s: _Path, si: Any, settings: GuideSettings) -> _Path:
    """Process one surface `si` on the way: its emission, and the ray that leaves it if it has delta lobes alone.

    Sampled at 1/2, glass gives the lobe that takes more than half of the light, with a probability equal to its share.
    """
    emitted = dr.select(s.active & (s.followed < settings.max_depth), si.emitter(scene).eval(si, s.active), 0)
    bsdf = si.bsdf()
    leads_on = s.active & si.is_valid() & is_pure_delta(bsdf.flags()) & (s.followed < settings.followed)
    bs, weight = bsdf.sample(mi.BSDFContext(), si, mi.Float(0.5), mi.Point2f(0.5), leads_on)
    return _Path(
        active=leads_on,
        ray=dr.select(leads_on, si.spawn_ray(si.to_world(bs.wo)), s.ray),
        throughput=dr.select(leads_on, s.throughput * weight * bs.pdf, s.throughput),
        emission=s.emission + s.throughput * emitted,
        length=dr.select(leads_on, s.length + si.t, s.length),
        followed=dr.select(leads_on, s.followed + 1, s.followed),
    )


BSDF_SAMPLES = 2
"""The samples of each ray, for the directional albedo."""


def specular_of(bsdf: Any, si: Any, hit: Any, diffuse_kept: Any) -> Any:
    """The directional albedo of all lobes but the diffuse one, 0 if there are none; it may be below 0 for `principled`.

    `diffuse_kept` is that of `Materials`. The albedo is a share of the light's power: radiance in glass is larger by
    the square of the refractive index.
    """
    flags, context = bsdf.flags(), mi.BSDFContext(mi.TransportMode.Importance)
    context.type_mask = int(mi.BSDFFlags.All) & ~int(mi.BSDFFlags.Diffuse)
    other = mi.has_flag(flags, mi.BSDFFlags.Delta) | mi.has_flag(flags, mi.BSDFFlags.Glossy)
    sampled = hit & other
    total = mi.Color3f(0)
    within = dr.arange(mi.UInt32, dr.width(hit)) % SUB_PIXELS
    for sample in range(BSDF_SAMPLES):
        u = [dr.fma(mi.Float(within * BSDF_SAMPLES + sample), step, 0.5) for step in STEPS]
        u = [x - dr.floor(x) for x in u]
        _, weight = bsdf.sample(context, si, u[0], mi.Point2f(u[1], u[2]), sampled)
        total += dr.select(sampled, weight, 0)
    return total / BSDF_SAMPLES - dr.select(sampled, diffuse_kept * diffuse_reflectance(si, sampled), 0)
