"""The guides of a view: means over the rays of each pixel, which are followed through mirrors and glass.

The share of light that a surface reflects or transmits by lobes other than the diffuse one is evaluated by these lobes
alone, through the context's `type_mask`. Subtracting the diffuse reflectance from the total would not work: the coat of
a plastic leaves its base less light, so the difference is too small, and often below 0.

Shape letters: H W image.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi

from photonfarm.core.keys import Key
from photonfarm.core.records import F32, Guides
from photonfarm.renderer.bdpt.lights.emission import Lights, read_lights
from photonfarm.renderer.bdpt.recording import call_recorded, loop_once
from photonfarm.renderer.scene.arrays import floats
from photonfarm.renderer.scene.gbuffer import diffuse_reflectance, seen_reflectance
from photonfarm.renderer.scene.guides.direct import (
    FOLLOWED,
    NO_LIMIT,
    STEPS,
    GuideSettings,
    direct_light,
    pattern_of,
    point_light,
    shift_pattern,
    shifts_of,
    turn_towards,
)
from photonfarm.renderer.scene.materials import Materials, is_pure_delta
from photonfarm.renderer.scene.view_rays import (
    Columns,
    PixelRay,
    Take,
    ViewCameras,
    interleave,
    shape_images,
    sum_over_grid,
    take_numpy,
)
from photonfarm.scene.spec import RAYS_PER_PIXEL, GuideSpec, SceneSpec

if TYPE_CHECKING:
    from photonfarm.renderer.bdpt.recording import Recorders


CHANNELS = {
    "albedo": 3,
    "emission": 3,
    "direct": 3,
    "gloss": 3,
    "specular": 3,
    "mean_normal": 3,
    "throughput": 3,
    "beyond_albedo": 3,
    "beyond_normal": 3,
    "roughness": 1,
    "mean_depth": 1,
    "beyond_depth": 1,
}
"""The images that are made of each pixel's rays, and their channels."""

COUNTS = {"hits": 1, "beyond": 1}
"""The rays of a pixel that meet a surface, and those that meet one beyond a mirror or glass."""

DIVISORS = {"mean_depth": "hits"} | dict.fromkeys(("beyond_albedo", "beyond_normal", "beyond_depth"), "beyond")
"""The images that are means over the rays of `COUNTS`; all others are means over all rays."""


def view_guides(
    scene: Any,
    cameras: ViewCameras,
    spec: SceneSpec,
    wanted: GuideSpec,
    keys: Sequence[Key],
    materials: Materials,
    lit: tuple[F32, F32],
    recorders: Recorders | None = None,
    take: Take = take_numpy,
) -> list[tuple[F32, Guides]]:
    """The mean albedo (H, W, 3), of the same rays, and the guides of each view in the scene's present configuration.

    `keys` are the views'. `lit` are positions and normals (L, 3) of the points whose irradiance is required. With
    `recorders` Python runs only once.
    """
    lights = read_lights(scene) if scene.emitters() else None
    settings = GuideSettings(
        wanted.light_samples if lights is not None else 0,
        FOLLOWED if materials.has_pure_deltas else 0,
        spec.transport.max_depth if spec.transport.max_depth >= 0 else NO_LIMIT,
        materials.has_other_lobes,
        wanted.lights_in_glass and materials.has_pure_deltas,
    )
    of_bsdfs = floats(materials.roughness), floats(materials.diffuse_kept)
    pattern = floats(pattern_of(settings.light_samples))
    shifts = shifts_of(keys, "direct", cameras.height * cameras.width)
    arrives = point_light(scene, lights, *lit, keys, wanted, recorders)
    kind = cameras.kind, settings, lights.kinds if lights else None
    arrays = call_recorded(recorders, trace, kind, scene, None, cameras, lights, of_bsdfs, pattern, shifts, settings)
    images = shape_images(arrays, CHANNELS, cameras, take)
    return [(image.pop("albedo"), Guides(**image, point_light=at)) for image, at in zip(images, arrives, strict=True)]


