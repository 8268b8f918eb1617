"""Real paths through a scene with their vertices stored, and their weights by the integrator's functions.

Eye paths walk as the integrator's do, each vertex is joined to a light by next event estimation, and each such path is
then treated as made by any of the techniques: the sums of `bdpt.weights` are run from the lens towards the light
and from the light towards the lens, in the order of the integrator's loops, with densities from the integrator
(`lights`, `camera`) and from Mitsuba.

Shape letters: N lanes, one path each; k edges.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from photonfarm.renderer.bdpt import randomness, weights
from photonfarm.renderer.bdpt.camera import EyeStart, primary_rays, sample_sensor
from photonfarm.renderer.bdpt.guiding.usefulness import Usefulness
from photonfarm.renderer.bdpt.light_paths import start_weights
from photonfarm.renderer.bdpt.lights.emission import (
    AREA,
    INFINITE,
    DirectSample,
    Emission,
    Lights,
    hit_densities,
    sample_direct,
)
from tests.stability.weights.oracle import F64

_FOUND = 1e-3  # a ray to a sampled point of a light must end this near to it, relative to the scene's size


@dataclass(slots=True)
class Bounce:
    """A vertex between light and lens."""

    si: Any  # SurfaceInteraction3f
    bsdf: Any  # BSDFPtr
    delta: Any  # Bool
    turn: Any  # Float: see Paths.turn


@dataclass(slots=True)
class JoinedPaths:
    """N paths of k edges."""

    bounces: list[Bounce]  # v₁ … v₍ₖ₋₁₎, from the light's end
    light: DirectSample  # v₀ as next event estimation at v₁ has found it
    emitter: Any  # EmitterPtr
    index: Any  # UInt32: its number
    on_light: Any  # SurfaceInteraction3f at v₀: not valid for lights at infinity
    is_area: Any  # Bool
    start: EyeStart
    complete: Any  # Bool: lanes that have such a path


def walk(scene: Any, lights: Lights, *, paths: int, edges: int, seed: int) -> Iterator[JoinedPaths]:
    """Paths of 2, 3, … ``edges`` edges from ``paths`` primary rays."""
    sensor = scene.sensors()[0]
    width, height = sensor.film().crop_size()
    lane = dr.arange(mi.UInt32, paths)
    rng = randomness.sampler(randomness.stream(randomness.image_keys([seed]), randomness.EYE), lane)
    start = primary_rays(sensor, rng, lane % int(width * height), joined=True)
    ray, active = mi.Ray3f(start.ray), dr.full(mi.Bool, True, paths)
    bounces: list[Bounce] = []
    for _ in range(edges - 1):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        bsdf = si.bsdf()
        smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        emitter = _choice(lights, si, replace(rng, dimension=mi.UInt32(rng.dimension)))
        light = sample_direct(lights, si, rng, smooth)
        joining = Bounce(si, bsdf, mi.Bool(False), mi.Float(1))
        yield _joined(scene, lights, [joining, *bounces], light, emitter, start)
        bs, _ = bsdf.sample(mi.BSDFContext(), si, rng.next_1d(), rng.next_2d(), active)
        active &= bs.pdf > 0
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        turn = dr.abs(mi.Frame3f.cos_theta(si.wi) / (mi.Frame3f.cos_theta(bs.wo) * dr.square(bs.eta)))
        bounces = [Bounce(si, bsdf, delta, dr.select(delta, turn, 1)), *bounces]
        ray = si.spawn_ray(si.to_world(bs.wo))
        dr.eval(ray, active, bounces[0], rng)


def _choice(lights: Lights, si: Any, rng: randomness.Sampler) -> Any:
    """The number of the light that next event estimation chooses with the same random numbers."""
    return dr.zeros(mi.UInt32) if lights.selection is None else lights.selection.choose(si.p, rng.next_1d())[0]


def _joined(
    scene: Any, lights: Lights, bounces: list[Bounce], light: DirectSample, index: Any, start: EyeStart
) -> JoinedPaths:
    si = bounces[0].si
    hit = scene.ray_intersect(si.spawn_ray(light.d), light.valid)
    blocked = scene.ray_test(si.spawn_ray_to(light.p), light.valid & ~light.at_infinity)
    is_area, emitter = lights.is_kind(index, AREA), dr.gather(mi.EmitterPtr, lights.pointers, index)
    same = emitter.eval(hit, light.valid) - light.radiance_over_density * light.density  # not so in another texel
    arrived = hit.is_valid() & (dr.norm(hit.p - light.p) < _FOUND * lights.radius)
    arrived &= dr.max(dr.abs(same)) <= _FOUND * dr.max(light.radiance_over_density * light.density)
    seen = dr.select(light.at_infinity, ~hit.is_valid(), dr.select(is_area, arrived, ~blocked))
    value = bounces[0].bsdf.eval(mi.BSDFContext(), si, si.to_local(light.d), light.valid)
    hit.p = light.p  # the very point: a ray starts a little off its surface, and so it arrives beside it
    joined = JoinedPaths(bounces, light, emitter, index, hit, is_area, start, light.valid & seen & (dr.max(value) > 0))
    dr.eval(joined)
    return joined


# ------------------------------------------------ As the integrator weights them ------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Pinhole:
    """A perspective camera with a square film, from its parameters alone."""

    position: F64  # [3]
    axis: F64  # [3]: where it looks
    film_area: float  # at distance 1

    @classmethod
    def of(cls, scene: Any) -> Pinhole:
        """The pinhole of a scene's first sensor."""
        parameters = mi.traverse(scene.sensors()[0])
        frame = np.array(parameters["to_world"].matrix, np.float64).reshape(4, 4)
        half = np.tan(np.deg2rad(float(parameters["x_fov"][0])) / 2)
        return cls(frame[:3, 3], frame[:3, 2] / np.linalg.norm(frame[:3, 2]), float(4 * half**2))


