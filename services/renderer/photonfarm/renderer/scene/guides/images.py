"""The guides of a view: means over the rays of each pixel, which are followed through mirrors and glass.

The share of light that a surface reflects or transmits by lobes other than the diffuse one is evaluated by these lobes
alone, through the context's `type_mask`. Subtracting the diffuse reflectance from the total would not work: the coat of
a plastic leaves its base less light, so the difference is too small, and often below 0.

Shape letters: H W image.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from photonfarm.core.keys import Key, Stream
from photonfarm.core.records import F32, Guides
from photonfarm.renderer.bdpt.lights.emission import Lights, read_lights
from photonfarm.renderer.bdpt.recording import call_recorded, loop_once
from photonfarm.renderer.scene.arrays import floats, points
from photonfarm.renderer.scene.gbuffer import GRID, RAYS, camera_rays, diffuse_reflectance, seen_reflectance
from photonfarm.renderer.scene.guides.direct import (
    FOLLOWED,
    NO_LIMIT,
    STEPS,
    SUB_PIXELS,
    GuideSettings,
    direct_light,
    pattern_of,
    turn_towards,
)
from photonfarm.renderer.scene.materials import Materials, is_pure_delta
from photonfarm.scene.spec import GuideSpec, SceneSpec
from photonfarm.scene.view import Camera, View

if TYPE_CHECKING:
    from photonfarm.renderer.bdpt.recording import Recorder


def view_guides(
    scene: Any,
    view: View,
    spec: SceneSpec,
    wanted: GuideSpec,
    key: Key,
    materials: Materials,
    arrives: F32,
    recorder: Recorder | None = None,
) -> Guides:
    """The guides of a view in the scene's present configuration; `key` is the view's.

    `arrives` is the result of `point_light`. With a `recorder` of `trace` Python runs only once for all views.
    """
    camera, spec = Camera.of(view, spec), spec.model_copy(update={"guides": wanted})
    pixels = camera.height * camera.width
    steps = (np.arange(GRID) + 0.5) / GRID
    directions = np.stack([camera.rays(u, v).reshape(-1, 3) for v in steps for u in steps], axis=1)  # (H·W, 16, 3)
    shifts = Stream(key, "direct").uniform(pixels, 3).astype(np.float32)
    at_once = max(1, RAYS // SUB_PIXELS)  # pixels
    blocks = [slice(start, start + at_once) for start in range(0, pixels, at_once)]
    parts = [_trace(scene, camera, spec, directions[block], shifts[block], materials, recorder) for block in blocks]
    sums = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return _guides(sums, camera, arrives)


def _trace(
    scene: Any,
    camera: Camera,
    spec: SceneSpec,
    directions: F32,
    shifts: F32,
    materials: Materials,
    recorder: Recorder | None,
) -> dict[str, NDArray[np.float64]]:
    """Sums over the grids of some pixels, (pixels, channels), by name; see `trace`."""
    rays, along = camera_rays(camera, directions, spec)
    lights = read_lights(scene) if scene.emitters() else None
    settings = GuideSettings(
        spec.guides.light_samples if lights is not None else 0,
        FOLLOWED if materials.has_pure_deltas else 0,
        spec.transport.max_depth if spec.transport.max_depth >= 0 else NO_LIMIT,
        spec.view.near,
        materials.has_other_lobes,
    )
    of_bsdfs = floats(materials.roughness), floats(materials.diffuse_kept)
    tables = *of_bsdfs, *(floats(column) for column in pattern_of(settings.light_samples).T)
    shift = points(np.repeat(shifts, SUB_PIXELS, axis=0))
    kind = (len(along), settings, lights.kinds if lights else None)
    arguments = lights, tables, *rays, floats(along), shift, settings
    columns = call_recorded(recorder, trace, kind, scene, None, *arguments)
    return {name: _rows(column).reshape(len(shifts), SUB_PIXELS, -1).sum(1) for name, column in columns.items()}


def _rows(column: Any) -> NDArray[np.float64]:
    values = np.array(column, np.float64)
    return values.T if values.ndim > 1 else values


def _guides(sums: dict[str, NDArray[np.float64]], camera: Camera, arrives: F32) -> Guides:
    """The guides, given the sums over each pixel's rays."""

    def image(values: NDArray[np.float64]) -> F32:
        shaped = values.reshape(camera.height, camera.width, -1).astype(np.float32)
        return shaped[..., 0] if shaped.shape[-1] == 1 else shaped

    def divide(name: str, count: str) -> F32:
        return image(sums[name] / np.maximum(sums[count], 1))

    mean = {name: values / SUB_PIXELS for name, values in sums.items()}
    return Guides(
        emission=image(mean["emission"]),
        direct=image(mean["direct"]),
        gloss=image(mean["gloss"]),
        specular=image(np.maximum(mean["specular"], 0)),
        roughness=image(mean["roughness"]),
        mean_depth=divide("depth", "hits"),
        mean_normal=image(mean["normal"]),
        throughput=image(mean["throughput"]),
        beyond_albedo=divide("beyond_albedo", "beyond"),
        beyond_normal=divide("beyond_normal", "beyond"),
        beyond_depth=divide("beyond_depth", "beyond"),
        point_light=arrives,
    )


# -------------------------------------------------------------------------------------------- through mirrors and glass


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
    """The quantities that are averaged, by name, for each ray; zeros where there is nothing.

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
    reached = met & (path.followed + 2 <= settings.max_depth)
    diffuse, whole = direct_light(scene, lights, last, path.ray.d, reached, pattern, shift, settings)
    columns = {
        "hits": dr.select(hit, mi.Float(1), 0),
        "depth": dr.select(hit, settings.near + first.t * along, 0),
        "normal": dr.select(hit, turn_towards(first.sh_frame.n, d), 0),
        "specular": specular_of(bsdf, first, hit, dr.gather(mi.Float, diffuse_kept, number, hit)),
        "roughness": dr.gather(mi.Float, roughness, number, hit),
        "emission": path.emission,
        "direct": path.throughput * albedo * diffuse,
        "gloss": path.throughput * (whole - albedo * diffuse),
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
