"""Light sub-paths: from a light into the scene, each vertex but the first joined to the lens (t=1), one of each kept.

The first vertex is not joined: direct light is left to next event estimation, which is less noisy than splats, and
complete (lights that it cannot sample start no light paths either).

The vertex kept for connections is drawn uniformly among those a connection can reach, by reservoir sampling (Vitter,
*Random Sampling with a Reservoir*, 1985), together with how many there were. So the storage is one vertex for each path
whatever ``max_depth`` is, nothing can overflow, and weighting the kept vertex by the number it was drawn from keeps
the sum over all of them unbiased.

The light side never evaluates an adjoint BSDF. It evaluates the radiance-mode BSDF with directions exchanged, times
|cos_g(out)|/|cos_g(in)|, so both sides integrate the same function under any shading normal (Veach 1997, §5.3).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from photonfarm.renderer.bdpt import weights
from photonfarm.renderer.bdpt.camera import sample_sensor
from photonfarm.renderer.bdpt.emission import AREA, Emission, Lights, sample_emission
from photonfarm.renderer.bdpt.film import Splat
from photonfarm.renderer.bdpt.randomness import Sampler
from photonfarm.renderer.bdpt.recording import traced_once

_MAX_THROUGHPUT_KEPT = 0.95


@dataclass(frozen=True, slots=True)
class PathOptions:
    """The options of both kinds of sub-path; numbers that may change between renders are in device memory."""

    max_depth: int  # edges; 2³² − 1 for unbounded
    rr_depth: int  # edges after which Russian roulette begins
    connections: int  # n_C: see eye_paths.connect_all
    count: Any  # Float: technique count of connections in the weights (see integrator.connection_count)
    light_ratio: Any  # Float: n_T, light paths per eye path
    connects: bool  # whether any connection is made
    traces_light: bool  # whether any light path is joined to the lens

    @property
    def kind(self) -> tuple[int, ...]:
        """The numbers that kernels are compiled for."""
        return self.max_depth, self.rr_depth, self.connections, self.connects, self.traces_light


@dataclass(slots=True)
class LightVertices:
    """One kept vertex for each of N light paths.

    The surface there is recomputed from its intersection record.
    """

    origin: Any  # Point3f: the ray that reached it
    direction: Any  # Vector3f
    t: Any  # Float
    prim_uv: Any  # Point2f
    prim_index: Any  # UInt32
    shape: Any  # UInt32: registry id
    instance: Any  # UInt32
    throughput: Any  # Spectrum
    dvcm: Any  # Float
    dvc: Any  # Float
    depth: Any  # UInt32: edges from the light


@dataclass(slots=True)
class LightState:
    """Loop variables of a light path."""

    active: Any  # Bool: this path goes on
    rng: Any  # Sampler
    ray: Any  # Ray3f: to this vertex
    hit: Any  # PreliminaryIntersection3f: where it arrives
    throughput: Any  # Spectrum
    dvcm: Any  # Float: see weights.py, after leaving the vertex before
    dvc: Any  # Float
    depth: Any  # UInt32: edges up to this vertex
    seen: Any  # UInt32: vertices a connection could reach so far


def empty_vertices(n: int) -> LightVertices:
    """Memory for one vertex of each of n light paths."""
    return LightVertices(
        *(
            dr.empty(kind, n)
            for kind in (mi.Point3f, mi.Vector3f, mi.Float, mi.Point2f, mi.UInt32, mi.UInt32, mi.UInt32)
        ),
        *(dr.empty(kind, n) for kind in (mi.Spectrum, mi.Float, mi.Float, mi.UInt32)),
    )


def trace_light_paths(
    scene: Any, sensor: Any, lights: Lights, options: PathOptions, *, rng: Sampler, path: Any, paths: Any, splat: Splat
) -> tuple[LightVertices | None, Any]:
    """Trace a light path for each of n points of ``rng`` and add their images on the lens by ``splat``.

    ``path`` is a path's number among the ``paths`` (UInt32, 1) of its image in this launch.

    Returns (kept vertices, number each was drawn from: UInt32 [n]), or (None, ·) without connections.
    """
    n = dr.width(rng.index)
    start = sample_emission(lights, rng, path, paths)
    vertices = empty_vertices(n) if options.connects else None
    (state,) = traced_once(
        state=(first_state(scene, lights, start, rng),),
        cond=lambda s: s.active,
        body=partial(
            vertex_bounce, scene=scene, sensor=sensor, options=options, start=start, splat=splat, vertices=vertices
        ),
        labels=("light path",),
        label="bdpt light paths",
    )
    if vertices is None:
        return None, state.seen
    dr.eval(state.seen, vertices)
    return vertices, state.seen


def first_state(scene: Any, lights: Lights, start: Emission, rng: Any) -> LightState:
    """The loop variables at the first hit."""
    active = mi.Bool(start.valid)
    hit = scene.ray_intersect_preliminary(start.ray, coherent=True, active=active)
    active &= hit.is_valid()
    dvcm, dvc = start_weights(start, lights, start.ray(hit.t), dr.square(hit.t), active)
    return LightState(active, rng, start.ray, hit, mi.Spectrum(start.throughput), dvcm, dvc, mi.UInt32(1), mi.UInt32(0))


def vertex_bounce(
    s: LightState,
    *,
    scene: Any,
    sensor: Any,
    options: PathOptions,
    start: Emission,
    splat: Splat,
    vertices: LightVertices | None,
) -> tuple[LightState]:
    """Process one vertex of a light path: arrive, join to the lens, perhaps keep it, and scatter."""
    ctx = mi.BSDFContext()

    # ------------------------------------ Arrive ------------------------------------

    si = s.hit.compute_surface_interaction(s.ray, mi.RayFlags.All, s.active)
    depth = s.depth
    first = depth == 1
    cos_in = dr.abs(dr.dot(si.n, s.ray.d))
    active = s.active & (cos_in > 0)
    dvcm, dvc = weights.arrive(s.dvcm, s.dvc, dr.square(si.t), cos_in)
    count = mi.Float(dr.select(first, 1, options.count))
    bsdf = si.bsdf()
    smooth = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)

    # ------------------------------ Join to the lens (t=1) ------------------------------

    if options.traces_light:
        aperture = s.rng.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
        seen = sample_sensor(sensor, si, aperture, active & smooth & ~first)
        value, p_reverse = _exchanged(ctx, bsdf, si, si.to_local(seen.d), seen.valid)
        cos_out = dr.abs(dr.dot(si.n, seen.d))
        w = weights.light_tracing(
            seen.area_density_over_cos * cos_out, options.light_ratio, count, p_reverse, dvcm, dvc
        )
        joined = seen.valid & (dr.max(value) > 0)
        joined &= ~scene.ray_test(_from_lens(seen.start, si), joined)
        splat.add(seen.position, s.throughput * value * seen.weight * (w * cos_out / cos_in), joined)

    # ----------------------------- Keep for connections -----------------------------

    count_seen = mi.UInt32(s.seen)
    if vertices is not None:
        reachable = active & smooth & (depth + 1 < options.max_depth)
        count_seen[reachable] += 1
        keep = reachable & (s.rng.next_independent() * mi.Float(count_seen) < 1)
        dr.scatter(vertices, _record(s, dvcm, dvc), dr.arange(mi.UInt32, dr.width(start.valid)), keep)

    # ----------------------------------- Scatter -----------------------------------

    goes_on = active & (depth + 1 < options.max_depth)
    state = replace(s, active=goes_on, dvcm=dvcm, dvc=dvc, depth=depth + 1, seen=count_seen)
    scatter(state, si, bsdf, cos_in, count)
    roulette(state, start, options)
    state.hit = scene.ray_intersect_preliminary(state.ray, active=state.active)
    state.active &= state.hit.is_valid()
    return (state,)


def _from_lens(start: Any, si: Any) -> Any:
    """The ray from the near plane to just before a surface.

    In the other direction, `spawn_ray_to` would leave out the last part: objects just behind the near plane would
    hide nothing, although they hide the surface from primary rays.
    """
    end = si.spawn_ray_to(start).o
    way = end - start
    distance = dr.norm(way)
    return mi.Ray3f(start, way / distance, distance, si.time, si.wavelengths)


def scatter(s: LightState, si: Any, bsdf: Any, cos_in: Any, count: Any) -> None:
    """Sample the next direction. Delta lobes get the importance-mode weight times Veach's factor (1997, eq. 5.20)."""
    importance = mi.BSDFContext()
    importance.mode = mi.TransportMode.Importance
    bs, delta_weight = bsdf.sample(importance, si, s.rng.next_1d(), s.rng.next_2d(), s.active)
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    d = si.to_world(bs.wo)
    cos_out = dr.abs(dr.dot(si.n, d))
    value, p_reverse = _exchanged(mi.BSDFContext(), bsdf, si, bs.wo, s.active & ~delta)

    shading = dr.abs(mi.Frame3f.cos_theta(si.wi)) / dr.abs(mi.Frame3f.cos_theta(bs.wo))
    factor = dr.select(delta, delta_weight * shading, value / bs.pdf) * (cos_out / cos_in)
    # A failed sample may have a density and a direction: only its weight, which is 0, says that it failed
    s.active &= (bs.pdf > 0) & (dr.max(delta_weight) > 0) & (dr.max(factor) > 0) & dr.isfinite(dr.max(factor))
    s.throughput = dr.select(s.active, s.throughput * factor, 0)

    vcm, vc = weights.scatter(s.dvcm, s.dvc, count, cos_out, bs.pdf, p_reverse)
    delta_vcm, delta_vc = weights.scatter_delta(s.dvc, cos_out)
    s.dvcm, s.dvc = dr.select(delta, delta_vcm, vcm), dr.select(delta, delta_vc, vc)
    s.ray = si.spawn_ray(d)


