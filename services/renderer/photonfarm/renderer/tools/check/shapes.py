"""The shapes of a loaded scene, as facts that a person chooses movable groups by.

What movable groups run into is found from their shapes at many places of their boxes, against all that does not move.

Shape letters: C corners of a box, N places in it, V points of a group.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from photonfarm.core.records import F32, Geometry
from photonfarm.renderer.scene.arrays import floats, points, shape_numbers
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.renderer.scene.surroundings import surroundings
from photonfarm.scene.groups import Movable, shape_ids
from photonfarm.scene.modification import turn_about
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec, parse_spec

_MATERIAL = re.compile(
    r"\b(?:Smooth)?((?:Rough|Thin)?(?:Diffuse|Dielectric|Conductor|Plastic)|Principled(?:Thin)?|TwoSided|Mask|BumpMap|"
    r"NormalMap|Blend|Null)(?:BSDF)?\["
)
"""How Mitsuba names materials, which are the names of their plugins but for these parts."""


@dataclass(frozen=True, slots=True)
class ShapeFacts:
    """One shape of a scene at rest."""

    id: str  # as a spec names it; empty if the scene file gives it none
    group: str | None  # the movable group of the spec that it belongs to
    material: str  # the plugins that it is made of, from the outermost
    triangles: int | None  # None of spheres, disks and cylinders, which are no meshes
    emits: bool
    min: tuple[float, float, float]  # of its box
    max: tuple[float, float, float]

    def document(self) -> dict[str, Any]:
        """All fields, for JSON."""
        return asdict(self)

    def row(self) -> tuple[str, ...]:
        """All fields as text, in the order of `HEAD`."""
        low, high = (" ".join(f"{value:.4g}" for value in corner) for corner in (self.min, self.max))
        triangles = "–" if self.triangles is None else f"{self.triangles:,}"
        light = "light" if self.emits else ""
        return self.id or "(no id)", self.group or "", self.material, triangles, light, low, high


HEAD = ("id", "group", "material", "triangles", "emits", "box from", "to")


def facts_of(scene: Any, group_of: Mapping[str, str]) -> list[ShapeFacts]:
    """The facts of each shape of a Mitsuba scene, in its order; `group_of` gives the group of a shape id."""
    return [_facts(shape, group_of.get(shape.id())) for shape in scene.shapes()]


def groups_by_shape(spec: SceneSpec) -> dict[str, str]:
    """The name of the movable group of each shape id that belongs to one."""
    return {shape: group.name for group in spec.groups for shape in shape_ids(group)}


def list_shapes(name: str) -> list[ShapeFacts]:
    """The shapes of a spec's scene, or of a Mitsuba scene file (`.xml`), without rendering anything.

    Raises SpecError as loading does.
    """
    from photonfarm.renderer.scene import backend
    from photonfarm.scene.spec_loading import find_spec

    path = Path(name)
    if path.suffix == ".xml":
        spec, beside = _bare(path), path.absolute().parent
    else:
        spec, beside = load_spec(name), find_spec(name).parent
    backend.load()
    from photonfarm.renderer.scene.loading import load_scene

    return facts_of(load_scene(spec, beside), groups_by_shape(spec))


def _bare(path: Path) -> SceneSpec:
    """A spec that says nothing but the scene file."""
    anywhere = {"min": (0.0, 0.0, 0.0), "max": (1.0, 1.0, 1.0)}
    described = {
        "name": "scene",
        "scene": {"file": str(path.absolute())},
        "view": {"origin": anywhere, "look_at": anywhere},
    }
    return parse_spec(described, where=str(path))


def _facts(shape: Any, group: str | None) -> ShapeFacts:
    box = shape.bbox()
    return ShapeFacts(
        shape.id(),
        group,
        _material(shape.bsdf()),
        int(shape.face_count()) if shape.is_mesh() else None,
        bool(shape.is_emitter()),
        tuple(box.min),
        tuple(box.max),
    )


def _material(bsdf: Any) -> str:
    """The plugins of a BSDF and of those in it, each once, and its id if it has one."""
    if bsdf is None:
        return "none"
    kinds = "/".join(dict.fromkeys(name.lower() for name in _MATERIAL.findall(str(bsdf)))) or bsdf.class_name().lower()
    return f"{kinds} ({bsdf.id()})" if bsdf.id() else kinds


PLACES = 64
"""Places in a box, beside its corners."""

POINTS = 256
"""The most vertices of a group that rays are sent to."""

TOUCHING = 0.02
"""The share of the way from a group's middle by which rays end before a vertex, where feet meet the floor."""

CARPET = 0.03
"""The share of the scene's height up to which nothing is in a group's way, such as a carpet."""

