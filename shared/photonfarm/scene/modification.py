"""The modification vector: where each movable group stands, and whether it is there at all; and a sample's point cloud.

The base cloud is sampled once per scene, and rebuilt for every configuration from its modification alone.

Shape letters: N configurations; G movable groups of a scene, its objects first and then its lights, in the order of
the spec; C `columns` of a scene; P points, F triangles, S shapes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.keys import Key, Stream, make_key, uniform_of
from photonfarm.core.records import F32, STATIC, BasePointCloud, Geometry
from photonfarm.scene.groups import Light
from photonfarm.scene.spec import SceneSpec

FIELDS = ("x", "y", "z", "present")
"""The columns of every modification vector."""

FURTHER = {"turn": 0.0, "power": 1.0, "red": 1.0, "green": 1.0, "blue": 1.0}
"""The columns that follow in a scene in which groups turn or change what they emit, and their values at rest."""

AT_REST = np.array([*FURTHER.values()], np.float32)

COLUMNS = len(FIELDS), len(FIELDS) + len(FURTHER)
"""The lengths that a group's part of the vector may have."""


def columns(spec: SceneSpec) -> int:
    """The number of columns of a scene's modification vectors, C."""
    return COLUMNS[spec.further_changes]


@dataclass(frozen=True, slots=True, eq=False)
class Modification:
    """One configuration of a scene; all that is stored of it per sample."""

    translation: NDArray[np.float32]  # (G, 3) from the rest position, scene units
    present: NDArray[np.bool_]  # (G,) False: removed
    further: F32 | None = None  # (G, 5) by `FURTHER`; None: a scene without these columns

    @property
    def vector(self) -> NDArray[np.float32]:
        """The modification as one array (G, C): translation, then 1 if present, else 0; and what is further."""
        parts = [self.translation, self.present[:, None].astype(np.float32)]
        return np.concatenate(parts if self.further is None else [*parts, self.further], axis=1)

    @classmethod
    def from_vector(cls, vector: NDArray[np.float32]) -> Modification:
        """The inverse of `vector`; (G, C)."""
        further = np.ascontiguousarray(vector[:, 4:], np.float32) if vector.shape[1] > len(FIELDS) else None
        return cls(np.ascontiguousarray(vector[:, :3], np.float32), vector[:, 3] != 0, further)

    @property
    def turn(self) -> F32:
        """The angle of each group about the up axis through its `at`, in degrees, (G,)."""
        return np.zeros(len(self.present), np.float32) if self.further is None else self.further[:, 0]

    @property
    def power(self) -> F32:
        """The factor on what each group emits, (G,)."""
        return np.ones(len(self.present), np.float32) if self.further is None else self.further[:, 1]

    @property
    def colour(self) -> F32:
        """Further factors on the red, green and blue that each group emits, (G, 3)."""
        return np.ones((len(self.present), 3), np.float32) if self.further is None else self.further[:, 2:]

    @property
    def light(self) -> F32:
        """The factors on the red, green and blue that each group emits: power × colour, (G, 3)."""
        return self.power[:, None] * self.colour

    def describe_further(self, g: int) -> str:
        """How a group stands and shines beside its place, in words; empty if as it was modelled."""
        turn = f"turned by {self.turn[g]:.3g}°" if self.turn[g] else ""
        red, green, blue = (f"{factor:.3g}" for factor in self.light[g])
        light = f"light × {red}" if red == green == blue else f"light × ({red}, {green}, {blue})"
        return ", ".join(filter(None, (turn, light if (self.light[g] != 1).any() else "")))

    def without_groups(self) -> Modification:
        """The same, with every group removed."""
        return replace(self, present=np.zeros_like(self.present))

    def key(self, radiance_id: str) -> Key:
        """The content key of this configuration of that scene."""
        return modification_keys(radiance_id, self.vector[None])[0]


def rest(spec: SceneSpec) -> Modification:
    """The scene as it was modelled: nothing moved, nothing removed."""
    count = len(spec.groups)
    further = np.tile(AT_REST, (count, 1)) if spec.further_changes else None
    return Modification(np.zeros((count, 3), np.float32), np.ones(count, np.bool_), further)


def sample_modifications(spec: SceneSpec, seed: int, indices: Iterable[int]) -> F32:
    """The random configurations of a scene with these numbers under a master seed, as vectors (N, G, C).

    Each group's position is uniform in its box and independent of the others; each is removed independently with its
    own probability; intersecting or unrealistic placements are not rejected [supplement 2.4]. Angles and powers are
    uniform between their limits, and each colour is as likely as the others. A static scene gives the rest state. A
    removed group is at rest otherwise, so that equal configurations have equal keys.
    """
    radiance_id, count = spec.radiance_id, len(spec.groups)
    keys = [make_key("modification", radiance_id, seed, index) for index in indices]
    uniform = uniform_of(keys, "placement", 4 * count).reshape(len(keys), count, 4)
    vectors = np.zeros((*uniform.shape[:2], columns(spec)), np.float32)
    for g, group in enumerate(spec.groups):
        position = group.box.low + uniform[:, g, :3] * (group.box.high - group.box.low)
        present = uniform[:, g, 3] >= group.removal_probability
        vectors[:, g, :3] = np.where(present[:, None], position - np.array(group.at), 0.0)
        vectors[:, g, 3] = present
    if spec.further_changes:
        chosen = _choose_further(spec, uniform_of(keys, "turn and light", 3 * count).reshape(len(keys), count, 3))
        vectors[..., 4:] = np.where(vectors[..., 3:4] != 0, chosen, AT_REST)
    return vectors


