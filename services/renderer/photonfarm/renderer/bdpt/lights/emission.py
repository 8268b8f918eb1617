"""The lights of a scene as data: the probability of choosing each light, and the start of a light path.

The selection probabilities are arrays in device memory, never literals: they are rebuilt from the scene at the start
of each render without reading anything back, so a light that is switched off in place (radiance 0) is never chosen and
no kernel changes.

Mitsuba's ``sample_ray`` has no density and is wrong for rotated environment maps and stale bounding spheres, so
emission is sampled here by type. e is the density with which a light path starts at a point y₀ and in a direction. In
each case e = ê·c, with a number ê per light that is known before sampling (column ``emission``), and cos₀ the cosine
at y₀:

    area                 uniform on the surface, cosine-weighted direction    ê = P/(A·π)             c = cos₀
    constant, envmap     direction by the light's own density p_ω, disk πR²   ê = P/(πR²)             c = p_ω
    directional          its direction, disk πR²                              ê = P/(πR²)             c = 1
    point, projector     uniform on the sphere                                ê = P/(4π)              c = 1
    spot                 uniform in its cone                                  ê = P/(2π(1 − cos θ))   c = 1

P is the probability with which light paths choose the light (`emit_probability`), A the area, R the radius of a sphere
around the scene's current bounding box.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from photonfarm.renderer.bdpt.guiding import grid
from photonfarm.renderer.bdpt.guiding.starts import GuidedStarts, StartGuide, rectangles
from photonfarm.renderer.bdpt.lights.selection import (
    LightIndex,
    Selection,
    is_flat,
    is_unfolded,
    read_selection,
    sampling_weight,
)
from photonfarm.renderer.bdpt.lights.shapes import Spheres, column, cones, is_textured, is_unmirrored, registry_id
from photonfarm.renderer.bdpt.randomness import RandomNumbers, Sampler, along_curve
from photonfarm.renderer.bdpt.scenes import bounding_box, bounding_sphere

AREA, INFINITE, POSITION, DIRECTION, EYE_ONLY, HIT_ONLY = range(6)
"""The kinds of light. Light paths never start at EYE_ONLY; HIT_ONLY is found by hits alone, which have weight 1."""

_KIND_BY_CLASS = {
    "AreaLight": AREA,
    "ConstantBackgroundEmitter": INFINITE,
    "EnvironmentMapEmitter": INFINITE,
    "PointLight": POSITION,
    "SpotLight": POSITION,
    "Projector": POSITION,
    "DirectionalEmitter": DIRECTION,
}


@dataclass(slots=True)
class Lights:
    """The N lights of a scene at one moment. Tables "by id" are indexed by Dr.Jit's registry id of the emitter."""

    pointers: mi.EmitterPtr  # [N]
    count: int  # N
    kinds: tuple[int, ...]  # [N]: kind of each light; fixed while the scene's topology is
    kind: mi.UInt32  # [N]: the same as data
    selection: Selection | None  # probabilities for next event estimation; None for a single light
    alive: mi.Float  # by id: 1 if it shines, else 0: the probability of choosing a light that is the only one
    emit_cdf: mi.Float  # [N]: running sum of the probabilities for light paths, not normalised
    emission: mi.Float  # by id: ê of the table above, 0 where light paths never start
    axis: mi.Vector3f  # [N]: axis of a spot light's cone
    cos_cutoff: mi.Float  # [N]: −1 for lights that shine everywhere
    centre: mi.Point3f  # [1]: centre of the scene's sphere
    radius: mi.Float  # [1]: its radius
    spheres: Spheres | None = None  # normals of lights that are spheres
    guided: GuidedStarts | None = None  # how light paths start where they are guided

    def only(self, kind: int) -> bool:
        """Whether all lights that can be selected are of this kind; the host knows it, so other kinds cost nothing."""
        return all(k in (kind, HIT_ONLY) for k in self.kinds)

    def has(self, kind: int) -> bool:
        """Whether there is a light of this kind, which is known on the host."""
        return kind in self.kinds

    def is_kind(self, index: LightIndex, kind: int) -> mi.Bool:
        """The mask of lanes whose light ``index`` is of this kind."""
        if not self.has(kind):
            return mi.Bool(False)
        if self.only(kind):
            return mi.Bool(True)
        return dr.gather(mi.UInt32, self.kind, index) == kind

    def is_at_infinity(self, index: LightIndex) -> mi.Bool:
        """The mask of lanes whose light ``index`` is INFINITE or DIRECTION."""
        return self.is_kind(index, INFINITE) | self.is_kind(index, DIRECTION)

    def nee_probability(self, emitter: mi.EmitterPtr, p: mi.Point3f) -> mi.Float:
        """The probability of choosing ``emitter`` for next event estimation at points ``p``; 0 for the null pointer."""
        if self.selection is None:
            return dr.gather(mi.Float, self.alive, dr.reinterpret_array(mi.UInt32, emitter))
        return self.selection.probability(p, emitter)

    def emission_factor(self, emitter: mi.EmitterPtr) -> mi.Float:
        """The ê of the given emitters; 0 for the null pointer."""
        return dr.gather(mi.Float, self.emission, dr.reinterpret_array(mi.UInt32, emitter))

    @property
    def kind_of_kernels(self) -> tuple[object, ...]:
        """The properties for which kernels are compiled."""
        return self.kinds, self.guided and self.guided.layout

    @property
    def emit_probability(self) -> mi.Float:
        """The probabilities [N] by which light paths choose their light without a guide."""
        lane = dr.arange(mi.UInt32, self.count)
        before = dr.gather(mi.Float, self.emit_cdf, dr.maximum(lane, 1) - 1, lane > 0)
        return (self.emit_cdf - before) / dr.gather(mi.Float, self.emit_cdf, mi.UInt32(self.count - 1))

    def guide_with(self, guide: StartGuide, scene: mi.Scene) -> Lights:
        """The same lights of ``scene``, with light paths that start as ``guide`` says.

        Raises ValueError for a guide of another number of lights.
        """
        emitters = list(scene.emitters())
        ids = [registry_id(emitter) for emitter in emitters]
        return replace(self, guided=GuidedStarts.bind(guide, self.emit_probability, ids, rectangles(emitters)))

    def gain(
        self, emitter: mi.EmitterPtr, ds: mi.DirectionSample3f, n: mi.Vector3f, x: mi.Point3f, active: mi.Bool
    ) -> mi.Float:
        """The density of light paths from the point ``ds`` of a light to ``x``, over that of the default sampling.

        ``ds`` is seen from ``x``. ``n`` is the light's normal there on the side that shines, as light paths start about
        it: a sample's own, and of hits the shading normal, as vertex normals may be opposite to the faces' ``si.n``.
        """
        if self.guided is None:
            return mi.Float(1)
        light, d = self.guided.number_of(emitter), -ds.d
        u = mi.Point2f(0)
        if self.has(AREA):
            u = grid.map_area_to_square(n, d)
        if self.has(INFINITE) or self.has(DIRECTION):
            u = dr.select(self.is_at_infinity(light), grid.map_disk_to_square(d, (x - self.centre) / self.radius), u)
        if self.has(POSITION):
            axis, cutoff = dr.gather(mi.Vector3f, self.axis, light), dr.gather(mi.Float, self.cos_cutoff, light)
            u = dr.select(self.is_kind(light, POSITION), grid.map_cone_to_square(axis, cutoff, d), u)
        return self.guided.gain_at(light, u, ds.uv, active & (dr.reinterpret_array(mi.UInt32, emitter) != 0))


