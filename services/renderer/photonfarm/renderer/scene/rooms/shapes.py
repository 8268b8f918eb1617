"""Solids turned into Mitsuba's shapes."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.scene.arrays import floats, integers
from photonfarm.renderer.scene.rooms.materials import Colour, rgb
from photonfarm.renderer.scene.rooms.solids import smooth_normals


def mesh(
    shape_id: str,
    solid: Any,
    material: dict[str, Any],
    *,
    smooth: bool = False,
    uv: NDArray[np.float32] | None = None,
    radiance: Colour | None = None,
) -> Any:
    """A Mitsuba mesh of a trimesh; flat-shaded unless `smooth`; `uv` (V, 2); it shines if it has a radiance."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(material)
    if radiance is not None:
        properties["emitter"] = mi.load_dict({"type": "area", "radiance": rgb(radiance)})
    made = mi.Mesh(
        shape_id,
        len(solid.vertices),
        len(solid.faces),
        has_vertex_normals=smooth,
        has_vertex_texcoords=uv is not None,
        props=properties,
    )
    made.set_id(shape_id)
    parameters = mi.traverse(made)
    parameters["faces"] = integers(np.asarray(solid.faces))
    if uv is not None:
        parameters["vertex_texcoords"] = floats(uv)
    parameters["vertex_positions"] = floats(np.asarray(solid.vertices))
    parameters.update()
    if smooth:  # Mitsuba's own, made on the update, leave seams between the parts of a solid
        parameters["vertex_normals"] = floats(smooth_normals(np.asarray(solid.vertices), solid.faces))
        parameters.update()
    return made


def rectangle_light(centre: Colour, size: tuple[float, float], up: Colour, radiance: Colour) -> dict[str, Any]:
    """A one-sided rectangle across the axis `up` that shines against it; `size` along the two other axes, in order."""
    axis = int(np.argmax(np.abs(up)))
    first, second = (i for i in range(3) if i != axis)
    down = -np.array(up, float)
    u = np.eye(3)[first] * size[0] / 2
    v = np.eye(3)[second] * size[1] / 2
    if np.cross(u, v) @ down < 0:
        v = -v
    to_world = np.eye(4)
    to_world[:3] = np.stack([u, v, down, np.array(centre, float)], axis=1)
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f(to_world),
        "bsdf": {"type": "diffuse", "reflectance": rgb((0, 0, 0))},
        "emitter": {"type": "area", "radiance": rgb(radiance)},
    }
