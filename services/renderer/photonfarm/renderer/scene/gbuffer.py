"""The image-space buffers of a view [supplement 1.3], which have no noise.

**Depth and normal** are those of the first hit of one ray through each pixel centre. **Albedo** is a mean over the
pixel's area, by a regular grid of 4 × 4 rays, like the radiance, which a box filter averages over the pixel. A single
ray would show another texel, and at edges another surface.

**Albedo** is the diffuse reflectance of the first surface, and 0 for surfaces without a diffuse part (glass, mirrors,
metals, null). For BSDFs without a function of their own Mitsuba's `eval_diffuse_reflectance` returns π times the whole
BSDF at normal exitance, with its highlights (25 for a rough conductor). So it is called only if the BSDF's flags have a
diffuse reflection. It is exact for diffuse, plastic and roughplastic, and for twosided, bumpmap, normalmap and mask
around them; for principled it is the base colour, whatever metallic and spec_trans are; blendbsdf blends, and a rough
conductor in a blend adds its highlight. A texture is looked up without filtering. Two-sided materials return the
reflectance of the visible side. A one-sided material seen from behind has albedo 0, as it renders black there. Mitsuba
flags a BSDF as a whole: principled, mask, and blends with anything two-sided keep the albedo of their fronts, also
where they render black.

**Normals** are interpolated shading normals in world coordinates, of unit length, as modelled: the back of a surface,
two-sided or not, has the normal of its front. Bump and normal maps are part of the BSDF and not of the normals.

**Null and mask** surfaces count as surfaces: a mask has the normal, depth and albedo of what it masks, whatever its
opacity at that place.

**Visibility** of points is by one shadow ray to each: exact, and free of noise. A depth buffer is less exact: a point's
pixel also shows what is before and behind it, and a surface seen at an angle has many depths within a pixel. Shape
letter: N points.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from photonfarm.core.records import F32, ViewBuffers
from photonfarm.renderer.bdpt.recording import call_recorded
from photonfarm.renderer.scene.arrays import floats, points, rows
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import Camera, View

if TYPE_CHECKING:
    from photonfarm.renderer.bdpt.recording import Recorder

GRID = 4
"""The number of rays along each axis of a pixel, over which albedo is averaged."""

RAYS = 1 << 20
"""The number of rays traced at a time, or one for each pixel if that is more."""


def view_buffers(scene: Any, view: View, spec: SceneSpec, recorder: Recorder | None = None) -> ViewBuffers:
    """Depth (H, W), albedo and normal (H, W, 3) between the near and the far plane; zeros where nothing is hit.

    With a `recorder` of `trace_first_surfaces`, Python runs only the first time; it takes half of the time in scenes of
    many materials.
    """
    camera = Camera.of(view, spec)
    rays, along = camera_rays(camera, camera.rays(), spec)
    shape = (camera.height, camera.width)
    kind = ("centre", dr.width(rays[2]))
    hit, normal, distance = call_recorded(recorder, trace_first_surfaces, kind, scene, None, *rays, "centre")
    depth = np.where(np.array(hit), spec.view.near + np.array(distance) * along, 0)
    albedo = _mean_albedo(scene, camera, spec, recorder)
    return ViewBuffers(depth.astype(np.float32).reshape(shape), albedo, rows(normal, *shape))


def _mean_albedo(scene: Any, camera: Camera, spec: SceneSpec, recorder: Recorder | None) -> F32:
    """The mean albedo over the area of each pixel, (H, W, 3)."""
    steps = (np.arange(GRID) + 0.5) / GRID
    within = [(u, v) for v in steps for u in steps]
    at_once = max(1, RAYS // (camera.height * camera.width))
    total = np.zeros((camera.height, camera.width, 3))
    for start in range(0, len(within), at_once):
        directions = np.stack([camera.rays(u, v) for u, v in within[start : start + at_once]])
        rays, _ = camera_rays(camera, directions, spec)
        kind = ("albedo", dr.width(rays[2]))
        (albedo,) = call_recorded(recorder, trace_first_surfaces, kind, scene, None, *rays, "albedo")
        total += rows(albedo, *directions.shape[:-1]).sum(axis=0, dtype=np.float64)
    return (total / len(within)).astype(np.float32)


def camera_rays(camera: Camera, directions: F32, spec: SceneSpec) -> tuple[tuple[Any, Any, Any], NDArray[np.float64]]:
    """Rays from the near to the far plane, along unit directions (..., 3), and their cosines to the forward axis.

    The origins (Point3f), directions (Vector3f) and lengths (Float) of rays.
    """
    origin, direction, reach, along = place_rays(camera, directions, spec)
    return (points(origin), mi.Vector3f(points(direction)), floats(reach)), along


def place_rays(
    camera: Camera, directions: F32, spec: SceneSpec
) -> tuple[NDArray[np.float64], F32, NDArray[np.float64], NDArray[np.float64]]:
    """The same in numpy's memory: origins (N, 3), directions (N, 3), lengths and cosines (N,) of N rays."""
    flat = directions.reshape(-1, 3)
    along = flat.astype(np.float64) @ camera.forward
    near, far = spec.view.near / along, spec.view.far / along
    return camera.origin + flat * near[:, None], flat, far - near, along