CUT = 0.1
"""The share of a group that must be behind something for it to stand in that."""


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """One group in its box."""

    low: F32  # (3,) the corners of its own box at rest
    high: F32
    outside: float  # the share of places where its middle is outside the room or in a solid; at rest it is neither
    cut: float  # the share of places where more than `CUT` of it is behind what does not move, beyond what is at rest
    worst: float  # the largest share of it that is
    place: tuple[float, float, float]  # where `at` stands then
    through: str | None  # the shape that most of it is behind, over all places


def placements(scene: LoadedScene, geometry: Geometry) -> list[Placed]:
    """Each group of a scene at rest."""
    from photonfarm.renderer.scene.loading import scene_of

    still = [shape for shape, stays in zip(scene.scene.shapes(), scene.still, strict=True) if stays]
    fixed, hollow = scene_of(still) if still else None, scene.hollow[scene.still]
    up = np.array(scene.spec.view.up, np.float32)
    carpet = CARPET * float(np.ptp(scene.boxes @ up))
    groups = enumerate(scene.spec.groups)
    return [_place(fixed, hollow, group_vertices(geometry, number), group, up, carpet) for number, group in groups]


def _corners(group: Movable) -> F32:
    """The distinct corners of a group's box, (C, 3)."""
    ends = [dict.fromkeys(pair) for pair in zip(group.box.min, group.box.max, strict=True)]
    return np.array([*product(*ends)], np.float32)


def group_vertices(geometry: Geometry, number: int) -> F32:
    """The vertices of a group's triangles, (V, 3)."""
    faces = geometry.faces[geometry.shape_group[geometry.face_shape] == number]
    return geometry.vertices[np.unique(faces)]


def _place(fixed: Any, hollow: NDArray[np.bool_], vertices: F32, group: Movable, up: F32, carpet: float) -> Placed:
    if not len(vertices):  # a light without a shape
        vertices = np.array([group.at], np.float32)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    corners = _corners(group)
    if fixed is None or group.stays:
        return Placed(low, high, 0, 0, 0, group.at, None)
    rng = np.random.default_rng(0)
    within = rng.uniform(group.box.low, group.box.high, (PLACES, 3))
    places = np.concatenate([[group.at], corners, within])
    moves = (places - group.at).astype(np.float32)
    middle = (low + high) / 2
    spread = _lift(vertices[np.linspace(0, len(vertices) - 1, min(POINTS, len(vertices))).astype(np.int64)], up, carpet)
    middles, spreads = np.tile(middle, (len(moves), 1)), np.tile(spread, (len(moves), 1, 1))
    if group.turn is not None:
        about = up.astype(np.float64), np.array(group.at)
        angles = rng.uniform(group.turn.min, group.turn.max, len(moves))
        for number, degrees in enumerate(angles[1:], 1):  # but at rest
            middles[number] = turn_about(middles[number], degrees, *about)
            spreads[number] = turn_about(spreads[number], degrees, *about)
    there = surroundings(fixed, middles + moves, hollow).open
    behind, shapes = _behind(fixed, middles, spreads, moves)
    cut = np.maximum(behind - behind[0], 0)
    random, worst = slice(1 + len(corners), None), int(cut.argmax())
    return Placed(
        low,
        high,
        outside=float(np.mean(there[0] & ~there[random])),
        cut=float(np.mean(cut[random] > CUT)),
        worst=float(cut[worst]),
        place=tuple(places[worst].tolist()),
        through=shapes,
    )


def _lift(vertices: F32, up: F32, carpet: float) -> F32:
    """Vertices (V, 3) of a group, raised by as much as a carpet is high, or to half the group's height."""
    height = vertices @ up
    least = height.min() + min(carpet, np.ptp(height) / 2)
    return vertices + np.maximum(least - height, 0)[:, None] * up


def _behind(fixed: Any, middles: F32, vertices: F32, moves: F32) -> tuple[NDArray[np.float64], str | None]:
    """The share of vertices (N, V, 3) behind a surface, seen from middles (N, 3), of each move (N, 3).

    Also the shape that this mostly is.
    """
    offset = (vertices - middles[:, None]).reshape(-1, 3)
    distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-30)
    start = np.repeat(middles + moves, vertices.shape[1], axis=0)
    ray = mi.Ray3f(o=points(start), d=mi.Vector3f(points(offset / distance[:, None])))
    ray.maxt = floats((1 - TOUCHING) * distance)
    hit = fixed.ray_intersect_preliminary(ray)
    met = np.isfinite(np.array(hit.t))
    shapes = shape_numbers(fixed)[np.array(dr.reinterpret_array(mi.UInt32, hit.shape))[met]]
    name = fixed.shapes()[np.bincount(shapes).argmax()].id() if met.any() else None
    return met.reshape(len(moves), -1).mean(axis=1), name