# ------------------------------------------------ Reading a scene ------------------------------------------------


def read_lights(scene: mi.Scene) -> Lights:
    """The scene's lights as they are now, by some small arrays and one small kernel, without host synchronisation."""
    emitters = list(scene.emitters())
    n = len(emitters)
    ids = [registry_id(emitter) for emitter in emitters]
    shapes = {registry_id(shape.emitter()): shape for shape in scene.shapes() if shape.is_emitter()}
    kinds = tuple(_kind(emitter, shapes.get(key)) for emitter, key in zip(emitters, ids, strict=True))
    parameters = [mi.traverse(emitter) for emitter in emitters]
    pointers = scene.emitters_dr()
    centre, radius = bounding_sphere(scene)
    kind = mi.UInt32(list(kinds))  # lists: Dr.Jit compiles again for each alignment of numpy's memory

    weights = [sampling_weight(emitter, params) for emitter, params in zip(emitters, parameters, strict=True)]
    for i, key in enumerate(ids):
        if kinds[i] == AREA and shapes[key].is_mesh():
            # Others are left to hits: Mitsuba samples them with wrong densities or normals, as these functions say
            has_densities = is_flat(shapes[key]) & (is_unfolded(shapes[key]) if is_textured(emitters[i]) else True)
            weights[i] = dr.select(has_densities, weights[i], 0)
        elif kinds[i] == AREA and shapes[key].class_name() == "Cylinder":
            weights[i] = dr.select(is_unmirrored(shapes[key]), weights[i], 0)
    weight = column(n, weights)
    weight = dr.select(kind == HIT_ONLY, 0, weight)
    selection = read_selection(pointers, ids, weight, bounding_box(scene)) if n > 1 else None
    emit_weight = dr.select(kind == EYE_ONLY, 0, weight if selection is None else selection.overall)
    emit_cdf = dr.cumsum(emit_weight) if n > 1 else emit_weight
    total = dr.gather(mi.Float, emit_cdf, mi.UInt32(n - 1))
    emit = dr.select(total > 0, emit_weight / total, 0)
    axis, cos_cutoff = cones(parameters, emitters)

    emission = emit / (dr.two_pi * (1 - cos_cutoff))  # ê of lights with a position; the other kinds replace theirs
    emission = dr.select((kind == INFINITE) | (kind == DIRECTION), emit / (dr.pi * dr.square(radius)), emission)
    if AREA in kinds:
        area = column(n, [shapes[key].surface_area() if kinds[i] == AREA else 0 for i, key in enumerate(ids)])
        emission = dr.select(kind == AREA, dr.select(area > 0, emit / (area * dr.pi), 0), emission)

    index = mi.UInt32(ids)
    alive, emission_by_id = dr.zeros(mi.Float, max(ids) + 1), dr.zeros(mi.Float, max(ids) + 1)
    dr.scatter(alive, dr.select(weight > 0, mi.Float(1), 0), index)
    dr.scatter(emission_by_id, emission, index)
    dr.eval(alive, emit_cdf, emission_by_id, kind, axis, cos_cutoff)
    spheres = Spheres.of([shapes.get(key) for key in ids])
    return Lights(
        pointers, n, kinds, kind, selection, alive, emit_cdf, emission_by_id, axis, cos_cutoff, centre, radius, spheres
    )


