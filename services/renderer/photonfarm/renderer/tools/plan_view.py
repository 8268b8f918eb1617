"""A scene from above or from one side, as SVG: what stands where, what may stand where, and cameras.

Shape letters: N points, G movable groups, S shapes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from photonfarm.core.pictures import Picture, data_uri
from photonfarm.core.records import Geometry
from photonfarm.scene.groups import Box
from photonfarm.scene.modification import Modification, rest, turn_about
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import Camera, View

F64 = NDArray[np.float64]

MOST_SHAPES = 1000  # that never move and are drawn: the largest ones
WIDTH = 100.0  # of a plan, in its own units
MARGIN = 0.03  # of the scene's larger side
REACH = 0.6  # of what may be placed: how far what never moves is drawn beyond that
GOLDEN_ANGLE = 137.508  # degrees between the hues of two groups that follow each other


@dataclass(frozen=True, slots=True)
class Standing:
    """A movable group, and where it stands in a configuration."""

    number: int  # in the plans
    name: str
    is_light: bool
    place: str | None  # None: it is not there

    @classmethod
    def of(cls, spec: SceneSpec, i: int, modification: Modification | None = None) -> Standing:
        """Where a group stands, or where it was modelled."""
        group, place = spec.groups[i], None
        if modification is None or modification.present[i]:
            at = np.array(group.at) + (0 if modification is None else modification.translation[i])
            further = "" if modification is None else modification.describe_further(i)
            place = ", ".join(filter(None, ("" if group.stays else format_point(at), further))) or "as modelled"
        return cls(i + 1, group.name, i >= len(spec.objects), place)


def format_point(point: NDArray[np.floating]) -> str:
    """A point as text, such as (1, 0.5, 2)."""
    return f"({', '.join(f'{value:.3g}' for value in np.where(np.abs(point) < 1e-6, 0, point))})"


@dataclass(frozen=True, slots=True, eq=False)
class PlanView:
    """What all plans of a scene have in common."""

    spec: SceneSpec
    axes: F64  # (2, 3) the directions to the right and up in the plan
    footprints: F64  # (G, 2, 3) lower and upper corner of each group at rest; NaN without triangles
    still: F64  # (N, 2, 3) the same of shapes that never move
    low: F64  # (2,) what the plans show, in the plan's axes
    high: F64

    @classmethod
    def of(cls, spec: SceneSpec, geometry: Geometry, *, from_above: bool = True) -> PlanView:
        """The scene at rest, and the part that plans show: all places of objects and cameras, and what is near them."""
        boxes = shape_boxes(geometry)
        still = boxes[(geometry.shape_group < 0) & np.isfinite(boxes).all(axis=(1, 2))]
        footprints = np.array([_around(boxes[geometry.shape_group == g]) for g in range(len(spec.groups))])
        places = [(box.low, box.high) for box in (spec.view.origin, spec.view.look_at)]
        for group, corners in zip(spec.groups, footprints, strict=True):
            if group.stays:
                continue
            own = np.where(np.isfinite(corners), corners, group.at) - group.at
            if group.turn is not None:
                own = np.linalg.norm(own, axis=1).max() * np.array([[-1.0], [1.0]])
            places.append((group.box.low + np.minimum(own[0], 0), group.box.high + np.maximum(own[1], 0)))
        core = _around(np.array(places))
        reach = REACH * np.ptp(core, axis=0).max()
        near = np.clip(still, core[0] - reach, core[1] + reach)
        axes = axes_of(spec, from_above=from_above)
        flat = np.concatenate([core[None], near]) @ axes.T
        low, high = _extent(flat.reshape(-1, 2))
        margin = MARGIN * (high - low).max()
        area = np.prod(np.abs(np.diff(still @ axes.T, axis=1)[:, 0]), axis=-1)
        largest = np.sort(np.argsort(area)[::-1][:MOST_SHAPES])
        return cls(spec, axes, footprints.reshape(-1, 2, 3), still[largest], low - margin, high + margin)

    @property
    def height(self) -> float:
        """The height of a plan that is `WIDTH` wide."""
        width, height = self.high - self.low
        return float(WIDTH * height / width)

    def shell(self) -> Markup:
        """What never moves, once in a page, as the symbol that all plans use."""
        shapes = Markup("").join(self._rectangle(box, "still") for box in self.still)
        return Markup(
            '<svg class="shared" width="0" height="0" aria-hidden="true"><defs><g id="still">{}</g></defs></svg>'
        ).format(shapes)

    def places(self, about: str, behind: Picture | None = None) -> Markup:
        """The scene at rest, before a picture of it or its shell, and the boxes that all is placed in."""
        view, groups = self.spec.view, self.spec.groups
        boxes = [self._rectangle(_corners(g.box), f"may hue{i}") for i, g in enumerate(groups) if not g.stays]
        boxes += [self._rectangle(_corners(view.look_at), "looked"), self._rectangle(_corners(view.origin), "origins")]
        ats = [self._point(np.array(group.at), f"at hue{i}") for i, group in enumerate(groups) if not group.stays]
        return self._svg([*boxes, *self._groups(rest(self.spec)), *ats], about, behind)

    def configuration(self, modification: Modification, views: Sequence[View]) -> Markup:
        """The plan of one configuration, and cameras with their fields of view."""
        cameras = [part for view in views for part in self._camera(view)]
        return self._svg([*self._groups(modification), *cameras], "what stands where, from above, and the camera")

    def _groups(self, modification: Modification) -> list[Markup]:
        """The groups that are there: lights last, as they hang above."""
        drawn = []
        for i, corners in enumerate(self.footprints):
            if not modification.present[i] or not np.isfinite(corners).all():
                continue
            kind = "light" if i >= len(self.spec.objects) else "thing"
            if degrees := modification.turn[i]:
                outline = self._turned(i, corners, degrees) + modification.translation[i]
                drawn.append(self._polygon(outline, f"{kind} hue{i}"))
            else:
                outline = corners + modification.translation[i]
                drawn.append(self._rectangle(outline, f"{kind} hue{i}"))
            x, y = self._at(outline.mean(axis=0))
            drawn.append(Markup('<text x="{:.2f}" y="{:.2f}">{}</text>').format(x, y, i + 1))
        return drawn

    def _turned(self, i: int, corners: F64, degrees: float) -> F64:
        """The outline of a group's box (2, 3) from above, turned about its `at`, (4, 3)."""
        flat = corners @ self.axes.T
        outline = np.array([flat[[x, y], [0, 1]] for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))]) @ self.axes
        return turn_about(
            outline.astype(np.float32), degrees, np.array(self.spec.view.up), np.array(self.spec.groups[i].at)
        ).astype(np.float64)

    def _camera(self, view: View) -> list[Markup]:
        camera = Camera.of(view, self.spec)
        far = np.linalg.norm(view.target.astype(np.float64) - camera.origin)
        half = 0.5 * camera.width / camera.focal_px
        rays = (camera.forward + side * half * camera.right for side in (-1, 1))
        corners = [self._at(camera.origin + far * ray) for ray in rays]
        eye, target = (self._at(point) for point in (camera.origin, view.target.astype(np.float64)))
        return [
            _draw_polygon((eye, *corners), "sees"),
            Markup('<line class="sees" x1="{:.2f}" y1="{:.2f}" x2="{:.2f}" y2="{:.2f}"/>').format(*eye, *target),
            self._point(camera.origin, "eye"),
        ]

    def _at(self, point: F64) -> tuple[float, float]:
        """A world point (3,) in the SVG's units; y goes down there."""
        x, y = self.axes @ point
        scale = WIDTH / (self.high[0] - self.low[0])
        return float(scale * (x - self.low[0])), float(scale * (self.high[1] - y))

    def _point(self, point: F64, kind: str) -> Markup:
        return Markup('<circle class="{}" cx="{:.2f}" cy="{:.2f}" r="1.5"/>').format(kind, *self._at(point))

    def _polygon(self, points: F64, kind: str) -> Markup:
        """The polygon of points (N, 3)."""
        return _draw_polygon([self._at(point) for point in points], kind)

    def _rectangle(self, corners: F64, kind: str) -> Markup:
        """The rectangle around a box (2, 3)."""
        left, top, right, bottom = np.concatenate(_extent(np.array([self._at(corner) for corner in corners])))
        return Markup('<rect class="{}" x="{:.2f}" y="{:.2f}" width="{:.2f}" height="{:.2f}"/>').format(
            kind, left, top, max(right - left, 0.3), max(bottom - top, 0.3)
        )

    def _svg(self, parts: Sequence[Markup], about: str, behind: Picture | None = None) -> Markup:
        shell = Markup('<use href="#still"/>')
        if behind is not None:
            shell = Markup('<image href="{}" width="{:.2f}" height="{:.2f}"/>').format(
                data_uri(behind), WIDTH, self.height
            )
        return Markup('<svg class="plan" viewBox="0 0 {:.2f} {:.2f}" role="img" aria-label="{}">{}{}</svg>').format(
            WIDTH, self.height, about, shell, Markup("").join(parts)
        )