# -------------------------------------------------------------------------------------------- through mirrors and glass


def trace(
    scene: Any,
    _: Any,
    cameras: ViewCameras,
    lights: Lights | None,
    of_bsdfs: tuple[Any, Any],
    pattern: Any,
    shifts: Any,
    settings: GuideSettings,
) -> Columns:
    """The images of `CHANNELS`, interleaved; zeros where there is nothing.

    `of_bsdfs` are their roughness and their `diffuse_kept`; `pattern` and its `shifts` are those of direct light.
    """
    shift = dr.gather(mi.Vector3f, shifts, dr.arange(mi.UInt32, cameras.lanes))

    def columns_of(ray: PixelRay, number: Any) -> Columns:
        def random(sample: Any) -> Any:
            return shift_pattern(pattern, shift, sample * RAYS_PER_PIXEL + number)

        return _trace_rays(scene, ray, number, lights, of_bsdfs, random, settings)

    sums = sum_over_grid(cameras, CHANNELS | COUNTS, columns_of)
    counts = {name: dr.maximum(sums[of], 1) for name, of in DIVISORS.items()}
    means = {name: sums[name] / counts.get(name, mi.Float(RAYS_PER_PIXEL)) for name in CHANNELS}
    means["specular"] = dr.maximum(means["specular"], 0)
    return interleave(means, CHANNELS, cameras.lanes)


def _trace_rays(
    scene: Any,
    ray: PixelRay,
    number: Any,
    lights: Lights | None,
    of_bsdfs: Any,
    random: Callable[[Any], Any],
    settings: GuideSettings,
) -> Columns:
    """What is summed, by name, for one ray of each pixel, which has this `number` in the pixel."""
    first = scene.ray_intersect(ray.ray)
    hit, bsdf = first.is_valid(), first.bsdf()
    roughness, diffuse_kept = (
        dr.gather(mi.Float, column, dr.reinterpret_array(mi.UInt32, bsdf), hit) for column in of_bsdfs
    )
    path, last = _follow_to_end(scene, ray, first, settings)
    met, is_beyond = last.is_valid(), hit & (path.followed > 0)
    albedo = seen_reflectance(last, met)
    reached = met & (path.followed + 2 <= settings.max_depth)
    diffuse, whole = direct_light(scene, lights, last, path.ray.d, reached, random, settings)
    return {
        "hits": dr.select(hit, mi.Float(1), 0),
        "albedo": seen_reflectance(first, hit),
        "mean_depth": dr.select(hit, ray.depth(first.t), 0),
        "mean_normal": dr.select(hit, turn_towards(first.sh_frame.n, ray.ray.d), 0),
        "specular": specular_of(bsdf, first, hit, diffuse_kept, number),
        "roughness": roughness,
        "emission": path.emission,
        "direct": path.throughput * albedo * diffuse,
        "gloss": path.throughput * (whole - albedo * diffuse),
        "throughput": dr.select(is_beyond, path.throughput, 0),
        "beyond": dr.select(is_beyond & met, mi.Float(1), 0),
        "beyond_albedo": dr.select(is_beyond & met, albedo, 0),
        "beyond_normal": dr.select(is_beyond & met, turn_towards(last.sh_frame.n, path.ray.d), 0),
        "beyond_depth": dr.select(is_beyond & met, path.length + last.t, 0),
    }


@dataclass(slots=True)
class _Path:
    """Loop variables of a path through mirrors and glass."""

    active: Any  # Bool: the ray has not been traced yet
    ray: Any  # Ray3f
    throughput: Any  # Color3f
    emission: Any  # Color3f: of all surfaces on the way
    length: Any  # Float: from the eye to the ray's origin
    followed: Any  # UInt32: surfaces passed on the way