def _kind(emitter: mi.Emitter, shape: mi.Shape | None) -> int:
    """The kind of a light; ``shape`` is the shape that carries it, if any."""
    kind = _KIND_BY_CLASS.get(emitter.class_name(), EYE_ONLY)
    if kind != AREA:
        return kind
    if shape is None:
        return HIT_ONLY  # on an instanced shape: it can be hit, but has no place of its own to be sampled from
    if is_textured(emitter) and not (shape.is_mesh() or shape.class_name() == "Rectangle"):
        return HIT_ONLY  # Mitsuba's sampling of such a light does not know the surface's texture coordinates
    return AREA


# ------------------------------------- Next event estimation (y₀ from x) -------------------------------------


@dataclass(slots=True)
class DirectSample:
    """A light seen from a surface point."""

    d: mi.Vector3f  # unit direction to the light
    p: mi.Point3f  # the sampled point of a light with a position
    at_infinity: mi.Bool
    radiance_over_density: mi.Spectrum  # Le/p_NEE
    density: mi.Float  # p_NEE in solid angle with the selection; the selection alone for delta lights
    delta: mi.Bool  # no ray can hit this light
    ratio_over_cos: mi.Float  # e/(p_NEE·cos₀): the `ratio` of weights.next_event without its cos_x
    valid: mi.Bool