def _draw_polygon(corners: Sequence[tuple[float, float]], kind: str) -> Markup:
    around = " ".join(f"{x:.2f},{y:.2f}" for x, y in corners)
    return Markup('<polygon class="{}" points="{}"/>').format(kind, around)


def hue(group: int) -> float:
    """The hue of a group, in degrees: far from that of the group before it, and none of the cameras' blue-greens."""
    return (195 + 310 / 360 * ((GOLDEN_ANGLE * group) % 360)) % 360


def axes_of(spec: SceneSpec, *, from_above: bool = True) -> F64:
    """A plan's axes to the right and up, (2, 3): as seen from above, not mirrored, or from a side."""
    upwards = np.array(spec.view.up, np.float64)
    right = np.eye(3)[0 if upwards[0] == 0 else 1]
    return np.array([right, np.cross(upwards, right) if from_above else upwards])


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


def _corners(box: Box) -> F64:
    return np.stack([box.low, box.high])


def _around(boxes: F64) -> F64:
    """The box around boxes (N, 2, 3); NaN around none."""
    known = boxes[np.isfinite(boxes).all(axis=(1, 2))]
    return np.stack([known[:, 0].min(axis=0), known[:, 1].max(axis=0)]) if len(known) else np.full((2, 3), np.nan)


def _extent(points: F64) -> tuple[F64, F64]:
    """The lower and upper corner of points (N, 2)."""
    return points.min(axis=0), points.max(axis=0)
