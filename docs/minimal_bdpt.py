"""Bidirectional path tracing in its shortest form: to be read before photonfarm's `bdpt`, and not to be used for it.

Eye paths and light paths of surface vertices are walked, each vertex of one is joined with each of the other, and every
path that comes of it is weighted by the balance heuristic over all ways in which it could have been found (Veach 1997,
chapters 8 and 10). What is left out: delta and two-sided materials, environments, paths that end on the camera's lens
(light tracing), and all that makes it fast. The lights are area lights.

A path has the surface vertices y[0] (on a light), y[1], …, y[m] (what the camera sees). With s of them found from the
light, its density is p[s] = L[0] ⋯ L[s−1] · E[s] ⋯ E[m−1], where L[j] is the density per area with which y[j] is found
from the light's side, and E[j] from the camera's. y[m] is always found by the camera, whose density cancels.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

CONTEXT = mi.BSDFContext()


@dataclass
class Vertex:
    """A vertex of a walk: where it is, and what the walk has gathered on its way there over its density."""

    si: mi.SurfaceInteraction3f
    throughput: mi.Color3f  # of light paths: with the emitted radiance
    valid: mi.Bool

    def towards(self, other: Vertex) -> mi.Vector3f:
        """The direction to another vertex, unit, world."""
        return dr.normalize(other.si.p - self.si.p)

    def cosine(self, direction: mi.Vector3f) -> mi.Float:
        """|cos| between the surface and a direction."""
        return dr.abs(dr.dot(self.si.n, direction))

    def scattered(self, origin: mi.Vector3f, out: mi.Vector3f) -> tuple[mi.Color3f, mi.Float]:
        """BSDF and its density per solid angle, for light that is followed from one direction on into another.

        Both directions point away from the surface. Mitsuba's value holds the cosine of `out`, which is divided out.
        """
        si = mi.SurfaceInteraction3f(self.si)
        si.wi = si.to_local(origin)
        value, density = self.si.bsdf().eval_pdf(CONTEXT, si, si.to_local(out))
        return value / dr.maximum(self.cosine(out), 1e-9), density

    def emitted(self, out: mi.Vector3f) -> mi.Color3f:
        """Radiance that leaves towards a direction."""
        si = mi.SurfaceInteraction3f(self.si)
        si.wi = si.to_local(out)
        return dr.select(self.si.shape.is_emitter(), si.shape.emitter().eval(si), 0)


def walk(
    scene: mi.Scene, sampler: mi.Sampler, ray: mi.Ray3f, throughput: mi.Color3f, valid: mi.Bool, count: int
) -> list[Vertex]:
    """Trace at most `count` vertices along a ray that goes on by sampling each BSDF."""
    vertices = []
    for _ in range(count):
        si = scene.ray_intersect(ray, valid)
        valid &= si.is_valid()
        vertices.append(Vertex(si, mi.Color3f(throughput), mi.Bool(valid)))
        sample, value = si.bsdf().sample(CONTEXT, si, sampler.next_1d(valid), sampler.next_2d(valid), valid)
        throughput = throughput * value  # the BSDF times the cosine, over the density
        valid &= dr.any(throughput > 0)
        ray = si.spawn_ray(si.to_world(sample.wo))
    return vertices


def light_walk(scene: mi.Scene, sampler: mi.Sampler, count: int) -> list[Vertex]:
    """Trace at most `count` vertices, the first on a light: lights alike, points by area, directions by the cosine."""
    index = mi.UInt32(sampler.next_1d() * len(scene.emitters()))
    shape = dr.gather(mi.ShapePtr, mi.ShapePtr([light.get_shape() for light in scene.emitters()]), index)
    position = shape.sample_position(0, sampler.next_2d())
    si = mi.SurfaceInteraction3f(position, dr.zeros(mi.Color0f))
    si.shape, si.t = shape, 0
    si.initialize_sh_frame()
    local = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
    si.wi = local
    first = Vertex(si, mi.Color3f(len(scene.emitters()) / position.pdf), mi.Bool(True))
    radiance = first.emitted(si.to_world(local)) * dr.pi  # the cosine over its density cos / π
    ray = si.spawn_ray(si.to_world(local))
    return [first, *walk(scene, sampler, ray, first.throughput * radiance, dr.any(radiance > 0), count - 1)]


def area(density: mi.Float, at: Vertex, to: Vertex) -> mi.Float:
    """A density per solid angle at one vertex as the density per area at another."""
    apart = to.si.p - at.si.p
    return density * to.cosine(dr.normalize(apart)) / dr.squared_norm(apart)


def weight(path: list[Vertex], camera: mi.Point3f, lights: int, s: int) -> mi.Float:
    """The balance heuristic of a path that was found with `s` of its vertices from the light: p[s] / Σ p[i]."""
    m = len(path) - 1
    from_light, from_eye = [1 / (lights * path[0].si.shape.surface_area())], []
    for j in range(1, m):
        before, at, to = path[j - 2], path[j - 1], path[j]
        out = at.towards(to)
        density = at.cosine(out) / dr.pi if j == 1 else at.scattered(at.towards(before), out)[1]
        from_light.append(area(density, at, to))
    for j in range(m):
        at, to = path[j + 1], path[j]
        origin = dr.normalize(camera - at.si.p) if j + 1 == m else at.towards(path[j + 2])
        from_eye.append(area(at.scattered(origin, at.towards(to))[1], at, to))
    densities = [dr.prod(from_light[:i]) * dr.prod(from_eye[i:]) for i in range(m + 1)]
    return densities[s] / dr.maximum(sum(densities), 1e-30)


def render(scene: mi.Scene, max_depth: int, spp: int, seed: int = 0) -> mi.TensorXf:
    """The image (H, W, 3), linear RGB, of all paths with at most `max_depth` edges."""
    sensor = scene.sensors()[0]
    width, height = sensor.film().crop_size()
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, width * height * spp)
    pixel = dr.arange(mi.UInt32, width * height * spp) // spp
    place = mi.Point2f(pixel % width, pixel // width) + sampler.next_2d()
    ray, _ = sensor.sample_ray(0, 0, place / mi.ScalarPoint2f(width, height), mi.Point2f(0.5))
    eye = walk(scene, sampler, ray, mi.Color3f(1), mi.Bool(True), max_depth)
    light = light_walk(scene, sampler, max_depth - 1)
    lights, found = len(scene.emitters()), mi.Color3f(0)
    for t in range(1, max_depth + 1):
        end = eye[t - 1]
        origin = dr.normalize((ray.o if t == 1 else eye[t - 2].si.p) - end.si.p)
        for s in range(max_depth - t + 1):
            path = [*light[:s], *reversed(eye[:t])]
            if s == 0:
                value, valid = end.throughput * end.emitted(origin), end.valid & end.si.shape.is_emitter()
            else:
                start = light[s - 1]
                between = end.towards(start)
                valid = end.valid & start.valid
                valid &= ~scene.ray_test(end.si.spawn_ray_to(start.si.p), valid)
                if s == 1:
                    leaving = start.emitted(-between)
                else:
                    leaving = start.scattered(start.towards(light[s - 2]), -between)[0]
                geometry = end.cosine(between) * start.cosine(between) / dr.squared_norm(end.si.p - start.si.p)
                value = start.throughput * leaving * geometry * end.scattered(origin, between)[0] * end.throughput
            share = 1 if len(path) == 1 else weight(path, ray.o, lights, s)
            found += dr.select(valid, value * share, 0)
    image = dr.zeros(mi.Float, width * height * 3)
    for channel in range(3):
        dr.scatter_reduce(dr.ReduceOp.Add, image, found[channel] / spp, pixel * 3 + channel)
    return mi.TensorXf(image, (height, width, 3))