def sample_direct(lights: Lights, si: mi.SurfaceInteraction3f, rng: RandomNumbers, active: mi.Bool) -> DirectSample:
    """Choose a light and a point of it, as seen from ``si``."""
    if lights.selection is None:
        index = dr.zeros(mi.UInt32, dr.width(si))
        probability = dr.gather(mi.Float, lights.alive, dr.reinterpret_array(mi.UInt32, lights.pointers))
    else:
        index, probability = lights.selection.choose(si.p, rng.next_1d())
    emitter = dr.gather(mi.EmitterPtr, lights.pointers, index)
    ds, weight = emitter.sample_direction(si, rng.next_2d(), active)
    density = probability * ds.pdf
    valid = active & (density > 0) & (dr.max(weight) > 0)

    delta = lights.is_kind(index, POSITION) | lights.is_kind(index, DIRECTION) | ds.delta
    # c/cos₀ of the table above. A point light has 1/r² too, from solid angle to area at x: p_NEE of an area cancels it
    shape_factor = mi.Float(1)
    shape_factor = dr.select(lights.is_kind(index, INFINITE), ds.pdf, shape_factor)
    shape_factor = dr.select(lights.is_kind(index, POSITION), dr.rcp(dr.square(ds.dist)), shape_factor)
    ratio = lights.emission_factor(emitter) * shape_factor / density * lights.gain(emitter, ds, ds.n, si.p, valid)
    return DirectSample(
        d=ds.d,
        p=ds.p,
        at_infinity=lights.is_at_infinity(index),
        radiance_over_density=dr.select(valid, weight / probability, 0),
        density=density,
        delta=delta,
        ratio_over_cos=dr.select(valid, ratio, 0),
        valid=valid,
    )


def hit_densities(
    scene: mi.Scene,
    lights: Lights,
    emitter: mi.EmitterPtr,
    si: mi.SurfaceInteraction3f,
    origin: mi.Point3f,
    vertex: mi.Point3f,
    active: mi.Bool,
) -> tuple[mi.Float, mi.Float]:
    """(p_NEE in solid angle, e) of the light hit at ``si`` by a ray from ``origin``, which was spawned at ``vertex``.

    Next event estimation would have chosen the light at the vertex itself: the ray's origin may lie in another cell.
    """
    reference = dr.zeros(mi.Interaction3f)
    reference.p = origin
    ds = mi.DirectionSample3f(scene, si, reference)
    p_direction = emitter.pdf_direction(reference, ds, active)
    c = dr.select(si.is_valid(), dr.abs(dr.dot(si.n, ds.d)), p_direction)  # of the table above; |cos| has no side
    emission = lights.emission_factor(emitter) * c * lights.gain(emitter, ds, si.sh_frame.n, vertex, active)
    return lights.nee_probability(emitter, vertex) * p_direction, emission


# ------------------------------------------------ Emission (from y₀) ------------------------------------------------


@dataclass(slots=True)
class Emission:
    """The start of light paths: a ray, and what the weights at the first hit depend on at y₀."""

    ray: mi.Ray3f
    throughput: mi.Spectrum  # Le·cos₀/e
    emitter: mi.EmitterPtr
    factor: mi.Float  # ê, times the guide's gain
    p_direction: mi.Float  # p_ω of a light at infinity
    sample: mi.DirectionSample3f  # p, n, uv of y₀ on an area light
    is_area: mi.Bool
    at_infinity: mi.Bool  # INFINITE or DIRECTION
    delta: mi.Bool  # POSITION or DIRECTION
    valid: mi.Bool
    cell: mi.UInt32  # of the guide's table; 0 without a guide


def _choose_start(lights: Lights, rng: Sampler) -> LightIndex:
    """The lights that begin light paths, by inversion of the running sum: the smallest i with cdf(i) > u·cdf(N−1)."""
    if lights.count == 1:
        return dr.zeros(mi.UInt32, dr.width(rng.index))
    cdf, last = lights.emit_cdf, lights.count - 1
    target = rng.next_1d() * dr.gather(mi.Float, cdf, mi.UInt32(last))
    return dr.binary_search(0, last, lambda i: dr.gather(mi.Float, cdf, i) <= target)


