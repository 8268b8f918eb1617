"""The solids that furniture is made of: closed triangle meshes of trimesh, y up, in metres; and as Mitsuba's shapes."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import trimesh
from numpy.typing import NDArray

from photonfarm.renderer.scene.arrays import floats, integers
from photonfarm.renderer.scene.rooms.materials import Colour, rgb


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


Point = tuple[float, float, float]

_GRID = (-1.0, -0.4, -1e-3, 1e-3, 0.4, 1.0)
"""The coordinates of a rounded box's vertices on a face of the unit cube: the inner pair bounds the flat part."""


def box(size: Point, centre: Point) -> Any:
    """A box."""
    return trimesh.creation.box(size, trimesh.transformations.translation_matrix(centre))


def standing_box(size: Point, foot: Point) -> Any:
    """A box whose lower face is centred at `foot`."""
    return box(size, (foot[0], foot[1] + size[1] / 2, foot[2]))


def legs(width: float, depth: float, height: float, thickness: float) -> list[Any]:
    """Four square legs at the corners of a rectangle about the origin."""
    x, z = (width - thickness) / 2, (depth - thickness) / 2
    return [standing_box((thickness, height, thickness), (i * x, 0, j * z)) for i in (-1, 1) for j in (-1, 1)]


def rounded_box(size: Point, centre: Point, radius: float) -> Any:
    """A box with rounded edges: the sum of a box and a sphere; smooth vertex normals fit it."""
    u, v = (a.ravel() for a in np.meshgrid(_GRID, _GRID, indexing="ij"))
    n = len(_GRID)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    quads = np.stack([corner, corner + n, corner + n + 1, corner + 1], axis=1)
    vertices: list[NDArray[np.float64]] = []
    faces: list[NDArray[np.int64]] = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            cube = np.empty((len(u), 3))
            cube[:, axis], cube[:, axis - 2], cube[:, axis - 1] = side, u, v
            faces.append((quads if side > 0 else quads[:, ::-1]) + n * n * len(vertices))
            vertices.append(cube)
    direction = np.concatenate(vertices)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    inner = np.array(size) / 2 - radius
    quad = np.concatenate(faces)
    triangles = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
    return trimesh.Trimesh(np.sign(direction) * inner + radius * direction + centre, triangles, process=False)


def lathe(profile: list[tuple[float, float]], sections: int = 32) -> Any:
    """A solid of revolution about y from its profile, (radius, height) from the bottom of the axis to the top of it."""
    mesh = trimesh.creation.revolve(np.array(profile), sections=sections)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))
    return mesh


def rod(radius: float, foot: Point, height: float, sections: int = 16) -> Any:
    """A vertical cylinder that stands at `foot`."""
    rod = lathe([(0, 0), (radius, 0), (radius, height), (0, height)], sections)
    rod.apply_translation(foot)
    return rod


def quad(corner: Point, u: Point, v: Point) -> Any:
    """A parallelogram corner + [0, 1]·u + [0, 1]·v; its normal is u × v."""
    a, b, c = (np.array(x, float) for x in (corner, u, v))
    return trimesh.Trimesh([a, a + b, a + b + c, a + c], [[0, 1, 2], [0, 2, 3]], process=False)


def join(*meshes: Any) -> Any:
    """One mesh made of several."""
    return trimesh.util.concatenate(list(meshes))


def smooth_normals(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float32]:
    """Vertex normals (V, 3): the mean of the faces' at each place, by area; vertices at one place share them."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    _, place = np.unique(np.round(vertices, 7), axis=0, return_inverse=True)
    place = place.reshape(-1)
    total = np.zeros((place.max() + 1, 3))
    for i in range(3):
        np.add.at(total, place[faces[:, i]], normal)
    total = total[place]
    return np.asarray(total / np.linalg.norm(total, axis=1, keepdims=True), np.float32)
