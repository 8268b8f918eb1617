"""Eye sub-paths walk from the lens into the scene.

They hit lights (s=0), sample a light at each vertex (s=1, next event estimation), and connect their vertices to those
of light paths (s ≥ 2).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import drjit as dr
import mitsuba as mi

from photonfarm.renderer.bdpt import weights
from photonfarm.renderer.bdpt.camera import EyeStart
from photonfarm.renderer.bdpt.guiding.tally import NoteConnection
from photonfarm.renderer.bdpt.kept_vertices import KeptVertex, KeptVertices
from photonfarm.renderer.bdpt.light_paths import PathOptions, exchange_directions
from photonfarm.renderer.bdpt.lights.emission import DirectSample, Lights, hit_densities, sample_direct
from photonfarm.renderer.bdpt.randomness import SHIFTS, Sampler
from photonfarm.renderer.bdpt.recording import loop_once

_MAX_SURVIVAL = 0.95  # as in Mitsuba's `path`
_NEAR_VERTICES = 2  # the eye vertices that make all n_C connections


@dataclass(slots=True)
class EyeState:
    """Loop variables of an eye path."""

    active: mi.Bool  # this path goes on
    rng: Sampler
    ray: mi.Ray3f  # to this vertex, or out of the scene
    arrival: mi.PreliminaryIntersection3f  # where it arrives
    before: mi.Point3f  # the vertex before, where next event estimation would have chosen its light
    before_ray: mi.Float  # distance from the pinhole to the ray's origin at the first vertex, later 0
    throughput: mi.Spectrum
    radiance: mi.Spectrum  # the estimate so far
    eta: mi.Float  # product of relative refractive indices, for Russian roulette
    whole: mi.Float  # throughput with which it left the first vertex, not scaled by refraction, for the same
    dvcm: mi.Float  # see weights.py, as they left the vertex before
    dvc: mi.Float
    depth: mi.UInt32  # edges up to this vertex


@dataclass(slots=True)
class Connectable:
    """Light vertices, and the choice of those that this pass's eye paths are joined to."""

    vertices: KeptVertices
    paths: mi.UInt32  # [1]: how many there are for each image
    image: mi.UInt32  # image of the launch that a lane belongs to
    first: mi.UInt32  # the slot of its image that a lane is joined to, but for the shift
    shifts: mi.UInt32  # see randomness.shifts
    note: NoteConnection | None = None  # where a guide is learned


def trace_eye_paths(
    scene: mi.Scene,
    lights: Lights | None,
    options: PathOptions,
    *,
    rng: Sampler,
    start: EyeStart,
    connectable: Connectable | None,
) -> tuple[mi.Spectrum, mi.Bool]:
    """(radiance, whether the first ray hit anything) of the eye paths that begin with ``start``."""
    n = dr.width(start.ray)
    active = dr.full(mi.Bool, options.max_depth > 0, n)
    # Neighbouring lanes are neighbouring pixels, so that Embree may trace them as a bundle
    arrival = scene.ray_intersect_preliminary(start.ray, coherent=True, active=active)
    reached = arrival.is_valid()
    active &= _matters(scene, arrival)
    state = EyeState(
        active=active,
        rng=rng,
        ray=mi.Ray3f(start.ray),
        arrival=arrival,
        before=mi.Point3f(start.ray.o),
        before_ray=mi.Float(start.before_ray),
        throughput=mi.Spectrum(start.weight),
        radiance=mi.Spectrum(0),
        eta=mi.Float(1),
        whole=mi.Float(1),
        dvcm=weights.eye_start(options.light_ratio, start.density) if options.traces_light else mi.Float(0),
        dvc=mi.Float(0),
        depth=mi.UInt32(1),
    )
    (state,) = loop_once(
        state=(state,),
        cond=lambda s: s.active,
        body=partial(_bounce, scene=scene, lights=lights, options=options, connectable=connectable),
        labels=("eye path",),
        label="bdpt eye paths",
    )
    return state.radiance, reached