def _follow_to_end(scene: Any, ray: PixelRay, first: Any, settings: GuideSettings) -> tuple[_Path, Any]:
    """Follow each ray from `first`, which it meets, to the first surface that is no pure mirror, glass or null.

    Returns the path, and that surface.
    """
    start = _Path(mi.Bool(True), mi.Ray3f(ray.ray), mi.Color3f(1), mi.Color3f(0), mi.Float(ray.before), mi.UInt32(0))
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
    If the settings say so, lights that the other lobe leads to are seen.
    """
    emitted = dr.select(s.active & (s.followed < settings.max_depth), si.emitter(scene).eval(si, s.active), 0)
    bsdf = si.bsdf()
    leads_on = s.active & si.is_valid() & is_pure_delta(bsdf.flags()) & (s.followed < settings.followed)
    bs, weight = bsdf.sample(mi.BSDFContext(), si, mi.Float(0.5), mi.Point2f(0.5), leads_on)
    if settings.lights_in_glass:
        emitted += _emitted_beside(scene, s, si, bs, leads_on, settings)
    return _Path(
        active=leads_on,
        ray=dr.select(leads_on, si.spawn_ray(si.to_world(bs.wo)), s.ray),
        throughput=dr.select(leads_on, s.throughput * weight * bs.pdf, s.throughput),
        emission=s.emission + s.throughput * emitted,
        length=dr.select(leads_on, s.length + si.t, s.length),
        followed=dr.select(leads_on, s.followed + 1, s.followed),
    )


def _emitted_beside(scene: Any, s: _Path, si: Any, followed: Any, leads_on: Any, settings: GuideSettings) -> Any:
    """What a surface's other delta lobe, which is not `followed`, shows of lights: their radiance times its share.

    Sampled at 0 glass reflects, and at 1 it transmits.
    """
    reflects = mi.has_flag(followed.sampled_type, mi.BSDFFlags.DeltaReflection)
    u = dr.select(reflects, mi.Float(dr.one_minus_epsilon(mi.Float)), 0)
    other, weight = si.bsdf().sample(mi.BSDFContext(), si, u, mi.Point2f(0.5), leads_on)
    splits = leads_on & (other.sampled_component != followed.sampled_component) & (other.pdf > 0)
    splits &= s.followed + 1 < settings.max_depth
    shown = scene.ray_intersect(si.spawn_ray(si.to_world(other.wo)), active=splits)
    return dr.select(splits, weight * other.pdf * shown.emitter(scene).eval(shown, splits), 0)


BSDF_SAMPLES = 2
"""The samples of each ray, for the directional albedo."""


def specular_of(bsdf: Any, si: Any, hit: Any, diffuse_kept: Any, number: Any) -> Any:
    """The directional albedo of all lobes but the diffuse one, 0 if there are none; it may be below 0 for `principled`.

    `diffuse_kept` is that of `Materials`, `number` is the ray's in its pixel. The albedo is a share of the light's
    power: radiance in glass is larger by the square of the refractive index.
    """
    flags, context = bsdf.flags(), mi.BSDFContext(mi.TransportMode.Importance)
    context.type_mask = int(mi.BSDFFlags.All) & ~int(mi.BSDFFlags.Diffuse)
    other = mi.has_flag(flags, mi.BSDFFlags.Delta) | mi.has_flag(flags, mi.BSDFFlags.Glossy)
    sampled = hit & other
    total = mi.Color3f(0)
    for sample in range(BSDF_SAMPLES):
        u = [dr.fma(mi.Float(number * BSDF_SAMPLES + sample), step, 0.5) for step in STEPS]
        u = [x - dr.floor(x) for x in u]
        _, weight = bsdf.sample(context, si, u[0], mi.Point2f(u[1], u[2]), sampled)
        total += dr.select(sampled, weight, 0)
    return total / BSDF_SAMPLES - dr.select(sampled, diffuse_kept * diffuse_reflectance(si, sampled), 0)
