"""Traces light sub-paths from the lights; joins their vertices to the lens, and keeps one of each path for connections.

The first surface vertex is not joined to the lens (t=1), but all later ones are. Direct light is left to next event
estimation, which has less noise than splats. It misses none, as lights that it cannot sample start no light paths.

The vertex kept for connections is drawn among those that a connection can reach, in proportion to their weights, by
reservoir sampling (Chao, *A General Purpose Unequal Probability Sampling Plan*, 1982). A vertex's weight is its
throughput, times its usefulness where that is known (see `guiding.usefulness`). So each path needs storage for one
vertex whatever ``max_depth`` is. Its throughput is divided by the probability with which it was drawn, which keeps the
sum over all vertices unbiased.

The light side never evaluates an adjoint BSDF. It evaluates the radiance-mode BSDF with exchanged directions, times
|cos_g(out)|/|cos_g(in)|, so both sides integrate the same function under any shading normal (Veach 1997, §5.3).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import drjit as dr
import mitsuba as mi

from photonfarm.renderer.bdpt import weights
from photonfarm.renderer.bdpt.camera import Splat, sample_sensor
from photonfarm.renderer.bdpt.guiding.tally import Tally
from photonfarm.renderer.bdpt.guiding.usefulness import Usefulness
from photonfarm.renderer.bdpt.kept_vertices import KeptVertex, KeptVertices, Record, empty_record
from photonfarm.renderer.bdpt.lights.emission import AREA, Emission, Lights, sample_emission
from photonfarm.renderer.bdpt.randomness import Sampler
from photonfarm.renderer.bdpt.recording import loop_once

_MAX_SURVIVAL = 0.95  # as in Mitsuba's `path`


@dataclass(frozen=True, slots=True)
class PathOptions:
    """The options of both kinds of sub-path; numbers that may change between renders are in device memory."""

    max_depth: int  # edges; 2³² − 1 for unbounded
    rr_depth: int  # edges after which Russian roulette begins
    connections: int  # n_C: see eye_paths.connect_all
    count: mi.Float  # of connections to vertices of usefulness 1, in the weights (see integrator.connection_count)
    light_ratio: mi.Float  # n_T, light paths per eye path
    connects: bool  # whether any connection is made
    traces_light: bool  # whether any light path is joined to the lens
    light_samples: int = 1  # samples of the lights at the first eye vertex
    useful: Usefulness | None = None  # of light vertices for connections, where it is known

    @property
    def kind(self) -> tuple[int, ...]:
        """The numbers for which the kernels are compiled."""
        counts = self.max_depth, self.rr_depth, self.connections, self.light_samples
        return *counts, self.connects, self.traces_light, self.useful is not None

    def usefulness(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Float:
        """How useful light vertices are for connections, 1 on average; 1 for all where it is not known."""
        return mi.Float(1) if self.useful is None else self.useful.at(si, active)


@dataclass(slots=True)
class LightState:
    """Loop variables of a light path."""

    active: mi.Bool  # this path goes on
    rng: Sampler
    ray: mi.Ray3f  # to this vertex
    hit: mi.PreliminaryIntersection3f  # where it arrives
    throughput: mi.Spectrum
    dvcm: mi.Float  # see weights.py, as they left the vertex before
    dvc: mi.Float
    count: mi.Float  # of the technique that joins the vertex before
    depth: mi.UInt32  # edges up to this vertex
    weight: mi.Float  # sum of the weights of the vertices that a connection could reach so far
    kept: Record  # of one of them, drawn in proportion to its weight; empty without connections


def trace_light_paths(
    scene: mi.Scene,
    sensor: mi.Sensor,
    lights: Lights,
    options: PathOptions,
    *,
    rng: Sampler,
    path: mi.UInt32,
    paths: mi.UInt32,
    offset: mi.Float,
    splat: Splat,
    tally: Tally | None = None,
) -> KeptVertices | None:
    """Trace a light path for each of n points of ``rng``, and add what the lens sees of them by ``splat``.

    ``path`` [n] is a path's number among the ``paths`` [1] of its image in this launch, and ``offset`` [K] a random
    number for each image. ``tally`` notes their starts and edges. Returns the kept vertices, or None without
    connections.
    """
    start = sample_emission(lights, rng, path, paths)
    if tally is not None:
        tally.begin_paths(start.cell)
    (state,) = loop_once(
        state=(first_state(scene, lights, start, rng, empty_record() if options.connects else ()),),
        cond=lambda s: s.active,
        body=partial(vertex_bounce, scene=scene, sensor=sensor, options=options, start=start, splat=splat),
        labels=("light path",),
        label="bdpt light paths",
    )
    if tally is not None:
        tally.end_paths(state.depth)
    if not options.connects:
        dr.eval(state.depth)
        return None
    dr.eval(state.kept, state.weight)
    vertices = KeptVertices.of(state.kept, state.weight, offset, paths)
    dr.eval(vertices)
    return vertices


def first_state(scene: mi.Scene, lights: Lights, start: Emission, rng: Sampler, kept: Record = ()) -> LightState:
    """The loop variables at the first hit; active are the light paths that hit a surface."""
    active = mi.Bool(start.valid)
    # Rays of one light set out in like directions. Those of several cross, and as a bundle they would take longer
    hit = scene.ray_intersect_preliminary(start.ray, coherent=lights.count == 1, active=active)
    active &= hit.is_valid()
    dvcm, dvc = start_weights(start, lights, start.ray(hit.t), dr.square(hit.t), active)
    return LightState(
        active=active,
        rng=rng,
        ray=start.ray,
        hit=hit,
        throughput=mi.Spectrum(start.throughput),
        dvcm=dvcm,
        dvc=dvc,
        count=mi.Float(1),  # next event estimation, which joins the vertex on the light
        depth=mi.UInt32(1),
        weight=mi.Float(0),
        kept=kept,
    )


def vertex_bounce(
    s: LightState,
    *,
    scene: mi.Scene,
    sensor: mi.Sensor,
    options: PathOptions,
    start: Emission,
    splat: Splat,
) -> tuple[LightState]:
    """Handle one vertex of a light path: join it to the lens, perhaps keep it, and scatter."""
    ctx = mi.BSDFContext()

    # ------------------------------------ Arrive ------------------------------------

    si = s.hit.compute_surface_interaction(s.ray, mi.RayFlags.All, s.active)
    depth = s.depth
    first = depth == 1
    cos_in = dr.abs(dr.dot(si.n, s.ray.d))
    active = s.active & (cos_in > 0)
    dvcm, dvc = weights.arrive(s.dvcm, s.dvc, dr.square(si.t), cos_in)
    useful = options.usefulness(si, active)
    bsdf = si.bsdf()
    smooth = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)

    # ------------------------------ Join to the lens (t=1) ------------------------------

    if options.traces_light:
        aperture = s.rng.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
        seen = sample_sensor(sensor, si, aperture, active & smooth & ~first)
        value, p_reverse = bsdf.eval_pdf(ctx, *exchange_directions(si, si.to_local(seen.d)), seen.valid)
        cos_out = dr.abs(dr.dot(si.n, seen.d))
        w = weights.light_tracing(
            seen.area_density_over_cos * cos_out, options.light_ratio, s.count, p_reverse, dvcm, dvc
        )
        joined = seen.valid & (dr.max(value) > 0)
        joined &= ~scene.ray_test(_ray_from_lens(seen.start, si), joined)
        splat.add(seen.position, s.throughput * value * seen.weight * (w * cos_out / cos_in), joined)

    # ----------------------------- Keep for connections -----------------------------

    total, count = mi.Float(s.weight), options.count * useful
    kept = s.kept
    if options.connects:
        reachable = active & smooth & (depth + 1 < options.max_depth)
        weight = dr.max(s.throughput) * useful
        total[reachable] += weight
        keep = reachable & (s.rng.next_independent() * total < weight)
        # The draw has the probability weight / total; `KeptVertices.of` multiplies by the total
        vertex = KeptVertex(si, s.throughput / (weight * cos_in), s.count * dvcm, dvc, count, depth).record()
        kept = tuple(dr.select(keep, new, old) for new, old in zip(vertex, s.kept, strict=True))

    # ----------------------------------- Scatter -----------------------------------

    goes_on = active & (depth + 1 < options.max_depth)
    state = replace(s, active=goes_on, dvcm=dvcm, dvc=dvc, depth=depth + 1, weight=total, kept=kept)
    scatter(state, si, bsdf, cos_in)  # with the technique count of the vertex before
    state.count = count
    roulette(state, start, options)
    state.hit = scene.ray_intersect_preliminary(state.ray, active=state.active)
    state.active &= state.hit.is_valid()
    return (state,)


def _ray_from_lens(start: mi.Point3f, si: mi.SurfaceInteraction3f) -> mi.Ray3f:
    """The ray from ``start`` on the near plane to a point just before a surface.

    ``spawn_ray_to`` makes a ray in the other direction that ends before ``start``. Objects right behind the near plane
    would then hide nothing, although they do for primary rays.
    """
    end = si.spawn_ray_to(start).o
    way = end - start
    distance = dr.norm(way)
    return mi.Ray3f(start, way / distance, distance, si.time, si.wavelengths)


def scatter(s: LightState, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, cos_in: mi.Float) -> None:
    """Sample the next direction; delta lobes get their importance-mode weight times Veach's factor (1997, eq. 5.20)."""
    importance = mi.BSDFContext()
    importance.mode = mi.TransportMode.Importance
    bs, delta_weight = bsdf.sample(importance, si, s.rng.next_1d(), s.rng.next_2d(), s.active)
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    d = si.to_world(bs.wo)
    cos_out = dr.abs(dr.dot(si.n, d))
    value, p_reverse = bsdf.eval_pdf(mi.BSDFContext(), *exchange_directions(si, bs.wo), s.active & ~delta)

    shading = dr.abs(mi.Frame3f.cos_theta(si.wi)) / dr.abs(mi.Frame3f.cos_theta(bs.wo))
    factor = dr.select(delta, delta_weight * shading, value / bs.pdf) * (cos_out / cos_in)
    # A failed sample may have a density and a direction: only its weight of 0 shows that it failed
    s.active &= (bs.pdf > 0) & (dr.max(delta_weight) > 0) & (dr.max(factor) > 0) & dr.isfinite(dr.max(factor))
    s.throughput = dr.select(s.active, s.throughput * factor, 0)

    vcm, vc = weights.scatter(s.dvcm, s.dvc, s.count, cos_out, bs.pdf, p_reverse)
    delta_vcm, delta_vc = weights.scatter_delta(s.dvc, cos_out)
    s.dvcm, s.dvc = dr.select(delta, delta_vcm, vcm), dr.select(delta, delta_vc, vc)
    s.ray = si.spawn_ray(d)