def roulette(s: LightState, start: Emission, options: PathOptions) -> None:
    """Russian roulette by the throughput relative to the start: after ``rr_depth`` edges as in Mitsuba's ``path``.

    Before that, it meets only paths that have lost more than two thirds of it: they cost as much as others and carry
    less.
    """
    left = dr.max(s.throughput) / dr.max(start.throughput)
    kept = dr.select(s.depth > options.rr_depth, dr.minimum(left, _MAX_THROUGHPUT_KEPT), dr.minimum(3 * left, 1))
    s.active &= (s.rng.next_independent() < kept) & (kept > 0)
    s.throughput *= dr.rcp(kept)


def _exchanged(ctx: Any, bsdf: Any, si: Any, wo: Any, active: Any) -> tuple[Any, Any]:
    """(BSDF·|cos_s(wi)|, pdf) of radiance that arrives along ``wo`` and leaves along ``si.wi``: directions exchanged.

    The pdf is the density of sampling ``si.wi`` from ``wo``: the reverse density of a light path's bounce.
    """
    exchanged = mi.SurfaceInteraction3f(si)
    wi = mi.Vector3f(si.wi)
    exchanged.wi = wo
    return bsdf.eval_pdf(ctx, exchanged, wi, active)


def start_weights(start: Emission, lights: Lights, p: Any, r2: Any, mask: Any) -> tuple[Any, Any]:
    """(dVCM, dVC) of light paths' first rays, which end at ``p`` with the squared length ``r2``; see weights.py.

    Lanes outside ``mask`` may hold anything. With p_NEE = p_ω·cos₀/r² and e = ê·cos₀ an area light's cos₀ cancels.
    """
    selection = lights.nee_probability(start.emitter, p)
    dvcm, dvc = weights.light_start(selection, start.factor), mi.Float(0)
    if lights.has(AREA):
        seen_from = dr.zeros(mi.Interaction3f)
        seen_from.p = p
        ds = mi.DirectionSample3f(start.sample)
        ds.dist = dr.sqrt(r2)
        ds.d = (start.sample.p - p) / ds.dist
        p_direction = selection * start.emitter.pdf_direction(seen_from, ds, mask & start.is_area)
        dvcm = dr.select(start.is_area, weights.light_start(p_direction / r2, start.factor), dvcm)
        dvc = dr.rcp(start.factor)
    dvcm = dr.select(start.at_infinity, weights.light_start(selection / r2, start.factor), dvcm)
    dvc = dr.select(start.at_infinity, dr.rcp(start.factor * start.p_direction), dvc)
    return dvcm, dr.select(start.delta, 0, dvc)


def _record(s: LightState, dvcm: Any, dvc: Any) -> LightVertices:
    return LightVertices(
        s.ray.o,
        s.ray.d,
        s.hit.t,
        s.hit.prim_uv,
        s.hit.prim_index,
        dr.reinterpret_array(mi.UInt32, s.hit.shape),
        dr.reinterpret_array(mi.UInt32, s.hit.instance),
        s.throughput,
        dvcm,
        dvc,
        s.depth,
    )