def _choose_further(spec: SceneSpec, uniform: NDArray[np.float64]) -> F32:
    """The columns of `FURTHER` by uniform numbers (N, G, 3) of each group, (N, G, 5)."""
    further = np.tile(AT_REST, (*uniform.shape[:2], 1))
    for g, group in enumerate(spec.groups):
        ranges = group.turn, group.power if isinstance(group, Light) else None
        for column, limits in enumerate(ranges):
            if limits is not None:
                further[:, g, column] = limits.min + uniform[:, g, column] * (limits.max - limits.min)
        if isinstance(group, Light) and group.colour:
            further[:, g, 2:] = np.array(group.colour)[(uniform[:, g, 2] * len(group.colour)).astype(np.int64)]
    return further


def sample_modification(spec: SceneSpec, seed: int, index: int) -> Modification:
    """The `index`-th random configuration of a scene; see `sample_modifications`."""
    return Modification.from_vector(sample_modifications(spec, seed, [index])[0])


def modification_keys(radiance_id: str, vectors: F32) -> list[Key]:
    """The content keys of configurations (N, G, C) of a scene."""
    return [make_key("modification", radiance_id, vector) for vector in vectors]


def sample_surface(geometry: Geometry, count: int, stream: Stream) -> tuple[NDArray[np.uint32], NDArray[np.float64]]:
    """`count` points uniform over all triangles: their triangle (P,) and barycentric coordinates (P, 3).

    First a shape by its area, then a triangle of it by its area, then a point in it [supplement 2.3, Eq. 1].
    Eq. (2) as printed is off by one: the index drawn is min{k : u ≤ cdf(k)}. Shapes of no area are never drawn.
    """
    areas = geometry.areas()
    order = np.argsort(geometry.face_shape, kind="stable")  # triangles, shape by shape
    shape_area = np.zeros(len(geometry.shape_group))
    np.add.at(shape_area, geometry.face_shape, areas)
    shape = draw(shape_area, stream.uniform(count))

    first = np.concatenate([[0.0], np.cumsum(areas[order])])  # area before each triangle, in that order
    start = np.concatenate([[0], np.cumsum(np.bincount(geometry.face_shape, minlength=len(shape_area)))])
    u = first[start[shape]] + stream.uniform(count) * (first[start[shape + 1]] - first[start[shape]])
    # u = 0 is found in the triangle before the shape's first, and rounding may pass its last
    place = np.clip(np.searchsorted(first[1:], u, side="left"), start[shape], start[shape + 1] - 1)
    return order[place].astype(np.uint32), _barycentric(stream.uniform(2, count))


def draw(weights: NDArray[np.float64], u: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices drawn in proportion to `weights`: min{k : u ≤ cdf(k)}, by bisection; never one of weight 0."""
    cdf = np.cumsum(weights) / np.sum(weights)
    positive = np.flatnonzero(weights > 0)
    return positive[np.minimum(np.searchsorted(cdf[positive], u, side="left"), len(positive) - 1)]


def _barycentric(u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Uniform in a triangle from two uniform numbers, (2, P) → (P, 3) (Turk, Graphics Gems, 1990)."""
    root = np.sqrt(u[0])
    return np.stack([1 - root, root * (1 - u[1]), root * u[1]], axis=1)


def rebuild(base: BasePointCloud, modification: Modification) -> tuple[F32, NDArray[np.bool_]]:
    """The position (P, 3) of each point in one configuration, and whether it is present (P,) [supplement 1.1, 2.1].

    Points of a moved group turn about its `at`, and then move by its translation, in float32; points of a removed group
    stay where they are and are not present, so that P is constant.
    """
    moves = base.group != STATIC
    group = np.where(moves, base.group, 0)
    if not len(modification.present):
        return base.position, np.ones(len(base.position), np.bool_)
    position = base.position
    if base.pivots is not None and modification.turn.any():
        position = position.copy()
        for g in np.flatnonzero(modification.turn):
            own = base.group == g
            position[own] = turn_about(base.position[own], modification.turn[g], base.pivots.up, base.pivots.at[g])
    shift = np.where(moves[:, None], modification.translation[group], np.float32(0))
    return position + shift, ~moves | modification.present[group]


def rebuild_surfaces(base: BasePointCloud, modification: Modification) -> tuple[F32, F32]:
    """The normal and the emission of each point in one configuration, (P, 3) each: the base's own where none changes.

    Normals turn with their groups; of a light that is there, emission has its power and colour.
    """
    normal, emission = base.normal, base.emission
    if base.pivots is not None and modification.turn.any():
        normal = normal.copy()
        for g in np.flatnonzero(modification.turn):
            normal[base.group == g] = turn_about(base.normal[base.group == g], modification.turn[g], base.pivots.up)
    if (modification.light != 1).any():
        factors = np.concatenate([modification.light, np.ones((1, 3), np.float32)])  # STATIC is the last one
        emission = emission * factors[base.group]
    return normal, emission


def turn_matrix(degrees: float | F32, up: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotations (…, 3, 3) by angles (…,) about the unit vector `up`, counter-clockwise from above (Rodrigues)."""
    angle = np.radians(np.asarray(degrees, np.float64))[..., None, None]
    cross = np.cross(np.eye(3), up)
    turned: NDArray[np.float64] = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)
    return turned


def turn_about(
    rows: F32, degrees: float, up: NDArray[np.float64], at: NDArray[np.float64] | None = None
) -> NDArray[np.float32]:
    """Points (N, 3) turned about `up` through `at`, or directions; in float64, rounded to float32."""
    centre = np.zeros(3) if at is None else at
    turned = (rows.astype(np.float64) - centre) @ turn_matrix(degrees, up).T + centre
    return turned.astype(np.float32)
