"""What is known of a view before anything is learned: emission, direct light, gloss, and what mirrors and glass show.

All are means over a regular grid of rays in each pixel, as albedo is. A ray that meets a surface of delta lobes alone
(a mirror, smooth glass, a null surface) is *followed* along the lobe that takes more than half of the light, to the
first surface that scatters otherwise. What is emitted on the way counts as seen.

**Direct light** is what lights send straight to that surface and its diffuse part reflects: one sum over shadow rays,
with lights chosen as the integrator chooses them. Its points are one low-discrepancy set in each pixel, shifted by a
random vector of the pixel's own (Cranley and Patterson 1976), so that it is unbiased and independent of every sample's
radiance. All else is the same whatever the seed.

**Gloss** is the reflection of the same light by all other lobes. Lobes may be narrow, and so the shadow rays are joined
by one ray along a sample of the BSDF, weighted by the balance heuristic [Veach and Guibas 1995]. It is the whole less
the diffuse part, of which a coat may take some: so it may be below 0.

**Point light** is the irradiance of the cloud's first points by the same light, by 16 shadow rays each.

**Specular** is the directional albedo of the whole BSDF, by its own sampling at fixed points, less the diffuse
reflectance. **Roughness** is α of the microfacet distribution as the material states it, the mean of a texture.

Shape letters: H W image, L lit points, N rays: pixel by pixel, and within a pixel row by row of its grid.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.arrays import floats, points, rows
from photonfarm.renderer.bdpt.emission import Lights, hit_densities, read_lights, sample_direct
from photonfarm.renderer.bdpt.loops import traced_once
from photonfarm.renderer.gbuffer import GRID, RAYS, diffuse_reflectance
from photonfarm.renderer.materials import Materials, has_other_lobes, is_pure_delta
from photonfarm.shared.keys import Key, Stream
from photonfarm.shared.records import F32, Guides
from photonfarm.shared.scene import GuideSpec, SceneSpec
from photonfarm.shared.view import Camera, View

if TYPE_CHECKING:
    from photonfarm.renderer.bdpt.recording import Recorder

SUB_PIXELS = GRID * GRID

FOLLOWED = 8
"""Mirrors and panes of glass that are followed at most."""

NO_LIMIT = 1 << 20
"""Edges of a path where the spec sets no limit."""

BSDF_SAMPLES = 2
"""Of each ray, for the directional albedo."""

PURPOSE = "direct"
"""Of the seed of direct light, which follows from the view's key."""


