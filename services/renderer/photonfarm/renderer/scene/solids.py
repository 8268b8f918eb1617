"""What the built-in rooms are made of: materials, closed meshes of trimesh, y up, in metres, and Mitsuba's shapes."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import trimesh
from numpy.typing import NDArray

from photonfarm.core.keys import Stream, make_key
from photonfarm.renderer.scene.arrays import floats, integers

Colour = tuple[float, float, float]
Point = tuple[float, float, float]


def rgb(colour: Colour) -> dict[str, Any]:
    """A linear RGB colour."""
    return {"type": "rgb", "value": list(colour)}


def diffuse(colour: Colour) -> dict[str, Any]:
    """A matte surface, seen from its front only."""
    return {"type": "diffuse", "reflectance": rgb(colour)}


def textured(image: NDArray[np.float32], repeat: tuple[float, float] = (1, 1)) -> dict[str, Any]:
    """A matte surface with an image (H, W, 3) of linear reflectances."""
    bitmap = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(image),
        "raw": True,  # reflectances as they are, not sRGB-encoded
        "to_uv": mi.ScalarTransform4f().scale([*repeat, 1]),
    }
    return {"type": "diffuse", "reflectance": bitmap}


def glossy(colour: Colour, alpha: float) -> dict[str, Any]:
    """Lacquer or plastic: a matte base under a rough dielectric coat."""
    return {"type": "roughplastic", "diffuse_reflectance": rgb(colour), "alpha": alpha, "nonlinear": True}


def metal(material: str, alpha: float) -> dict[str, Any]:
    """A brushed metal by its name in Mitsuba's table of indices (Au, Cu, Al, …)."""
    return {"type": "roughconductor", "material": material, "alpha": alpha, "distribution": "ggx"}


def mirror() -> dict[str, Any]:
    """A silvered mirror."""
    return {"type": "conductor", "material": "none", "specular_reflectance": rgb((0.92, 0.93, 0.92))}


def glass() -> dict[str, Any]:
    """The surface of a solid piece of glass."""
    return {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}


def planks(colour: Colour, rows: int = 16, size: int = 256) -> NDArray[np.float32]:
    """Wooden boards along u, two in each row, (size, size, 3): each its own tone, with grain and dark joints."""
    random = Stream(make_key("texture", "planks"), "tones")
    tone = 0.8 + 0.4 * random.uniform(rows, 2)
    grain = 1 + 0.10 * (random.uniform(size) - 0.5)
    v, u = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
    row = v * rows // size
    shift = (random.uniform(rows) * size).astype(int)[row]
    board = ((u + shift) % size) * 2 // size  # 0 or 1: which of the row
    shade = tone[row, board] * grain[v]
    joint = (v * rows % size < rows) | ((u + shift) % (size // 2) == 0)
    return np.asarray(np.where(joint, 0.45, shade)[..., None] * np.array(colour), np.float32)


def rug(field: Colour, figure: Colour, size: int = 128) -> NDArray[np.float32]:
    """A woven rug, (size, size, 3): a border, and rhombs on the field."""
    v, u = np.meshgrid(np.linspace(-1, 1, size), np.linspace(-1, 1, size), indexing="ij")
    rhombs = (np.abs((u * 3) % 1 - 0.5) + np.abs((v * 4) % 1 - 0.5)) < 0.28
    rim = np.maximum(np.abs(u), np.abs(v))
    drawn = ((rim < 0.82) & rhombs) | ((rim > 0.86) & (rim < 0.93))
    return np.asarray(np.where(drawn[..., None], np.array(figure), np.array(field)), np.float32)


def painting(size: int = 96) -> NDArray[np.float32]:
    """A picture for the wall, (size, size, 3): a sun over hills. Its first row is the lower edge."""
    y, x = np.meshgrid(np.linspace(0, 1, size), np.linspace(0, 1, size), indexing="ij")
    image = np.empty((size, size, 3))
    image[:] = np.array([0.75, 0.60, 0.42]) * (0.75 + 0.35 * y[..., None])
    image[(x - 0.62) ** 2 + (y - 0.66) ** 2 < 0.018] = (0.80, 0.25, 0.08)
    hills: tuple[tuple[float, float, float, Colour], ...] = (
        (0.46, 0.10, 7.0, (0.28, 0.36, 0.36)),
        (0.32, 0.08, 9.0, (0.12, 0.24, 0.26)),
        (0.18, 0.06, 5.0, (0.05, 0.12, 0.15)),
    )
    for height, swing, waves, colour in hills:
        image[y < height + swing * np.sin(waves * x + 10 * height)] = colour
    return np.asarray(image, np.float32)


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


def rectangle_light(centre: Point, size: tuple[float, float], up: Point, radiance: Colour) -> dict[str, Any]:
    """A rectangle that shines one way, against the axis `up`; `size` is along the two other axes, in their order."""
    axis = int(np.argmax(np.abs(up)))
    first, second = (i for i in range(3) if i != axis)
    down = -np.array(up, float)
    u = np.eye(3)[first] * size[0] / 2
    v = np.eye(3)[second] * size[1] / 2
    if np.cross(u, v) @ down < 0:  # a map that mirrors would turn the normal
        v = -v
    to_world = np.eye(4)
    to_world[:3] = np.stack([u, v, down, np.array(centre, float)], axis=1)
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f(to_world),
        "bsdf": {"type": "diffuse", "reflectance": rgb((0, 0, 0))},
        "emitter": {"type": "area", "radiance": rgb(radiance)},
    }


_FACE_COORDINATES = (-1.0, -0.4, -1e-3, 1e-3, 0.4, 1.0)
"""The grid on each face of the cube [−1, 1]³ whose points are the directions of a rounded box's vertices.

Their signs say which corner a vertex belongs to, so the gap between −1e-3 and 1e-3 becomes the flat part of a face."""


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
    """A box with rounded edges: the Minkowski sum of a box and a sphere; smooth vertex normals fit it."""
    u, v = (a.ravel() for a in np.meshgrid(_FACE_COORDINATES, _FACE_COORDINATES, indexing="ij"))
    n = len(_FACE_COORDINATES)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    quads = np.stack([corner, corner + n, corner + n + 1, corner + 1], axis=1)
    vertices: list[NDArray[np.float64]] = []
    faces: list[NDArray[np.int64]] = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            cube = np.empty((len(u), 3))
            cube[:, axis], cube[:, axis - 2], cube[:, axis - 1] = side, u, v  # the next axes, in turn
            faces.append((quads if side > 0 else quads[:, ::-1]) + n * n * len(vertices))
            vertices.append(cube)
    direction = np.concatenate(vertices)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    inner = np.array(size) / 2 - radius
    sides = np.concatenate(faces)
    triangles = np.concatenate([sides[:, [0, 1, 2]], sides[:, [0, 2, 3]]])
    return trimesh.Trimesh(np.sign(direction) * inner + radius * direction + centre, triangles, process=False)


def lathe(profile: list[tuple[float, float]], sections: int = 32) -> Any:
    """A solid of revolution about y from its profile, (radius, height) from the bottom of the axis to the top of it."""
    mesh = trimesh.creation.revolve(np.array(profile), sections=sections)  # about z
    mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))
    return mesh


def rod(radius: float, foot: Point, height: float, sections: int = 16) -> Any:
    """A vertical cylinder that stands at `foot`."""
    cylinder = lathe([(0, 0), (radius, 0), (radius, height), (0, height)], sections)
    cylinder.apply_translation(foot)
    return cylinder


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