def _bounce(
    s: EyeState, *, scene: mi.Scene, lights: Lights | None, options: PathOptions, connectable: Connectable | None
) -> tuple[EyeState]:
    """One vertex of an eye path: take what it emits, join it to a light and to light paths, scatter."""
    ctx = mi.BSDFContext()

    # ------------------------------------ Arrive ------------------------------------

    si = s.arrival.compute_surface_interaction(s.ray, mi.RayFlags.All, s.active)
    depth = s.depth
    first = depth == 1
    cos_in = dr.abs(dr.dot(si.n, s.ray.d))
    dvcm, dvc = weights.arrive(s.dvcm, s.dvc, dr.square(si.t + s.before_ray), cos_in)
    # Of the technique that joins the vertex before, to a light path that ends here
    count = dr.select(first, 1, options.count * options.usefulness(si, s.active))
    radiance = mi.Spectrum(s.radiance)

    # ------------------------------- Hit a light (s=0) -------------------------------

    if lights is not None:
        emitter = si.emitter(scene, s.active)
        p_direct, p_emission = hit_densities(scene, lights, emitter, si, s.ray.o, s.before, s.active & ~first)
        if options.light_samples > 1:
            p_direct *= dr.select(depth == 2, mi.Float(options.light_samples), 1)
        # No t=1 for direct light; and in the sky a ray arrives at no surface, so that its dVC is still that before
        arrived_dvc = dr.select(depth == 2, 0, dr.select(si.is_valid(), dvc, s.dvc))
        w = dr.select(first, 1, weights.hit_emitter(p_direct, p_emission, s.dvcm, arrived_dvc))
        emitted = emitter.eval(si, s.active)
        radiance += dr.select(dr.max(emitted) > 0, s.throughput * emitted * w, 0)

    active = s.active & si.is_valid() & (cos_in > 0) & (depth < options.max_depth)
    bsdf = si.bsdf()
    smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)

    # -------------------- Next event estimation (s=1), sample the next direction --------------------

    if lights is not None:
        light = sample_direct(lights, si, s.rng, smooth)
        wo = si.to_local(light.d)
    else:
        wo = mi.Vector3f(0, 0, 1)
    value, p_forward, bs, bs_weight = bsdf.eval_pdf_sample(ctx, si, wo, s.rng.next_1d(), s.rng.next_2d(), active)
    if lights is not None:
        joined = _is_unoccluded(scene, si, light, light.valid & (dr.max(value) > 0))
        p_reverse = bsdf.pdf(ctx, *exchange_directions(si, wo), joined)
        p_ratio, share = p_forward / light.density, mi.Float(1)
        if options.light_samples > 1:
            share = dr.select(first, mi.Float(1 / options.light_samples), 1)
            radiance += _more_direct_light(scene, lights, options, s, si, bsdf, smooth & first)
        w = weights.next_event(
            dr.select(light.delta, 0, p_ratio * share),
            light.ratio_over_cos * dr.abs(dr.dot(si.n, light.d)),
            dr.select(first, 0, count),  # no t=1 for direct light
            p_reverse,
            dvcm,
            dvc,
        )
        radiance += dr.select(joined, s.throughput * value * light.radiance_over_density * (w * share), 0)

    # -------------------------- Connect to light paths (s, t ≥ 2) --------------------------

    if connectable is not None:
        own = OwnVertex(si, bsdf, s.throughput, count, dvcm, dvc, depth, smooth & (depth + 1 < options.max_depth))
        radiance += connect_all(scene, options, connectable, own)

    # ----------------------------------- Scatter -----------------------------------

    state = replace(
        s, active=active, before=si.p, radiance=radiance, dvcm=dvcm, dvc=dvc, depth=depth + 1, before_ray=mi.Float(0)
    )
    _scatter(state, ctx, si, bsdf, bs, bs_weight, count)
    _roulette(state, first, options)
    state.arrival = scene.ray_intersect_preliminary(state.ray, active=state.active)
    state.active &= _matters(scene, state.arrival)
    return (state,)


def _matters(scene: mi.Scene, arrival: mi.PreliminaryIntersection3f) -> mi.Bool:
    """Whether a ray is to be followed to its end: where nothing shines around the scene, only if it hits a surface."""
    return mi.Bool(True) if scene.environment() is not None else arrival.is_valid()


def _is_unoccluded(scene: mi.Scene, si: mi.SurfaceInteraction3f, light: DirectSample, active: mi.Bool) -> mi.Bool:
    """Whether nothing is between a surface point and the sampled point of a light."""
    shadow = si.spawn_ray_to(light.p)
    shadow = dr.select(light.at_infinity, si.spawn_ray(light.d), shadow)
    return active & ~scene.ray_test(shadow, active)


def _more_direct_light(
    scene: mi.Scene,
    lights: Lights,
    options: PathOptions,
    s: EyeState,
    si: mi.SurfaceInteraction3f,
    bsdf: mi.BSDFPtr,
    active: mi.Bool,
) -> mi.Spectrum:
    """Radiance at the first vertex from all samples of the lights but one; a light can only be hit instead (s=0)."""
    n = options.light_samples
    rng = s.rng.skip_ahead()  # so that eye paths are the same for every n
    total = mi.Spectrum(0)
    for _ in range(n - 1):
        light = sample_direct(lights, si, rng, active)
        value, p_forward = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(light.d), active)
        joined = _is_unoccluded(scene, si, light, light.valid & (dr.max(value) > 0))
        w = weights.next_event(dr.select(light.delta, 0, p_forward / (n * light.density)), 0, 0, 0, 0, 0)
        total += dr.select(joined, s.throughput * value * light.radiance_over_density * (w / n), 0)
    return total


