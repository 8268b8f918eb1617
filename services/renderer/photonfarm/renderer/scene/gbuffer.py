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

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from photonfarm.core.records import F32, ViewBuffers
from photonfarm.renderer.bdpt.recording import call_recorded
from photonfarm.renderer.scene.arrays import floats, points, shape_numbers
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
from photonfarm.scene.spec import RAYS_PER_PIXEL, SceneSpec
from photonfarm.scene.view import View

if TYPE_CHECKING:
    from photonfarm.renderer.bdpt.recording import Recorders

CENTRE = {"normal": 3, "depth": 1}
"""The images that are made of one ray through each pixel's centre, and their channels."""

ALBEDO = {"albedo": 3}


def view_buffers(
    scene: Any, views: Sequence[View], spec: SceneSpec, recorders: Recorders | None = None, take: Take = take_numpy
) -> list[ViewBuffers]:
    """Depth (H, W), albedo and normal (H, W, 3) of views between the near and the far plane; zeros on a miss.

    With `recorders` Python runs only the first time; it takes half of the time in scenes of many materials.
    """
    cameras = ViewCameras.of(views, spec)
    arrays = call_recorded(recorders, trace_albedo, cameras.kind, scene, None, cameras)
    albedo = [images["albedo"] for images in shape_images(arrays, ALBEDO, cameras, take)]
    return with_albedo(scene, cameras, albedo, recorders, take)


def with_albedo(
    scene: Any,
    cameras: ViewCameras,
    albedo: Sequence[F32],
    recorders: Recorders | None = None,
    take: Take = take_numpy,
) -> list[ViewBuffers]:
    """The buffers of views whose albedo (H, W, 3) is known: depth and normals are rendered."""
    arrays = call_recorded(recorders, trace_centres, cameras.kind, scene, None, cameras)
    of_centres = shape_images(arrays, CENTRE, cameras, take)
    return [ViewBuffers(**images, albedo=mean) for images, mean in zip(of_centres, albedo, strict=True)]


def trace_centres(scene: Any, _: Any, cameras: ViewCameras) -> Any:
    """The depth and the normal of what the rays through the pixels' centres meet first, interleaved."""
    ray = cameras.pixels().ray(0.5, 0.5)
    si = scene.ray_intersect(ray.ray)
    hit = si.is_valid()
    columns = {"normal": dr.select(hit, si.sh_frame.n, 0), "depth": dr.select(hit, ray.depth(si.t), 0)}
    return interleave(columns, CENTRE, cameras.lanes)


def trace_albedo(scene: Any, _: Any, cameras: ViewCameras) -> Any:
    """The mean albedo over each pixel's grid, interleaved."""

    def albedo(ray: PixelRay, _: Any) -> Columns:
        si = scene.ray_intersect(ray.ray)
        return {"albedo": seen_reflectance(si, si.is_valid())}

    sums = sum_over_grid(cameras, ALBEDO, albedo)
    return interleave({"albedo": sums["albedo"] / RAYS_PER_PIXEL}, ALBEDO, cameras.lanes)


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


def find_shapes(
    scene: Any, views: Sequence[View], spec: SceneSpec, recorders: Recorders | None = None
) -> NDArray[np.int64]:
    """The number, in the scene's order, of the shape that the ray through each pixel's centre meets, (K, H, W).

    It is −1 where the buffers have nothing; an image of edges is not smoothed.
    """
    cameras = ViewCameras.of(views, spec)
    registered = call_recorded(recorders, trace_shapes, cameras.kind, scene, None, cameras)
    return shape_numbers(scene)[np.array(registered)].reshape(len(views), cameras.height, cameras.width)


def trace_shapes(scene: Any, _: Any, cameras: ViewCameras) -> Any:
    """The number in Dr.Jit's registry of the shape that the ray through each pixel's centre meets (UInt32); 0: none."""
    hit = scene.ray_intersect_preliminary(cameras.pixels().ray(0.5, 0.5).ray)
    shape = dr.select(hit.is_valid(), dr.reinterpret_array(mi.UInt32, hit.shape), 0)
    dr.eval(shape)
    return shape


SELF_HIT = 1e-4
"""The share of its length by which a ray ends before its point, so that it does not meet the point's surface."""


def find_seen_points(
    scene: Any, views: Sequence[View], spec: SceneSpec, position: F32, recorders: Recorders | None = None
) -> NDArray[np.bool_]:
    """Whether each view sees points (P, 3) of the present scene, (K, P), by the definition of `records.Visibility`."""
    cameras = ViewCameras.of(views, spec)
    kind = cameras.kind, len(position)
    seen = call_recorded(recorders, trace_to_points, kind, scene, None, cameras, floats(position))
    return np.array(seen).reshape(len(views), len(position))


def trace_to_points(scene: Any, _: Any, cameras: ViewCameras, position: Any) -> Any:
    """Whether the views see the points, whose coordinates are one Float array, view after view (Bool).

    There is a ray for every point, so that the number of rays depends on no view; those to points outside the image
    are switched off.
    """
    count = dr.width(position) // 3
    lane = dr.arange(mi.UInt32, cameras.views * count)
    view = lane // count
    camera, point = cameras.of_views(view), dr.gather(mi.Point3f, position, lane - view * count)
    offset = mi.Vector3f(point - camera.origin)
    z = dr.dot(offset, camera.forward)
    ahead = (z > camera.near) & (z < camera.far)
    z = dr.select(ahead, z, 1)
    u, v = (camera.focal_px * dr.dot(offset, axis) / z for axis in (camera.right, camera.down))
    seen = ahead & _is_in_a_pixel(u, camera.width) & _is_in_a_pixel(v, camera.height)
    distance = dr.norm(offset)
    direction = offset / distance
    before = camera.near * distance / z  # where the line to the point crosses the near plane
    reach = (1 - SELF_HIT) * distance - before
    seen_ray = mi.Ray3f(mi.Point3f(camera.origin + before * direction), direction, reach, 0, [])
    seen &= ~scene.ray_test(seen_ray, seen & (reach > 0))
    dr.eval(seen)
    return seen


def sight_shares(scene: Any, origins: F32, targets: F32) -> F32:
    """The share of targets (L, 3) that each of the origins (N, 3) has an unobstructed line to, (N,)."""
    start, end = origins.repeat(len(targets), axis=0), np.tile(targets, (len(origins), 1))
    distance = np.maximum(np.linalg.norm(end - start, axis=1), np.float32(1e-30))
    ray = mi.Ray3f(o=points(start), d=mi.Vector3f(points((end - start) / distance[:, None])))
    ray.maxt = floats(distance)
    blocked = np.array(scene.ray_test(ray)).reshape(len(origins), len(targets))
    return 1 - blocked.mean(axis=1, dtype=np.float32)


def _is_in_a_pixel(place: Any, pixels: int) -> Any:
    """Whether places along one axis, in pixels from the image's centre, are in one of its pixels."""
    return (place >= -0.5 * pixels) & (place < 0.5 * pixels)