def roulette(s: LightState, start: Emission, options: PathOptions) -> None:
    """Play Russian roulette with the throughput, relative to that at the start, as the probability of survival.

    After ``rr_depth`` edges it works as in Mitsuba's ``path``. Before, only paths that have lost more than two thirds
    of their throughput may end, since they cost as much as others and carry less.
    """
    left = dr.max(s.throughput) / dr.max(start.throughput)
    survival = dr.select(s.depth > options.rr_depth, dr.minimum(left, _MAX_SURVIVAL), dr.minimum(3 * left, 1))
    s.active &= (s.rng.next_independent() < survival) & (survival > 0)
    s.throughput *= dr.rcp(survival)


def exchange_directions(si: mi.SurfaceInteraction3f, wo: mi.Vector3f) -> tuple[mi.SurfaceInteraction3f, mi.Vector3f]:
    """The arguments that evaluate a BSDF with exchanged directions: ``si`` with ``wo`` for ``si.wi``, and ``si.wi``.

    With them ``bsdf.eval`` is BSDF·|cos_s(wi)| for radiance that arrives along ``si.wi`` and leaves along ``wo``, and
    ``bsdf.pdf`` is the density of sampling ``si.wi`` from ``wo``, the reverse of a bounce from ``si.wi`` to ``wo``.
    """
    turned = mi.SurfaceInteraction3f(si)
    wi = mi.Vector3f(si.wi)
    turned.wi = wo
    return turned, wi


def start_weights(
    start: Emission, lights: Lights, p: mi.Point3f, r2: mi.Float, mask: mi.Bool
) -> tuple[mi.Float, mi.Float]:
    """The (dVCM, dVC) of the first rays of light paths, which arrive at ``p`` over a squared distance ``r2``.

    See weights.py. Lanes outside ``mask`` may hold anything. An area light's cos₀ cancels, as p_NEE = p_ω·cos₀/r² and
    e = ê·cos₀.
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
