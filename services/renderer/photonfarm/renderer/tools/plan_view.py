"""A scene from above, as SVG: what stands where in a configuration, and where cameras stand and look.

Shape letters: N points, G movable groups, S shapes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from photonfarm.core.records import Geometry
from photonfarm.scene.modification import Modification, rest
from photonfarm.scene.spec import Box, SceneSpec
from photonfarm.scene.view import Camera, View

F64 = NDArray[np.float64]

MOST_SHAPES = 1000  # that never move and are drawn: the largest ones
WIDTH = 100.0  # of a plan, in its own units
MARGIN = 0.03  # of the scene's larger side
GOLDEN_ANGLE = 137.508  # degrees between the hues of two groups that follow each other


@dataclass(frozen=True, slots=True, eq=False)
class PlanView:
    """What all plans of a scene have in common."""

    spec: SceneSpec
    footprints: F64  # (G, 2, 3) lower and upper corner of each group at rest; NaN without triangles
    still: F64  # (N, 2, 3) the same of shapes that never move
    low: F64  # (2,) what the plans show, in the plan's axes
    high: F64

    @classmethod
    def of(cls, spec: SceneSpec, geometry: Geometry) -> PlanView:
        """The scene at rest, and the part that plans show: what never moves, and all places of objects and cameras."""
        boxes = shape_boxes(geometry)
        groups = geometry.shape_group
        still = boxes[(groups < 0) & np.isfinite(boxes).all(axis=(1, 2))]
        footprints = np.array([_around(boxes[groups == g]) for g in range(len(spec.groups))]).reshape(-1, 2, 3)
        places = [(box.low, box.high) for box in (spec.view.origin, spec.view.look_at, *(g.box for g in spec.groups))]
        low, high = _extent(_flat(spec, np.concatenate([still, np.array(places)]).reshape(-1, 3)))
        margin = MARGIN * (high - low).max()
        area = np.prod(np.abs(np.diff(_flat(spec, still), axis=1)[:, 0]), axis=-1)
        largest = np.sort(np.argsort(area)[::-1][:MOST_SHAPES])
        return cls(spec, footprints, still[largest], low - margin, high + margin)

    @property
    def height(self) -> float:
        """The height of a plan that is `WIDTH` wide."""
        width, height = self.high - self.low
        return float(WIDTH * height / width)

    def shell(self) -> Markup:
        """What never moves, once in a page, as the symbol that all plans use."""
        shapes = Markup("").join(self._rectangle(_flat(self.spec, box), "still") for box in self.still)
        return Markup(
            '<svg class="shared" width="0" height="0" aria-hidden="true"><defs><g id="still">{}</g></defs></svg>'
        ).format(shapes)

    def places(self) -> Markup:
        """The scene at rest, and the boxes that objects, lights and cameras are placed in."""
        boxes = [self._rectangle(self._place(g.box), f"may hue{i}") for i, g in enumerate(self.spec.groups)]
        boxes += [self._rectangle(self._place(self.spec.view.origin), "origins")]
        return self._svg([*boxes, *self._groups(rest(self.spec))], "where objects and cameras may stand, from above")

    def configuration(self, modification: Modification, views: Sequence[View]) -> Markup:
        """The plan of one configuration, and cameras with their fields of view."""
        cameras = [part for view in views for part in self._camera(view)]
        return self._svg([*self._groups(modification), *cameras], "what stands where, from above, and the camera")

    def _place(self, box: Box) -> F64:
        return _flat(self.spec, np.stack([box.low, box.high]))

    def _groups(self, modification: Modification) -> list[Markup]:
        """The groups that are there: lights last, as they hang above."""
        drawn = []
        for i, corners in enumerate(self.footprints):
            if not modification.present[i] or not np.isfinite(corners).all():
                continue
            corners = _flat(self.spec, corners + modification.translation[i])
            kind = "light" if i >= len(self.spec.objects) else "thing"
            x, y = self._at(corners.mean(axis=0))
            drawn.append(self._rectangle(corners, f"{kind} hue{i}"))
            drawn.append(Markup('<text x="{:.2f}" y="{:.2f}">{}</text>').format(x, y, i + 1))
        return drawn

    def _camera(self, view: View) -> list[Markup]:
        camera = Camera.of(view, self.spec)
        far = np.linalg.norm(view.target.astype(np.float64) - camera.origin)
        half = 0.5 * camera.width / camera.focal_px
        rays = (camera.forward + side * half * camera.right for side in (-1, 1))
        corners = [self._at(_flat(self.spec, camera.origin + far * ray)) for ray in rays]
        eye, target = (self._at(_flat(self.spec, point)) for point in (camera.origin, view.target.astype(np.float64)))
        wedge = " ".join(f"{x:.2f},{y:.2f}" for x, y in (eye, *corners))
        return [
            Markup('<polygon class="sees" points="{}"/>').format(wedge),
            Markup('<line class="sees" x1="{:.2f}" y1="{:.2f}" x2="{:.2f}" y2="{:.2f}"/>').format(*eye, *target),
            Markup('<circle class="eye" cx="{:.2f}" cy="{:.2f}" r="1.5"/>').format(*eye),
        ]

    def _at(self, point: F64) -> tuple[float, float]:
        """A point of the plan's axes, (2,), in the SVG's units; y goes down there."""
        scale = WIDTH / (self.high[0] - self.low[0])
        return float(scale * (point[0] - self.low[0])), float(scale * (self.high[1] - point[1]))

    def _rectangle(self, corners: F64, kind: str) -> Markup:
        """The rectangle around points (N, 2) of the plan's axes."""
        (left, bottom), (right, top) = (self._at(corner) for corner in _extent(corners))
        return Markup('<rect class="{}" x="{:.2f}" y="{:.2f}" width="{:.2f}" height="{:.2f}"/>').format(
            kind, left, top, max(right - left, 0.3), max(bottom - top, 0.3)
        )

    def _svg(self, parts: Sequence[Markup], about: str) -> Markup:
        return Markup(
            '<svg class="plan" viewBox="0 0 {:.2f} {:.2f}" role="img" aria-label="{}"><use href="#still"/>{}</svg>'
        ).format(WIDTH, self.height, about, Markup("").join(parts))


