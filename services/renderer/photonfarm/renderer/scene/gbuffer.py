"""The image-space buffers of a view [supplement 1.3], which have no noise.

**Depth and normal** are those of the first hit of one ray through each pixel centre. **Albedo** is a mean over the
pixel's area, by a regular grid of 4 × 4 rays, because the radiance of a box filter is such a mean too. A single ray
would show another texel, and at edges another surface.

**Albedo** is the diffuse reflectance of the first surface, and 0 for surfaces without a diffuse part (glass, mirrors,
metals, null). For BSDFs without a function of their own Mitsuba's `eval_diffuse_reflectance` returns π times the whole
BSDF at normal exitance, with its highlights (25 for a rough conductor). So it is called only if the BSDF's flags have a
diffuse reflection. It is exact for diffuse, plastic and roughplastic, and for twosided, bumpmap, normalmap and mask
around them; for principled it is the base colour, whatever metallic and spec_trans are; blendbsdf blends, and a rough
conductor in a blend adds its highlight. A texture is looked up without filtering. Two-sided materials return the
reflectance of the visible side. From behind a one-sided one has albedo 0, as it renders black there. Mitsuba flags a
BSDF as a whole: principled, mask, and blends with anything two-sided keep the albedo of their fronts, also where they
render black.

**Normals** are interpolated shading normals in world coordinates, of unit length, as modelled: the back of a surface,
two-sided or not, has the normal of its front. Bump and normal maps are part of the BSDF and not of the normals.

**Null and mask** surfaces count as surfaces: a mask has the normal, depth and albedo of what it masks, whatever its
opacity at that place.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from photonfarm.renderer.scene.arrays import floats, points, rows
from photonfarm.shared.core.records import F32, ViewBuffers
from photonfarm.shared.scene.spec import SceneSpec
from photonfarm.shared.scene.view import Camera, View

if TYPE_CHECKING:
    from photonfarm.renderer.bdpt.recording import Recorder

GRID = 4
"""The number of rays along each axis of a pixel, over which albedo is averaged."""

RAYS = 1 << 20
"""The number of rays traced at a time, or one for each pixel if that is more."""


def view_buffers(scene: Any, view: View, spec: SceneSpec, recorder: Recorder | None = None) -> ViewBuffers:
    """Depth (H, W), albedo and normal (H, W, 3) between the near and the far plane; zeros where nothing is hit.

    With a `recorder` of `look`, Python runs only the first time; it takes half of the time in scenes of many materials.
    """
    camera = Camera.of(view, spec)
    directions = camera.rays()
    hit, normal, distance = _seen("centre", scene, _rays(camera, directions, spec), recorder)
    along = directions.reshape(-1, 3).astype(np.float64) @ camera.forward
    depth = np.where(np.array(hit), spec.view.near + np.array(distance) * along, 0)
    shape = (camera.height, camera.width)
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
        (albedo,) = _seen("albedo", scene, _rays(camera, directions, spec), recorder)
        total += rows(albedo, *directions.shape[:-1]).sum(axis=0, dtype=np.float64)
    return (total / len(within)).astype(np.float32)


What = Literal["centre", "albedo"]
Rays = tuple[Any, Any, Any]
"""The origins (Point3f), directions (Vector3f) and lengths (Float) of rays."""


def _seen(what: What, scene: Any, rays: Rays, recorder: Recorder | None) -> tuple[Any, ...]:
    """The result of `look`, recorded by `what` and the number of rays."""
    if recorder is None:
        return look(scene, None, *rays, what)
    found: tuple[Any, ...] = recorder((what, dr.width(rays[2])), scene, None, *rays, what)
    return found


def look(scene: Any, _: Any, origin: Any, direction: Any, reach: Any, what: What) -> tuple[Any, ...]:
    """The hits, normals and distances of the first surfaces that rays meet, or their albedo; zeros without a hit."""
    si = scene.ray_intersect(mi.Ray3f(o=origin, d=direction, maxt=reach, time=0, wavelengths=[]))
    hit = si.is_valid()
    found: tuple[Any, ...] = (dr.select(hit, seen_reflectance(si, hit), 0),)
    if what == "centre":
        found = hit, dr.select(hit, si.sh_frame.n, 0), dr.select(hit, si.t, 0)
    dr.eval(found)
    return found


def first_surfaces(scene: Any, camera: Camera, directions: F32, spec: SceneSpec) -> Any:
    """The first hits between the near and the far plane of rays from the camera along unit directions (..., 3)."""
    origin, direction, reach = _rays(camera, directions, spec)
    return scene.ray_intersect(mi.Ray3f(o=origin, d=direction, maxt=reach, time=0, wavelengths=[]))


def _rays(camera: Camera, directions: F32, spec: SceneSpec) -> Rays:
    """Rays from the near to the far plane, along unit directions (..., 3)."""
    flat = directions.reshape(-1, 3)
    along = flat.astype(np.float64) @ camera.forward  # cosine to the forward axis
    near, far = spec.view.near / along, spec.view.far / along
    return points(camera.origin + flat * near[:, None]), mi.Vector3f(points(flat)), floats(far - near)


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