def trace_first_surfaces(scene: Any, _: Any, origin: Any, direction: Any, reach: Any, what: str) -> tuple[Any, ...]:
    """(hits, normals, distances) of the first surfaces that rays meet ("centre"), or ("albedo",); zeros on a miss."""
    si = scene.ray_intersect(mi.Ray3f(o=origin, d=direction, maxt=reach, time=0, wavelengths=[]))
    hit = si.is_valid()
    columns: tuple[Any, ...]
    if what == "centre":
        columns = hit, dr.select(hit, si.sh_frame.n, 0), dr.select(hit, si.t, 0)
    else:
        columns = (dr.select(hit, seen_reflectance(si, hit), 0),)
    dr.eval(columns)
    return columns


def first_surfaces(scene: Any, camera: Camera, directions: F32, spec: SceneSpec) -> Any:
    """The first hits between the near and the far plane of rays from the camera along unit directions (..., 3)."""
    (origin, direction, reach), _ = camera_rays(camera, directions, spec)
    return scene.ray_intersect(mi.Ray3f(o=origin, d=direction, maxt=reach, time=0, wavelengths=[]))


def seen_reflectance(si: Any, active: Any) -> Any:
    """Diffuse reflectance (Color3f) on the side that rays come from; 0 where the BSDF has no diffuse reflection."""
    return diffuse_reflectance(si, active & reflects_here(si))


def reflects_here(si: Any) -> Any:
    """Whether rays come from the front of a surface, or its BSDF does something on its back too (Bool)."""
    return (mi.Frame3f.cos_theta(si.wi) > 0) | mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.BackSide)


def diffuse_reflectance(si: Any, active: Any) -> Any:
    """Diffuse reflectance (Color3f) at surface interactions; 0 where the BSDF has no diffuse reflection."""
    bsdf = si.bsdf()
    is_diffuse = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.DiffuseReflection)
    return dr.select(is_diffuse, bsdf.eval_diffuse_reflectance(si, is_diffuse), 0)


SELF_HIT = 1e-4
"""The share of its length by which a ray ends before its point, so that it does not meet the point's surface."""


def find_seen_points(scene: Any, view: View, spec: SceneSpec, position: F32) -> NDArray[np.bool_]:
    """Whether a view sees points (N, 3) of the present scene, (N,), by the definition of `records.Visibility`.

    There is a ray for every point, so that the number of rays depends on no view; those to points outside the image
    are switched off.
    """
    camera = Camera.of(view, spec)
    offset = position - camera.origin
    z = offset @ camera.forward
    ahead = (z > spec.view.near) & (z < spec.view.far)
    z = np.where(ahead, z, 1.0)
    u, v = (camera.focal_px * (offset @ axis) / z for axis in (camera.right, camera.down))
    in_image = ahead & _is_in_a_pixel(u, camera.width) & _is_in_a_pixel(v, camera.height)

    distance = np.where(ahead, np.linalg.norm(offset, axis=1), 1.0)
    direction = offset / distance[:, None]
    near = spec.view.near * distance / z  # at which the line to the point crosses the near plane
    ray = mi.Ray3f(o=points(camera.origin + near[:, None] * direction), d=mi.Vector3f(points(direction)))
    ray.maxt = floats(np.where(in_image, (1 - SELF_HIT) * distance - near, 0.0))
    hidden = scene.ray_test(ray, active=ray.maxt > 0)
    return in_image & ~np.array(hidden)


def sight_shares(scene: Any, origins: F32, targets: F32) -> F32:
    """The share of targets (L, 3) that each of the origins (N, 3) has an unobstructed line to, (N,)."""
    start, end = origins.repeat(len(targets), axis=0), np.tile(targets, (len(origins), 1))
    distance = np.maximum(np.linalg.norm(end - start, axis=1), np.float32(1e-30))
    ray = mi.Ray3f(o=points(start), d=mi.Vector3f(points((end - start) / distance[:, None])))
    ray.maxt = floats(distance)
    blocked = np.array(scene.ray_test(ray)).reshape(len(origins), len(targets))
    return 1 - blocked.mean(axis=1, dtype=np.float32)


def _is_in_a_pixel(place: NDArray[np.float64], pixels: int) -> NDArray[np.bool_]:
    """Whether places along one axis, in pixels from the image's centre, are in one of its pixels."""
    inside: NDArray[np.bool_] = (place >= -0.5 * pixels) & (place < 0.5 * pixels)
    return inside