def sample_emission(lights: Lights, rng: Sampler, path: mi.UInt32, paths: mi.UInt32) -> Emission:
    """Start the light paths of number ``path`` among ``paths`` [1]: neighbours in number set out in like directions."""
    n = dr.width(rng.index)
    if lights.guided is None:
        index, cell, gain = _choose_start(lights, rng), mi.UInt32(0), mi.Float(1)
        u_position, u_direction = rng.next_2d(), along_curve(path, paths, rng)
    else:
        drawn = lights.guided.draw(path, paths, rng)
        index, cell, gain = drawn.light, drawn.cell, drawn.gain
        far = lights.is_at_infinity(index)  # there the guided square is the disk, a position (see `guiding.grid`)
        u_position = dr.select(far, drawn.direction, drawn.position)
        u_direction = dr.select(far, drawn.position, drawn.direction)
    emitter = dr.gather(mi.EmitterPtr, lights.pointers, index)
    factor = lights.emission_factor(emitter) * gain
    out = Emission(
        ray=dr.zeros(mi.Ray3f, n),
        throughput=mi.Spectrum(0),
        emitter=emitter,
        factor=factor,
        p_direction=mi.Float(1),
        sample=dr.zeros(mi.DirectionSample3f, n),
        is_area=lights.is_kind(index, AREA),
        at_infinity=lights.is_at_infinity(index),
        delta=lights.is_kind(index, POSITION) | lights.is_kind(index, DIRECTION),
        valid=factor > 0,
        cell=cell,
    )
    if lights.has(AREA):
        _start_on_area(out, lights, index, u_position, u_direction, out.valid & out.is_area)
    if lights.has(INFINITE) or lights.has(DIRECTION):
        _start_at_infinity(out, lights, u_position, u_direction, out.valid & out.at_infinity)
    if lights.has(POSITION):
        _start_at_point(out, lights, index, u_direction, out.valid & lights.is_kind(index, POSITION))
    out.throughput = dr.select(out.valid, out.throughput / factor, 0)
    out.valid &= dr.max(out.throughput) > 0
    return out


def _start_on_area(
    out: Emission, lights: Lights, index: LightIndex, u_position: mi.Point2f, u_direction: mi.Point2f, mask: mi.Bool
) -> None:
    ps = out.emitter.get_shape().sample_position(mi.Float(0), u_position, mask)
    if lights.spheres is not None:
        ps.n = lights.spheres.normal(index, ps)  # of samples of positions alone: others and hits have right normals
    si = mi.SurfaceInteraction3f(ps, dr.zeros(mi.Color0f))
    if lights.guided is not None:
        si.sh_frame = grid.frame_about(ps.n)
    si.wi = mi.warp.square_to_cosine_hemisphere(u_direction)
    out.throughput[mask] = out.emitter.eval(si, mask)
    out.ray = dr.select(mask, si.spawn_ray(si.to_world(si.wi)), out.ray)
    out.sample = mi.DirectionSample3f(ps)


def _start_at_infinity(
    out: Emission, lights: Lights, u_position: mi.Point2f, u_direction: mi.Point2f, mask: mi.Bool
) -> None:
    reference = dr.zeros(mi.Interaction3f)
    reference.p = lights.centre
    ds, weight = out.emitter.sample_direction(reference, u_direction, mask)
    disk = mi.warp.square_to_uniform_disk_concentric(u_position)
    frame = mi.Frame3f(ds.d) if lights.guided is None else grid.frame_about(ds.d)
    offset = frame.to_world(mi.Vector3f(disk.x, disk.y, 1))
    ray = mi.Ray3f(lights.centre + lights.radius * offset, -ds.d)
    out.throughput[mask] = weight
    out.ray = dr.select(mask, ray, out.ray)
    out.p_direction[mask] = ds.pdf


def _start_at_point(out: Emission, lights: Lights, index: LightIndex, u: mi.Point2f, mask: mi.Bool) -> None:
    axis, cos_cutoff = dr.gather(mi.Vector3f, lights.axis, index), dr.gather(mi.Float, lights.cos_cutoff, index)
    cos_theta = 1 - u.x * (1 - cos_cutoff)
    sin_theta = dr.safe_sqrt(1 - dr.square(cos_theta))
    sin_phi, cos_phi = dr.sincos(dr.two_pi * u.y)
    d = mi.Frame3f(axis).to_world(mi.Vector3f(sin_theta * cos_phi, sin_theta * sin_phi, cos_theta))
    reference = dr.zeros(mi.Interaction3f)
    reference.p = lights.centre
    position = out.emitter.sample_direction(reference, mi.Point2f(0.5), mask)[0].p
    # The light's intensity along d is what this point receives, times r²
    reference.p = dr.fma(d, lights.radius, position)
    ds, weight = out.emitter.sample_direction(reference, mi.Point2f(0.5), mask)
    out.throughput[mask] = weight * dr.square(ds.dist)
    out.ray = dr.select(mask, mi.Ray3f(position, d), out.ray)