@dataclass(slots=True)
class Steps:
    """Lengths, cosines and densities of the N paths' single steps, in float32: lists by edge or by vertex."""

    r2: list[Any]  # of edge i, from vᵢ to vᵢ₊₁
    cos_left: list[Any]  # of edge i at vᵢ
    cos_right: list[Any]  # of edge i at vᵢ₊₁
    to_light: list[Any]  # BSDF's density at vⱼ, from the eye's side towards the light; element 0 unused
    to_eye: list[Any]  # the other way round


def steps(joined: JoinedPaths, lens: Pinhole) -> Steps:
    """The steps between the stored vertices."""
    sis = [bounce.si for bounce in joined.bounces]
    points = [joined.light.p, *(si.p for si in sis), mi.Point3f(*lens.position.tolist())]
    offsets = [right - left for left, right in pairwise(points)]
    d = [dr.normalize(offset) for offset in offsets]
    d[0] = -mi.Vector3f(joined.light.d)
    cos_left = [dr.select(joined.is_area, dr.abs(dr.dot(joined.on_light.n, d[0])), 1)]
    cos_left += [dr.abs(dr.dot(si.n, d[j + 1])) for j, si in enumerate(sis)]
    cos_right = [dr.abs(dr.dot(si.n, d[j])) for j, si in enumerate(sis)] + [mi.Float(1)]
    to_light, to_eye = [mi.Float(0)], [mi.Float(0)]
    for j, bounce in enumerate(joined.bounces, start=1):
        eye, light = bounce.si.to_local(d[j]), bounce.si.to_local(-d[j - 1])
        to_light.append(_pdf(bounce, eye, light))
        to_eye.append(_pdf(bounce, light, eye))
    found = Steps([dr.squared_norm(offset) for offset in offsets], cos_left, cos_right, to_light, to_eye)
    dr.eval(found)
    return found


def _pdf(bounce: Bounce, wi: Any, wo: Any) -> Any:
    si = mi.SurfaceInteraction3f(bounce.si)
    si.wi = wi
    return bounce.bsdf.pdf(mi.BSDFContext(), si, wo, True)