def _scatter(
    s: EyeState,
    ctx: mi.BSDFContext,
    si: mi.SurfaceInteraction3f,
    bsdf: mi.BSDFPtr,
    bs: mi.BSDFSample3f,
    bs_weight: mi.Spectrum,
    count: mi.Float,
) -> None:
    """Go on along the sampled direction ``bs``, whose ``bs_weight`` is the BSDF's value over its density."""
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    d = si.to_world(bs.wo)
    cos_out = dr.abs(dr.dot(si.n, d))
    s.throughput = s.throughput * bs_weight
    s.eta = s.eta * bs.eta
    s.active &= (bs.pdf > 0) & (dr.max(s.throughput) > 0)

    p_reverse = bsdf.pdf(ctx, *exchange_directions(si, bs.wo), s.active & ~delta)
    vcm, vc = weights.scatter(s.dvcm, s.dvc, count, cos_out, bs.pdf, p_reverse)
    delta_vcm, delta_vc = weights.scatter_delta(s.dvc, cos_out)
    s.dvcm, s.dvc = dr.select(delta, delta_vcm, vcm), dr.select(delta, delta_vc, vc)
    s.ray = si.spawn_ray(d)


def _roulette(s: EyeState, first: mi.Bool, options: PathOptions) -> None:
    """Play Russian roulette with throughput, not scaled by refraction, as the probability of survival.

    After ``rr_depth`` edges it works as in Mitsuba's ``path``. Before, only paths that have lost more than half of the
    throughput with which they left the ``first`` vertex may end, since they cost as much as others and carry less.
    """
    left = dr.max(s.throughput) * dr.square(s.eta)
    s.whole = dr.select(first, left, s.whole)
    kept = dr.select(s.depth > options.rr_depth, dr.minimum(left, _MAX_SURVIVAL), dr.minimum(2 * left / s.whole, 1))
    s.active &= s.rng.next_independent() < kept
    s.throughput *= dr.rcp(kept)


# ------------------------------------------------ Connections ------------------------------------------------


@dataclass(slots=True)
class OwnVertex:
    """The eye vertex that is joined to light paths."""

    si: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    throughput: mi.Spectrum
    count: mi.Float  # count of the technique that joins the vertex before
    dvcm: mi.Float
    dvc: mi.Float
    depth: mi.UInt32
    active: mi.Bool


def connect_all(scene: mi.Scene, options: PathOptions, connectable: Connectable, own: OwnVertex) -> mi.Spectrum:
    """Radiance at an eye vertex from light paths: the mean over connections to kept vertices of several of them.

    The first two eye vertices make n_C connections, later ones half as many: these carry less of the image's noise
    for the same time.
    """
    later = (options.connections + 1) // 2
    near = own.depth <= _NEAR_VERTICES
    share = dr.select(near, mi.Float(1 / options.connections), 1 / later)
    total = mi.Spectrum(0)
    for k in range(options.connections):
        row = connectable.image * SHIFTS + own.depth % SHIFTS
        active = own.active if k < later else own.active & near
        shift = dr.gather(mi.UInt32, connectable.shifts, row * options.connections + k, active)
        slot = connectable.image * connectable.paths + (connectable.first + shift) % connectable.paths
        vertex = connectable.vertices.draw(slot, active)
        value = _connect(scene, options, replace(own, active=active), vertex)
        if connectable.note is not None:
            connectable.note(vertex, value * share, active)
        total += value
    return total * share


def _connect(scene: mi.Scene, options: PathOptions, own: OwnVertex, vertex: KeptVertex) -> mi.Spectrum:
    """One connection (Georgiev 2012, §4.3): both vertices' BSDFs, G without its cosines, visibility and weight."""
    ctx = mi.BSDFContext()
    active = own.active & vertex.is_there
    active &= own.depth + vertex.depth + 1 <= options.max_depth
    si, other = own.si, vertex.si

    offset = other.p - si.p
    r2 = dr.squared_norm(offset)
    active &= r2 > 0
    d = offset * dr.rsqrt(r2)
    wo, wo_other = si.to_local(d), other.to_local(-d)
    cos_own, cos_other = dr.abs(dr.dot(si.n, d)), dr.abs(dr.dot(other.n, d))

    # The eye vertex forward and backward; the light vertex with its directions exchanged, and forward
    f, p = own.bsdf.eval_pdf(ctx, si, wo, active)
    active &= dr.max(f) > 0
    p_reverse = own.bsdf.pdf(ctx, *exchange_directions(si, wo), active)
    bsdf_other = other.bsdf()
    p_other = bsdf_other.pdf(ctx, other, wo_other, active)
    f_other, p_reverse_other = bsdf_other.eval_pdf(ctx, *exchange_directions(other, wo_other), active)

    light_sum = p * cos_other * (vertex.counted_dvcm + p_reverse_other * vertex.dvc)
    eye_sum = p_other * cos_own * (own.count * own.dvcm + p_reverse * own.dvc)
    w = weights.connection_over_r2(vertex.count, r2, light_sum, eye_sum)
    value = own.throughput * f * vertex.throughput_over_cos * f_other * (cos_other * w)
    active &= dr.max(value) > 0
    active &= ~scene.ray_test(si.spawn_ray_to(other.p), active)
    return dr.select(active, value, 0)
