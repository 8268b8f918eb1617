"""Pictures of triangles by parallel projection: each shape alone, seen from above one corner; the colours of shapes.

Shape letters: H W image, S shapes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from photonfarm.core.pictures import Picture, display_values
from photonfarm.core.records import F32, Geometry
from photonfarm.renderer.scene.arrays import floats, integers, points, rows, shape_numbers
from photonfarm.renderer.scene.base_cloud import surfaces_at
from photonfarm.renderer.scene.gbuffer import diffuse_reflectance

WIDTH = 88

FACES = 16
"""The triangles of a shape whose colours are looked at."""

GREY = 0.6
"""The colour of shapes without a diffuse part: glass, mirrors, metals."""

PAPER = 248
"""The grey of what no ray hits."""

NOTHING = -1

OUTLINE = 0.45
"""The factor on the brightness of outlines."""

Vector = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """Where points of the world lie in a picture: across to the right, down, and away from the viewer."""

    right: Vector  # (3,) unit
    down: Vector  # (3,) unit
    forward: Vector  # (3,) unit: down = forward × right
    low: Vector  # (2,) what lies in the picture's upper left corner, along right and down
    high: Vector  # (2,) in its lower right corner
    start: float  # nothing nearer along `forward` is shown

    @property
    def size(self) -> Vector:
        """Width and height, in scene units."""
        return self.high - self.low

    def flat(self, position: NDArray[Any]) -> Vector:
        """Points (..., 3) as places in the picture (..., 2): 0 to 1 along its width, in the same units downwards."""
        along = np.stack([position @ self.right, position @ self.down], axis=-1)
        placed: Vector = (along - self.low) / self.size[0]
        return placed

    def rays(self, width: int) -> tuple[F32, tuple[int, int]]:
        """The starts of the rays of a picture so many pixels wide, (H · W, 3), and its height and width."""
        height = max(1, round(width * self.size[1] / self.size[0]))
        across = self.low[0] + (np.arange(width) + 0.5) / width * self.size[0]
        down = self.low[1] + (np.arange(height) + 0.5) / height * self.size[1]
        place = across[None, :, None] * self.right + down[:, None, None] * self.down + self.start * self.forward
        return place.reshape(-1, 3).astype(np.float32), (height, width)


def draw_scene(scene: Any, projection: Projection, width: int, colours: F32) -> Picture:
    """The first surfaces of a scene; `colours` (S, 3) are those of its shapes, in its order."""
    origin, size = projection.rays(width)
    si = scene.ray_intersect(_rays_along(projection, origin))
    hit, normal, shape = si.is_valid(), si.n, dr.reinterpret_array(mi.UInt32, si.shape)
    dr.eval(hit, normal, shape)
    number = np.where(np.array(hit), shape_numbers(scene)[np.array(shape)], NOTHING).reshape(size)
    return _shade(number, rows(normal, *size) @ projection.forward, colours)


def draw_shape(vertices: F32, faces: NDArray[np.uint32], projection: Projection, width: int, colour: F32) -> Picture:
    """The triangles (F, 3) of one shape, in one colour (3,).

    It takes a scene of its own, in which a ray's triangle is found without Mitsuba's shapes: Dr.Jit traces the code of
    all that are loaded whenever one of them is asked.
    """
    mesh = mi.Mesh("alone", len(vertices), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = floats(vertices)
    parameters["faces"] = integers(faces)
    parameters.update()
    scene = mi.load_dict({"type": "scene", "alone": mesh})
    origin, size = projection.rays(width)
    hit = scene.ray_intersect_preliminary(_rays_along(projection, origin))
    met, face = np.isfinite(np.array(hit.t)), np.array(hit.prim_index)
    corners = vertices[faces[np.where(met, face, 0)]].astype(np.float64)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = (across @ projection.forward) / np.maximum(np.linalg.norm(across, axis=1), 1e-30)
    return _shade(np.where(met, 0, NOTHING).reshape(size), facing.reshape(size), colour[None])


def _rays_along(projection: Projection, origin: F32) -> Any:
    return mi.Ray3f(o=points(origin), d=mi.Vector3f(*map(float, projection.forward)))


def _shade(number: NDArray[np.int64], facing: NDArray[Any], colours: F32) -> Picture:
    """Shapes' colours, darker where a surface (H, W) is seen at an angle; outlines where shapes meet."""
    shade = 0.55 + 0.45 * np.abs(facing)
    picture = np.where(number[..., None] == NOTHING, PAPER, 255 * shade[..., None] * colours[number])
    edges = np.zeros(number.shape, np.bool_)  # where the pixel to the right or below shows another shape
    edges[:, :-1] |= number[:, :-1] != number[:, 1:]
    edges[:-1] |= number[:-1] != number[1:]
    picture[edges] *= OUTLINE
    return np.round(picture.clip(0, 255)).astype(np.uint8)


def shape_colours(scene: Any, geometry: Geometry) -> F32:
    """A colour for each shape of a scene at rest, as displays are given it, (S, 3): its mean diffuse reflectance."""
    count = len(geometry.shape_group)
    first, last = (np.searchsorted(geometry.face_shape, np.arange(count), side) for side in ("left", "right"))
    face = np.linspace(first, np.maximum(last - 1, first), FACES).T.ravel().astype(np.uint32)
    with np.errstate(invalid="ignore"):  # triangles without an area
        _, si = surfaces_at(scene, geometry, face, np.full((len(face), 3), 1 / 3))
    albedo = diffuse_reflectance(si, mi.Bool(True))
    dr.eval(albedo)
    mean = np.nan_to_num(rows(albedo, count, FACES)).mean(axis=1)
    return np.where(mean.max(axis=1, keepdims=True) > 0, 0.12 + 0.88 * display_values(mean), GREY).astype(np.float32)


def draw_from_corner(geometry: Geometry, number: int, colour: F32, up: int) -> Picture:
    """One shape alone, in one colour (3,)."""
    first, last = np.searchsorted(geometry.face_shape, [number, number + 1])
    used, faces = np.unique(geometry.faces[first:last], return_inverse=True)
    vertices = geometry.vertices[used]
    box = np.array([vertices.min(axis=0), vertices.max(axis=0)], np.float64)
    middle, radius = box.mean(axis=0), max(0.5 * float(np.linalg.norm(box[1] - box[0])), 1e-9)
    right, down, forward = _axes_from_a_corner(up)
    centre = np.array([middle @ right, middle @ down])
    start = float(middle @ forward) - 2 * radius
    projection = Projection(right, down, forward, centre - radius, centre + radius, start)
    return draw_shape(vertices, faces.reshape(-1, 3).astype(np.uint32), projection, WIDTH, colour)


def _axes_from_a_corner(up: int) -> tuple[Any, Any, Any]:
    """Right, down and forward of a viewer above a corner, where axis `up` points up."""
    across, along = (np.eye(3)[axis] for axis in range(3) if axis != up)
    upwards = np.eye(3)[up]
    if np.cross(upwards, across) @ along < 0:
        along = -along
    forward = -(0.55 * across + 0.65 * along + 0.6 * upwards)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, upwards)
    right /= np.linalg.norm(right)
    return right, np.cross(forward, right), forward