@dataclass(frozen=True, slots=True)
class TechniqueCounts:
    """Technique counts as the integrator's weights use them."""

    count: float  # of connections to vertices of usefulness 1
    light_ratio: float
    useful: Usefulness | None = None

    def of(self, bounce: Bounce) -> Any:
        """The count of connections to the light vertices ``bounce``."""
        return self.count if self.useful is None else self.count * self.useful.at(bounce.si, mi.Bool(True))


def weights_of(scene: Any, lights: Lights, joined: JoinedPaths, lens: Pinhole, settings: TechniqueCounts) -> F64:
    """[N, k + 1]: weight of each technique by the integrator's functions; 0 for those that cannot make the path."""
    k = len(joined.bounces) + 1
    st = steps(joined, lens)
    eye, before = _eye_sums(joined, st, settings)
    light = _light_sums(lights, joined, st, settings)
    first = joined.bounces[0].si
    counts = [1, *(settings.of(bounce) for bounce in joined.bounces)]  # of the technique whose last light vertex is vⱼ
    found = [
        _hit_weight(scene, lights, joined, st, before),
        weights.next_event(
            dr.select(joined.light.delta, 0, st.to_light[1] / joined.light.density),
            joined.light.ratio_over_cos * dr.abs(dr.dot(first.n, joined.light.d)),
            0 if k == 2 else counts[1],
            st.to_eye[1],
            *eye[1],
        ),
    ]
    for s in range(2, k):
        y, x = s - 1, s
        n, before, after = counts[y], counts[y - 1], (1 if x == k - 1 else counts[x])
        light_sum = st.to_light[x] * st.cos_left[y] * (before * light[y][0] + st.to_light[y] * light[y][1])
        eye_sum = st.to_eye[y] * st.cos_right[y] * (after * eye[x][0] + st.to_eye[x] * eye[x][1])
        w = weights.connection_over_r2(n, st.r2[y], light_sum, eye_sum) * st.r2[y]
        found.append(w if settings.count else mi.Float(0))
    found.append(_light_tracing_weight(scene, joined, st, light[k - 1], settings) if k > 2 else mi.Float(0))
    for s in range(1, k + 1):
        for j in (s - 1, s):
            if 1 <= j <= k - 1:
                found[s] = dr.select(joined.bounces[j - 1].delta, 0, found[s])
    return np.stack([np.array(dr.select(joined.complete, w, 0), np.float64) for w in found], axis=1)


def _eye_sums(joined: JoinedPaths, st: Steps, settings: TechniqueCounts) -> tuple[dict[int, tuple[Any, Any]], Any]:
    """((dVCM, dVC) on arriving at v₁ … v₍ₖ₋₁₎, the same on leaving v₁)."""
    k = len(joined.bounces) + 1
    dvcm, dvc = weights.eye_start(mi.Float(settings.light_ratio), joined.start.density), mi.Float(0)
    arrived = {}
    for j in range(k - 1, 0, -1):
        arrived[j] = weights.arrive(dvcm, dvc, st.r2[j], st.cos_left[j])
        count = 1 if j == k - 1 else settings.of(joined.bounces[j - 1])
        bounce, out = joined.bounces[j - 1], st.cos_right[j - 1]
        dvcm, dvc = _scattered(bounce, arrived[j], count, out, st.to_light[j], st.to_eye[j])
    return arrived, (dvcm, dvc)


def _scattered(
    bounce: Bounce, arrived: tuple[Any, Any], count: float, cos_out: Any, p: Any, p_reverse: Any
) -> tuple[Any, Any]:
    """(dVCM, dVC) on leaving a vertex."""
    vcm, vc = weights.scatter(*arrived, count, cos_out, p, p_reverse)
    delta_vcm, delta_vc = weights.scatter_delta(arrived[1], cos_out)
    return dr.select(bounce.delta, delta_vcm, vcm), dr.select(bounce.delta, delta_vc, vc)


