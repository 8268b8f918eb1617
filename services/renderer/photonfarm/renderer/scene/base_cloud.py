"""The triangles of a scene at rest, and the base point cloud on them [supplement 2.1, 2.3].

Light transport uses the shapes themselves. Meshes, rectangles and cubes are used unchanged. Spheres, disks and
cylinders become fine meshes whose vertices lie on the surface (128 sections around, 64 from pole to pole): the area is
short by at most 0.1 %.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import SpecError
from photonfarm.core.keys import Stream, make_key
from photonfarm.core.records import STATIC, BasePointCloud, Geometry
from photonfarm.renderer.scene.arrays import floats, integers, points, rows
from photonfarm.renderer.scene.gbuffer import diffuse_reflectance
from photonfarm.scene.modification import sample_surface

SECTIONS = 128


@dataclass(frozen=True, slots=True, eq=False)
class Triangles:
    """One shape's triangles in world coordinates."""

    vertices: NDArray[np.float32]  # (V, 3)
    faces: NDArray[np.uint32]  # (F, 3)


def triangles_of(shape: Any, sections: int = SECTIONS) -> Triangles:
    """The triangles of one shape, with so many `sections` around a round one.

    Raises SpecError for curves, instances, ellipsoids and other unsupported shapes.
    """
    if shape.is_mesh():
        positions = np.array(shape.vertex_positions_buffer(), np.float32)
        faces = np.array(shape.faces_buffer(), np.uint32)
        return Triangles(positions.reshape(-1, 3), faces.reshape(-1, 3))
    if shape.class_name() not in _PROFILES:
        raise SpecError(
            f"shape {shape.id()!r} is a {shape.class_name()}; "
            "only meshes, rectangles, cubes, spheres, disks and cylinders can be used"
        )
    angle = np.linspace(0, 2 * np.pi, sections + 1)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    radius, height = _PROFILES[shape.class_name()](sections)
    points = np.empty((len(radius), len(circle), 3))
    points[..., :2] = np.array(radius)[:, None, None] * circle
    points[..., 2] = np.array(height)[:, None]
    to_world = np.array(mi.traverse(shape)["to_world"].matrix, np.float64).reshape(4, 4)
    vertices = points.reshape(-1, 3) @ to_world[:3, :3].T + to_world[:3, 3]
    corners = _grid_faces(*points.shape[:2])
    if np.linalg.det(to_world[:3, :3]) < 0:
        corners = corners[:, ::-1]
    return Triangles(vertices.astype(np.float32), corners)


def _half_circle(sections: int) -> tuple[Any, Any]:
    polar = np.linspace(-np.pi / 2, np.pi / 2, sections // 2 + 1)
    return np.cos(polar), np.sin(polar)


_PROFILES: dict[str, Callable[[int], tuple[Any, Any]]] = {
    "Sphere": _half_circle,
    "Disk": lambda _: ((1, 0), (0, 0)),
    "Cylinder": lambda _: ((1, 1), (0, 1)),
}
"""Shapes that turn a profile about z: (radii, heights) of its points, for so many sections around."""


def _grid_faces(rows: int, columns: int) -> NDArray[np.uint32]:
    """Two triangles per cell of a grid of vertices; those at poles have no area and are never drawn."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    quads = np.stack([corner, corner + 1, corner + columns + 1, corner + columns], axis=1)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.uint32)


def geometry_of(shapes: list[Any], group_of: Mapping[str, int], sections: int = SECTIONS) -> Geometry:
    """The triangles of shapes in the scene's order; `group_of` gives the movable group of a shape id.

    Round shapes get so many `sections` around.
    """
    parts = [triangles_of(shape, sections) for shape in shapes]
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + np.uint32(start) for part, start in zip(parts, starts, strict=False)]
    return Geometry(
        vertices=_stack([part.vertices for part in parts], np.float32),
        faces=_stack(faces, np.uint32),
        face_shape=np.repeat(np.arange(len(parts), dtype=np.int32), [len(part.faces) for part in parts]),
        shape_group=np.array([group_of.get(shape.id(), STATIC) for shape in shapes], np.int16),
    )


def _stack(arrays: list[NDArray[Any]], dtype: type) -> NDArray[Any]:
    return np.concatenate(arrays).astype(dtype) if arrays else np.zeros((0, 3), dtype)


def cloud_of(scene: Any, geometry: Geometry, count: int, radiance_id: str) -> BasePointCloud:
    """`count` points uniform on the scene's surfaces, as they are at rest; the radiance id determines which."""
    face, barycentric = sample_surface(geometry, count, Stream(make_key("cloud", radiance_id), "surface"))
    position, si = surfaces_at(scene, geometry, face, barycentric)
    emission = si.emitter(scene).eval(si)
    albedo = diffuse_reflectance(si, mi.Bool(True))
    front = dr.dot(si.n, si.sh_frame.n)
    dr.eval(si.n, front, albedo, emission)
    shape = geometry.face_shape[face]
    is_mirrored = np.bincount(shape, np.array(front), len(geometry.shape_group)) < 0  # then Mitsuba's `n` is the back's
    return BasePointCloud(
        position=position.astype(np.float32),
        normal=rows(si.n, count) * np.where(is_mirrored[shape], -1, 1).astype(np.float32)[:, None],
        albedo=rows(albedo, count),
        emission=rows(emission, count),
        group=geometry.shape_group[shape],
        face=face,
    )


def surfaces_at(
    scene: Any, geometry: Geometry, face: NDArray[np.uint32], barycentric: NDArray[np.float64]
) -> tuple[NDArray[np.float64], Any]:
    """Points of triangles, (P, 3), and Mitsuba's surface interactions there, seen from their front.

    They are not found by rays, which may meet other surfaces.
    """
    corners = geometry.vertices[geometry.faces[face]].astype(np.float64)  # (P, 3 corners, 3)
    position = np.einsum("pk,pkx->px", barycentric, corners)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    shape = geometry.face_shape[face]
    first = np.searchsorted(geometry.face_shape, np.arange(len(geometry.shape_group)))  # each shape's first face
    hit = dr.zeros(mi.PreliminaryIntersection3f, len(face))
    hit.valid = dr.full(mi.Bool, True, len(face))
    hit.t = floats(np.ones(len(face)))
    hit.prim_index = integers(face - first[shape])
    hit.prim_uv = mi.Point2f(*(floats(barycentric[:, i]) for i in (1, 2)))
    hit.shape = dr.gather(mi.ShapePtr, scene.shapes_dr(), integers(shape))
    ray = mi.Ray3f(o=points(position + across), d=mi.Vector3f(points(-across)))
    si = hit.compute_surface_interaction(ray)
    si.wi = mi.Vector3f(0, 0, 1)
    return position, si