def hue(group: int) -> float:
    """The hue of a group, in degrees: far from that of the group before it, and none of the cameras' blue-greens."""
    return (195 + 310 / 360 * ((GOLDEN_ANGLE * group) % 360)) % 360


def axes(spec: SceneSpec) -> tuple[tuple[int, int], tuple[int, int]]:
    """The plan's axes, to the right and up, each as a world axis and its sign: as seen from above, not mirrored."""
    up = int(np.abs(spec.view.up).argmax())
    sign = int(spec.view.up[up])
    right, upward = {0: (1, 2), 1: (0, 2), 2: (0, 1)}[up]
    return (right, 1), (upward, -sign if up == 1 else sign)


def shape_boxes(geometry: Geometry) -> F64:
    """The lower and upper corner of each shape, (S, 2, 3); NaN without triangles."""
    boxes = np.full((len(geometry.shape_group), 2, 3), np.nan)
    order = np.argsort(geometry.face_shape, kind="stable")
    shapes, first = np.unique(geometry.face_shape[order], return_index=True)
    corners = geometry.vertices[geometry.faces[order]]  # (F, 3, 3)
    if len(shapes):
        boxes[shapes, 0] = np.minimum.reduceat(corners.min(axis=1), first)
        boxes[shapes, 1] = np.maximum.reduceat(corners.max(axis=1), first)
    return boxes


def _around(boxes: F64) -> F64:
    """The box around boxes (N, 2, 3); NaN around none."""
    known = boxes[np.isfinite(boxes).all(axis=(1, 2))]
    return np.stack([known[:, 0].min(axis=0), known[:, 1].max(axis=0)]) if len(known) else np.full((2, 3), np.nan)


def _flat(spec: SceneSpec, points: F64) -> F64:
    """World points (..., 3) on the plan's axes, (..., 2)."""
    return np.stack([sign * points[..., axis] for axis, sign in axes(spec)], axis=-1)


def _extent(points: F64) -> tuple[F64, F64]:
    """The lower and upper corner of points (N, 2)."""
    return points.min(axis=0), points.max(axis=0)