def _hit_weight(scene: Any, lights: Lights, joined: JoinedPaths, st: Steps, before: Any) -> Any:
    origin = joined.bounces[0].si.p
    si = mi.SurfaceInteraction3f(joined.on_light)
    si.wi = dr.select(si.is_valid(), si.wi, -joined.light.d)
    p_direct, p_emission = hit_densities(scene, lights, joined.emitter, si, origin, origin, joined.complete)
    dvc = dr.select(joined.on_light.is_valid(), before[1] / st.cos_left[0], before[1])
    w = weights.hit_emitter(p_direct, p_emission, before[0], 0 if len(joined.bounces) == 1 else dvc)
    return dr.select(joined.light.delta, 0, w)


def _light_sums(
    lights: Lights, joined: JoinedPaths, st: Steps, settings: TechniqueCounts
) -> dict[int, tuple[Any, Any]]:
    """(dVCM, dVC) of light paths on arriving at v₁ … v₍ₖ₋₁₎."""
    k = len(joined.bounces) + 1
    first = mi.SurfaceInteraction3f(joined.bounces[0].si)
    first.t = dr.norm(first.p - joined.light.p)
    start = Emission(
        ray=mi.Ray3f(joined.light.p, -joined.light.d),
        throughput=mi.Spectrum(1),
        emitter=joined.emitter,
        factor=lights.emission_factor(joined.emitter) * gain(lights, joined),
        p_direction=_direction_density(lights, joined),
        sample=mi.DirectionSample3f(mi.PositionSample3f(joined.on_light)),
        is_area=joined.is_area,
        at_infinity=joined.light.at_infinity,
        delta=joined.light.delta,
        valid=joined.complete,
        cell=mi.UInt32(0),
    )
    r2 = dr.square(first.t)
    left = start_weights(start, lights, first.p, r2, joined.complete)
    dvcm, dvc = weights.arrive(*left, r2, st.cos_right[0])
    arrived = {1: (dvcm, dvc)}
    for j in range(1, k - 1):
        count = 1 if j == 1 else settings.of(joined.bounces[j - 2])
        left = _scattered(joined.bounces[j - 1], arrived[j], count, st.cos_left[j], st.to_eye[j], st.to_light[j])
        arrived[j + 1] = weights.arrive(*left, st.r2[j], st.cos_right[j])
    return arrived


def gain(lights: Lights, joined: JoinedPaths) -> Any:
    """The gain [N] of the guide, if there is one, for light paths that start as these do."""
    ds = dr.zeros(mi.DirectionSample3f)
    ds.d, ds.uv = joined.light.d, joined.on_light.uv
    return lights.gain(joined.emitter, ds, joined.on_light.n, joined.bounces[0].si.p, joined.complete)


def _direction_density(lights: Lights, joined: JoinedPaths) -> Any:
    """The density of a light path's direction from a light at infinity; 1 for lights with a single direction."""
    reference = dr.zeros(mi.Interaction3f)
    reference.p = lights.centre
    ds = dr.zeros(mi.DirectionSample3f)
    ds.d = joined.light.d
    infinite = lights.is_kind(joined.index, INFINITE)
    return dr.select(infinite, joined.emitter.pdf_direction(reference, ds, infinite), 1)


def _light_tracing_weight(
    scene: Any, joined: JoinedPaths, st: Steps, sums: tuple[Any, Any], settings: TechniqueCounts
) -> Any:
    if not settings.light_ratio:
        return mi.Float(0)
    k = len(joined.bounces) + 1
    si = joined.bounces[-1].si
    seen = sample_sensor(scene.sensors()[0], si, mi.Point2f(0.5), joined.complete)
    camera = seen.area_density_over_cos * dr.abs(dr.dot(si.n, seen.d))
    count = settings.of(joined.bounces[-2])
    return weights.light_tracing(camera, settings.light_ratio, count, st.to_light[k - 1], *sums)
