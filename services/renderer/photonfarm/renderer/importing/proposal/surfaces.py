"""All triangles of a loaded scene, in a frame whose third axis points up. Letters: S shapes, F faces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.importing.imported import Vector

Points = NDArray[np.float64]
"""Coordinates (…, 3): two along the floor, in the order of the world's axes, and the height."""


@dataclass(frozen=True, slots=True)
class Frame:
    """The axes of the world, with the one that points up as the last."""

    up: Vector

    @property
    def _axes(self) -> list[int]:
        axis = int(np.argmax(np.abs(self.up)))
        return [*(other for other in range(3) if other != axis), axis]

    @property
    def _signs(self) -> NDArray[np.float64]:
        return np.array([1.0, 1.0, float(np.sum(self.up))])

    def inward(self, world: NDArray[Any]) -> Points:
        """World coordinates (…, 3) in the frame."""
        return world[..., self._axes].astype(np.float64) * self._signs

    def world(self, points: Points) -> NDArray[np.float64]:
        """Coordinates of the frame in the world."""
        made = np.empty_like(points)
        made[..., self._axes] = points * self._signs
        return made

    def box(self, low: Points, high: Points) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The corners of a box of the frame, in the world."""
        corners = self.world(np.stack([low, high]))
        return corners.min(axis=0), corners.max(axis=0)


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """The triangles of a scene, in the frame."""

    ids: list[str]  # of the shapes, in the scene's order
    emits: NDArray[np.bool_]  # (S,)
    corners: Points  # (F, 3 corners, 3)
    shape: NDArray[np.int32]  # (F,)
    area: NDArray[np.float64]  # (F,)
    facing_up: NDArray[np.float64]  # (F,): the height component of the normal, without its sign

    @classmethod
    def of(cls, scene: Any, frame: Frame) -> Self:
        """The surfaces of a Mitsuba scene."""
        from photonfarm.renderer.scene.base_cloud import geometry_of

        shapes = scene.shapes()
        geometry = geometry_of(shapes, {})
        corners = frame.inward(geometry.vertices)[geometry.faces]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(across, axis=1)
        facing = np.abs(across[:, 2]) / np.maximum(length, 1e-30)
        emits = np.array([shape.is_emitter() for shape in shapes])
        return cls([shape.id() for shape in shapes], emits, corners, geometry.face_shape, length / 2, facing)


def bounds(label: NDArray[np.integer[Any]], count: int, lower: Points, upper: Points) -> tuple[Points, Points]:
    """The corners (count, 3) around all boxes of a label (N,), by their corners (N, 3)."""
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, label, lower)
    np.maximum.at(high, label, upper)
    return low, high
