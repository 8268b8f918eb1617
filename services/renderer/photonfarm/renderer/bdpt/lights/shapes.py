"""What the starts of light paths need to know of the lights' shapes.

These are the cones of spot lights, the normals of spheres, which cylinders are mirrored, and which lights are textured.

All of it is data in device memory, so that edits in place change no kernel. Index letter: N lights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi


def column(n: int, entries: Sequence[mi.Float | float]) -> mi.Float:
    """The n entries [1] as one array [n]."""
    out = dr.zeros(mi.Float, n)
    places = mi.UInt32(list(range(n)))
    for i, entry in enumerate(entries):
        dr.scatter(out, entry, dr.gather(mi.UInt32, places, mi.UInt32(i)))
    return out


def cones(parameters: Sequence[mi.SceneParameters], emitters: Sequence[mi.Emitter]) -> tuple[mi.Vector3f, mi.Float]:
    """(axes [N], cosines of the cut-off angles [N]) of the lights' cones: whole spheres for all but spot lights."""
    n = len(emitters)
    if not any(emitter.class_name() == "SpotLight" for emitter in emitters):
        return mi.Vector3f(*(dr.opaque(mi.Float, x, n) for x in (0, 0, 1))), dr.opaque(mi.Float, -1, n)
    axes, cosines = [], []
    for emitter, params in zip(emitters, parameters, strict=True):
        spot = emitter.class_name() == "SpotLight"
        axes.append(dr.normalize(params["to_world"] @ mi.Vector3f(0, 0, 1)) if spot else mi.Vector3f(0, 0, 1))
        cosines.append(dr.cos(dr.deg2rad(params["cutoff_angle"])) if spot else mi.Float(-1))
    return mi.Vector3f(*(column(n, [axis[k] for axis in axes]) for k in range(3))), column(n, cosines)


def registry_id(emitter: mi.Emitter) -> int:
    """Dr.Jit's registry id of an emitter; it is a literal, so reading it waits for nothing."""
    return int(dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(emitter))[0])


def is_textured(emitter: mi.Emitter) -> bool:
    """Whether a light's radiance is a texture."""
    return bool(mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying))


def is_unmirrored(cylinder: mi.Shape) -> mi.Bool:
    """Whether a cylinder light's ``to_world`` keeps its orientation, as data [1].

    Otherwise Mitsuba's normals of sampled points are opposite to those of hits, which also biases `path`. Such lights
    get selection probability 0, and only hits find them.
    """
    to_world = mi.traverse(cylinder)["to_world"]
    x, y, z = (to_world @ mi.Vector3f(*axis) for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1)))
    return mi.Bool(dr.dot(dr.cross(x, y), z) > 0)


@dataclass(slots=True)
class Spheres:
    """The normals of sphere lights.

    Mitsuba 3.9's ``sample_position`` turns a point of a sphere by ``to_world``, but not its normal, so that they do not
    fit where the sphere is turned. Its hits and its ``sample_direction`` are right.
    """

    centre: mi.Point3f  # [N]
    side: mi.Float  # [N]: 1 if the light shines outwards, −1 inwards, 0 if it is no sphere

    @classmethod
    def of(cls, shapes: Sequence[Any]) -> Spheres | None:
        """The spheres among the shapes [N] of the lights, which are None for lights without one; None without any."""
        if not any(_is_sphere(shape) for shape in shapes):
            return None
        centres, sides = [], []
        for shape in shapes:
            centre, side = _measure_sphere(shape) if _is_sphere(shape) else (mi.Point3f(0), mi.Float(0))
            centres.append(centre)
            sides.append(side)
        n = len(shapes)
        spheres = cls(mi.Point3f(*(column(n, [centre[k] for centre in centres]) for k in range(3))), column(n, sides))
        dr.eval(spheres)
        return spheres

    def normal(self, light: mi.Int32 | mi.UInt32, ps: mi.PositionSample3f) -> mi.Normal3f:
        """The normals at points of the lights of these numbers."""
        side = dr.gather(mi.Float, self.side, light)
        outwards = dr.normalize(ps.p - dr.gather(mi.Point3f, self.centre, light))
        return mi.Normal3f(dr.select(side == 0, ps.n, outwards * side))


def _is_sphere(shape: Any) -> bool:
    return shape is not None and shape.class_name() == "Sphere"


def _measure_sphere(sphere: mi.Shape) -> tuple[mi.Point3f, mi.Float]:
    """(centre, side) of a sphere, [1] each."""
    to_world = mi.traverse(sphere)["to_world"]
    centre, outside = to_world @ mi.Point3f(0), dr.zeros(mi.Interaction3f)
    outside.p = to_world @ mi.Point3f(0, 0, 4)
    ds = sphere.sample_direction(outside, mi.Point2f(0.5))
    return centre, dr.sign(dr.dot(ds.n, ds.p - centre))