def view_guides(
    scene: Any, view: View, spec: SceneSpec, wanted: GuideSpec, key: Key, materials: Materials, arrives: F32,
    recorder: Recorder | None = None,
) -> Guides:  # fmt: skip
    """The guides of a view in the scene's present configuration; `key` is the view's.

    `arrives` is what `point_light` gives. With a `recorder` of `trace` Python runs but once for all views.
    """
    camera, spec = Camera.of(view, spec), spec.model_copy(update={"guides": wanted})
    pixels = camera.height * camera.width
    directions = _grid(camera)
    shifts = Stream(key, PURPOSE).uniform(pixels, 3).astype(np.float32)
    at_once = max(1, RAYS // SUB_PIXELS)  # pixels
    blocks = [slice(start, start + at_once) for start in range(0, pixels, at_once)]
    parts = [_traced(scene, camera, spec, (directions[block], shifts[block]), materials, recorder) for block in blocks]
    found = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return _guides(found, camera, arrives)


def _grid(camera: Camera) -> F32:
    """Unit directions through the grid of each pixel, (H·W, 16, 3)."""
    steps = (np.arange(GRID) + 0.5) / GRID
    within = [camera.rays(u, v).reshape(-1, 3) for v in steps for u in steps]
    return np.stack(within, axis=1)


def _traced(
    scene: Any, camera: Camera, spec: SceneSpec, given: tuple[F32, F32], materials: Materials, recorder: Recorder | None
) -> dict[str, NDArray[np.float64]]:
    """Sums over the grids of some pixels, (pixels, channels), by name; see `trace`."""
    directions, shifts = given[0].reshape(-1, 3), np.repeat(given[1], SUB_PIXELS, axis=0)
    along = directions.astype(np.float64) @ camera.forward  # cosine to the forward axis
    near, far = spec.view.near / along, spec.view.far / along
    rays = points(camera.origin + directions * near[:, None]), mi.Vector3f(points(directions)), floats(far - near)
    lights = read_lights(scene) if scene.emitters() else None
    settings = Settings(
        spec.guides.light_samples if lights is not None else 0,
        FOLLOWED if materials.has_pure_deltas else 0,
        spec.transport.max_depth if spec.transport.max_depth >= 0 else NO_LIMIT,
        spec.view.near,
        materials.has_other_lobes,
    )
    tables = floats(materials.roughness), *(floats(column) for column in _pattern(settings.light_samples).T)
    arguments = lights, tables, *rays, floats(along), points(shifts), settings
    kind = (len(along), settings, lights.kinds if lights else None)
    columns = recorder(kind, scene, None, *arguments) if recorder else trace(scene, None, *arguments)
    return {name: _rows(column).reshape(len(given[0]), SUB_PIXELS, -1).sum(1) for name, column in columns.items()}


def _rows(column: Any) -> NDArray[np.float64]:
    found = np.array(column, np.float64)
    return found.T if found.ndim > 1 else found


def _guides(sums: dict[str, NDArray[np.float64]], camera: Camera, arrives: F32) -> Guides:
    """The guides of the sums over each pixel's rays."""

    def image(values: NDArray[np.float64]) -> F32:
        shaped = values.reshape(camera.height, camera.width, -1).astype(np.float32)
        return shaped[..., 0] if shaped.shape[-1] == 1 else shaped

    def of_those(name: str, count: str) -> F32:
        return image(sums[name] / np.maximum(sums[count], 1))

    mean = {name: values / SUB_PIXELS for name, values in sums.items()}
    return Guides(
        emission=image(mean["emission"]),
        direct=image(mean["direct"]),
        gloss=image(mean["gloss"]),
        specular=image(np.maximum(mean["specular"], 0)),
        roughness=image(mean["roughness"]),
        mean_depth=of_those("depth", "hits"),
        mean_normal=image(mean["normal"]),
        throughput=image(mean["throughput"]),
        beyond_albedo=of_those("beyond_albedo", "beyond"),
        beyond_normal=of_those("beyond_normal", "beyond"),
        beyond_depth=of_those("beyond_depth", "beyond"),
        point_light=arrives,
    )


def point_light(
    scene: Any, position: F32, normal: F32, key: Key, wanted: GuideSpec, recorder: Recorder | None = None
) -> F32:
    """Irradiance (L, 3) of points on the side of their normals by what lights send directly; 0 without light samples.

    By one shadow ray for each of 16 points of the pattern, shifted by a random vector of each point's own. With a
    `recorder` of `irradiance` Python runs but once.
    """
    if not wanted.light_samples or not scene.emitters():
        return np.zeros_like(position)
    lights, pattern = read_lights(scene), _pattern(0)
    u = (Stream(key, "point light").uniform(len(position), 1, 3) + pattern) % 1
    at, facing = (np.repeat(each, SUB_PIXELS, axis=0) for each in (position, normal))
    arguments = lights, points(at), points(facing), [floats(column) for column in u.reshape(-1, 3).T]
    traced = functools.partial(recorder, (len(at), lights.kinds)) if recorder else irradiance
    found = traced(scene, None, *arguments)
    mean: F32 = rows(found, len(position), SUB_PIXELS).mean(axis=1, dtype=np.float64).astype(np.float32)
    return mean


def irradiance(scene: Any, _: Any, lights: Lights, position: Any, normal: Any, u: list[Any]) -> Any:
    """What one sample of the lights brings to each point, on the side of its normal (Color3f)."""
    count = dr.width(position)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.p, si.n, si.t = position, mi.Normal3f(normal), dr.ones(mi.Float, count)
    si.sh_frame = mi.Frame3f(si.n)
    light = sample_direct(lights, si, _Points(u), dr.full(mi.Bool, True, count))
    cosine = dr.dot(si.n, light.d)
    shadow = dr.select(light.at_infinity, si.spawn_ray(light.d), si.spawn_ray_to(light.p))
    lit = light.valid & (cosine > 0)
    lit &= ~scene.ray_test(shadow, lit)
    found = dr.select(lit, light.radiance_over_density * cosine, 0)
    dr.eval(found)
    return found


# ------------------------------------------------------------------------------------------------------------- tracing


@dataclass(frozen=True, slots=True)
class Settings:
    """The numbers that a kernel is made for."""

    light_samples: int  # of each ray
    followed: int  # mirrors and panes at most
    max_depth: int  # edges of a path of the images
    near: float  # distance of the near plane
    glossy: bool  # whether any surface has lobes that are neither diffuse nor followed


@dataclass(slots=True)
class _Path:
    """Loop variables of a path through mirrors and glass."""

    active: Any  # Bool: the ray has not been traced yet
    ray: Any  # Ray3f
    throughput: Any  # Color3f
    emission: Any  # Color3f: of all that was met
    length: Any  # Float: from the eye to the ray's origin
    followed: Any  # UInt32: surfaces left behind


@dataclass(slots=True)
class _Sum:
    """Loop variables of the sums over light samples."""

    index: Any  # UInt32
    diffuse: Any  # Color3f
    whole: Any  # Color3f


@dataclass(slots=True)
class _Arrives:
    """Reflected direct light."""

    diffuse: Any  # Color3f: by a white diffuse surface
    whole: Any  # Color3f: by the surface as it is

    def __add__(self, more: _Arrives) -> _Arrives:
        return _Arrives(self.diffuse + more.diffuse, self.whole + more.whole)


@dataclass(frozen=True, slots=True)
class _Surface:
    """Where direct light is asked for."""

    scene: Any
    lights: Lights
    si: Any  # SurfaceInteraction3f
    normal: Any  # Normal3f: turned to where the ray comes from
    direction: Any  # Vector3f: of that ray
    diffuse: Any  # Bool: its diffuse lobe reflects
    other: Any  # Bool: it has other lobes
    settings: Settings


def trace(
    scene: Any, _: Any, lights: Lights | None, tables: Any, o: Any, d: Any, reach: Any, along: Any, shift: Any,
    settings: Settings,
) -> dict[str, Any]:  # fmt: skip
    """What `_guides` makes means of, by name, of each ray; zeros where there is nothing.

    `tables` are the roughness of BSDFs and three columns of points; rays begin on the near plane, whose distance from
    the eye is `settings.near` / `along`.
    """
    roughness, *pattern = tables
    ray = mi.Ray3f(o=o, d=d, maxt=reach, time=0, wavelengths=[])
    first = scene.ray_intersect(ray)
    hit, bsdf, before = first.is_valid(), first.bsdf(), settings.near / along
    path = _followed(scene, ray, before, settings)
    last = scene.ray_intersect(path.ray)
    met, is_beyond = last.is_valid(), hit & (path.followed > 0)
    albedo = diffuse_reflectance(last, met)
    arrives = _lit(scene, lights, last, path, pattern, shift, settings, met)
    found = {
        "hits": dr.select(hit, mi.Float(1), 0),
        "depth": dr.select(hit, settings.near + first.t * along, 0),
        "normal": dr.select(hit, _turned(first.sh_frame.n, d), 0),
        "specular": _specular(bsdf, first, hit),
        "roughness": dr.gather(mi.Float, roughness, dr.reinterpret_array(mi.UInt32, bsdf), hit),
        "emission": path.emission,
        "direct": path.throughput * albedo * arrives.diffuse,
        "gloss": path.throughput * (arrives.whole - albedo * arrives.diffuse),
        "throughput": dr.select(is_beyond, path.throughput, 0),
        "beyond": dr.select(is_beyond & met, mi.Float(1), 0),
        "beyond_albedo": dr.select(is_beyond & met, albedo, 0),
        "beyond_normal": dr.select(is_beyond & met, _turned(last.sh_frame.n, path.ray.d), 0),
        "beyond_depth": dr.select(is_beyond & met, path.length + last.t, 0),
    }
    dr.eval(found)
    return found


def _turned(normal: Any, direction: Any) -> Any:
    """The normal on the side that a ray along `direction` comes from."""
    return dr.select(dr.dot(normal, direction) > 0, -normal, normal)


def _followed(scene: Any, ray: Any, before: Any, settings: Settings) -> _Path:
    """The path of each ray up to the one that meets the first surface which is no pure mirror, glass or null."""
    active = dr.full(mi.Bool, True, dr.width(ray))
    start = _Path(active, mi.Ray3f(ray), mi.Color3f(1), mi.Color3f(0), mi.Float(before), mi.UInt32(0))
    (path,) = traced_once(
        state=(start,),
        cond=lambda s: s.active,
        body=lambda s: (_follow(scene, s, settings),),
        labels=("path",),
        label="mirrors and glass",
    )
    return path


def _follow(scene: Any, s: _Path, settings: Settings) -> _Path:
    """One surface on the way: what it emits, and the ray that leaves it if it has delta lobes alone.

    Sampled at 1/2, glass gives the lobe that takes more than half, with its probability, which is what it takes.
    """
    si = scene.ray_intersect(s.ray, active=s.active)
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


def _specular(bsdf: Any, si: Any, hit: Any) -> Any:
    """Directional albedo less diffuse reflectance, where the BSDF has more than a diffuse lobe; may be below 0.

    That of the light's power: radiance in glass is larger by the square of the refractive index.
    """
    flags, context = bsdf.flags(), mi.BSDFContext(mi.TransportMode.Importance)
    other = mi.has_flag(flags, mi.BSDFFlags.Delta) | mi.has_flag(flags, mi.BSDFFlags.Glossy)
    sampled = hit & other
    total = mi.Color3f(0)
    within = dr.arange(mi.UInt32, dr.width(hit)) % SUB_PIXELS
    for sample in range(BSDF_SAMPLES):
        u = [dr.fma(mi.Float(within * BSDF_SAMPLES + sample), step, 0.5) for step in STEPS]
        u = [x - dr.floor(x) for x in u]
        _, weight = bsdf.sample(context, si, u[0], mi.Point2f(u[1], u[2]), sampled)
        total += dr.select(sampled, weight, 0)
    return total / BSDF_SAMPLES - dr.select(sampled, diffuse_reflectance(si, sampled), 0)


def _lit(
    scene: Any, lights: Lights | None, si: Any, path: _Path, pattern: Any, shift: Any, settings: Settings, met: Any
) -> _Arrives:
    """What lights send straight to a surface and it reflects: as a white diffuse one, and by all of its lobes."""
    nothing = _Arrives(mi.Color3f(0), mi.Color3f(0))
    if lights is None or not settings.light_samples:
        return nothing
    flags = si.bsdf().flags()
    reached = met & (path.followed + 2 <= settings.max_depth)
    two_sided = mi.has_flag(flags, mi.BSDFFlags.BackSide)
    diffuse = reached & (two_sided | (mi.Frame3f.cos_theta(si.wi) > 0))
    diffuse &= mi.has_flag(flags, mi.BSDFFlags.DiffuseReflection)
    other = reached & has_other_lobes(flags) & settings.glossy
    at = _Surface(scene, lights, si, _turned(si.sh_frame.n, path.ray.d), path.ray.d, diffuse, other, settings)
    return _by_lights(at, pattern, shift) + (_by_bsdf(at, pattern, shift) if settings.glossy else nothing)


def _by_lights(at: _Surface, pattern: Any, shift: Any) -> _Arrives:
    """The mean over shadow rays to points of lights; of other lobes the share that the balance heuristic leaves."""
    count = at.settings.light_samples
    context, bsdf, si = mi.BSDFContext(), at.si.bsdf(), at.si

    def body(s: _Sum) -> tuple[_Sum]:
        light = sample_direct(at.lights, si, _Points(_shifted(pattern, shift, s.index)), at.diffuse | at.other)
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
    (sums,) = traced_once(
        state=(start,), cond=lambda s: s.index < count, body=body, labels=("sum",), label="shadow rays"
    )
    diffuse = sums.diffuse / count
    of_diffuse = dr.select(at.other, 0, diffuse_reflectance(si, at.diffuse) * diffuse)
    return _Arrives(diffuse, sums.whole / count + of_diffuse)


def _by_bsdf(at: _Surface, pattern: Any, shift: Any) -> _Arrives:
    """What one ray along a sample of the BSDF meets of lights, with the share that shadow rays leave of it."""
    u = _shifted(pattern, shift, mi.UInt32(at.settings.light_samples))
    bs, weight = at.si.bsdf().sample(mi.BSDFContext(), at.si, u[0], mi.Point2f(u[1], u[2]), at.other)
    ray = at.si.spawn_ray(at.si.to_world(bs.wo))
    found = at.scene.ray_intersect(ray, active=at.other)
    emitter = found.emitter(at.scene, at.other)
    by_light, _ = hit_densities(at.scene, at.lights, emitter, found, ray.o, at.si.p, at.other)
    is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    share = dr.select(is_delta, 1, bs.pdf / (bs.pdf + at.settings.light_samples * by_light))
    emitted = emitter.eval(found, at.other)
    return _Arrives(mi.Color3f(0), dr.select(at.other & (dr.max(emitted) > 0), weight * emitted * share, 0))


def _shifted(pattern: Any, shift: Any, sample: Any) -> list[Any]:
    """The three numbers of a sample of each ray."""
    within = dr.arange(mi.UInt32, dr.width(shift)) % SUB_PIXELS
    place = sample * SUB_PIXELS + within
    u = [dr.gather(mi.Float, column, place) + x for column, x in zip(pattern, shift, strict=True)]
    return [x - dr.floor(x) for x in u]


class _Points:
    """Three numbers in the place of the integrator's sampler: one to choose a light, two for a point of it."""

    def __init__(self, u: list[Any]) -> None:
        self._u = u

    def next_1d(self) -> Any:
        """The first."""
        return self._u[0]

    def next_2d(self) -> Any:
        """The other two."""
        return mi.Point2f(self._u[1], self._u[2])


STEPS = (0.8191725133961645, 0.6710436067037893, 0.5497004779019703)
"""Of the additive recurrence R₃, n · steps modulo 1: the powers of 1 / 1.2207…, the root of x⁴ = x + 1 [Roberts, The
unreasonable effectiveness of quasirandom sequences, 2018]."""


def _pattern(light_samples: int) -> F32:
    """The points of a pixel's samples before they are shifted: of each light sample, then of the BSDF, (…, 3)."""
    number = np.arange((light_samples + 1) * SUB_PIXELS)[:, None]
    return (number * np.array(STEPS) % 1).astype(np.float32)
