"""Image-space buffers: what one ray through each pixel centre meets first [supplement 1.3]. Free of noise.

**Albedo** is the diffuse reflectance of the first surface, and 0 for surfaces without a diffuse part (glass, mirrors,
metals, null). Mitsuba's `eval_diffuse_reflectance` answers for those that lack one of their own with π times the whole
BSDF at normal exitance, highlights and all (25 for a rough conductor); so it is asked only where the BSDF's flags have
a diffuse reflection. It is exact for diffuse, plastic and roughplastic, and for twosided, bumpmap, normalmap and mask
around them; for principled it is the base colour, whatever metallic and spec_trans say; blendbsdf blends, and a rough
conductor in a blend brings its highlight along. A texture is looked up without filtering. Two-sided materials answer
for the side that is seen; a one-sided one answers with its reflectance from behind too, where it renders black.

**Normals** are interpolated shading normals in world coordinates, of unit length, as modelled: the back of a surface,
two-sided or not, has the normal of its front. Bump and normal maps are part of the BSDF and not in them.

**Null and mask** surfaces count as surfaces: a mask shows the normal, depth and albedo of what it masks, whatever its
opacity there, as the first intersection meets it.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from photonfarm.renderer.arrays import floats, points, rows
from photonfarm.shared.records import ViewBuffers
from photonfarm.shared.scene import SceneSpec
from photonfarm.shared.view import Camera, View


def view_buffers(scene: Any, view: View, spec: SceneSpec) -> ViewBuffers:
    """Depth (H, W), albedo and normal (H, W, 3) between the near and the far plane; zeros where nothing is there."""
    camera = Camera.of(view, spec)
    directions = camera.rays().reshape(-1, 3)
    along = directions.astype(np.float64) @ camera.forward  # cosine to the forward axis
    near, far = spec.view.near / along, spec.view.far / along
    origins = camera.origin + directions * near[:, None]
    ray = mi.Ray3f(o=points(origins), d=mi.Vector3f(points(directions)))
    ray.maxt = floats(far - near)

    si = scene.ray_intersect(ray)
    hit = si.is_valid()
    albedo = dr.select(hit, diffuse_reflectance(si, hit), 0)
    normal = dr.select(hit, si.sh_frame.n, 0)
    distance = dr.select(hit, si.t, 0)
    dr.eval(hit, albedo, normal, distance)

    depth = np.where(np.array(hit), spec.view.near + np.array(distance) * along, 0)
    shape = (camera.height, camera.width)
    return ViewBuffers(depth.astype(np.float32).reshape(shape), rows(albedo, *shape), rows(normal, *shape))


def diffuse_reflectance(si: Any, active: Any) -> Any:
    """Diffuse reflectance (Color3f) at surface interactions; 0 where the BSDF has no diffuse reflection."""
    bsdf = si.bsdf()
    is_diffuse = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.DiffuseReflection)
    return dr.select(is_diffuse, bsdf.eval_diffuse_reflectance(si, is_diffuse), 0)
