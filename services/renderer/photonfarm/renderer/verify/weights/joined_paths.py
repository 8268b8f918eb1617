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
from photonfarm.renderer.bdpt.grid import Grid
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
from photonfarm.renderer.verify.weights.oracle import F64, OraclePaths

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
        factor=lights.emission_factor(joined.emitter) * _gain(lights, joined),
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


def _gain(lights: Lights, joined: JoinedPaths) -> Any:
    """The gain of the guide, if there is one, for light paths that start as these do."""
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


# ------------------------------------------------ As the oracle sees them ------------------------------------------


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
    return next_event, started * emission * _column(kept, _gain(lights, joined))


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
