"""Views: where the camera stands and looks, and the ray through each pixel centre.

Convention: the camera looks along its forward axis; x runs right and y down in the image, as pixels do; the field of
view is measured along the image's width. `depth` is the distance along the forward axis, not along the ray.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import SpecError
from photonfarm.core.keys import Key, make_key, uniform_of, view_key
from photonfarm.core.records import F32
from photonfarm.scene.modification import FIELDS, Modification, rest, turn_matrix
from photonfarm.scene.spec import SceneSpec, ViewSpec


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A camera position and the point it looks at, and perhaps a field of view; all that is stored of a view."""

    origin: NDArray[np.float32]  # (3,) scene units
    target: NDArray[np.float32]  # (3,) scene units
    fov: np.float32 | None = None  # degrees along the image's width; None: that of the spec

    @property
    def vector(self) -> NDArray[np.float32]:
        """Origin, target and, of a view with its own, the field of view; (6,) or (7,)."""
        own = [] if self.fov is None else [np.array([self.fov], np.float32)]
        return np.concatenate([self.origin, self.target, *own])

    @classmethod
    def from_vector(cls, vector: NDArray[np.float32]) -> View:
        """The inverse of `vector`; (6,) or (7,)."""
        fov = np.float32(vector[6]) if len(vector) > len(AXES) else None
        return cls(np.asarray(vector[:3], np.float32), np.asarray(vector[3:6], np.float32), fov)


AXES = ("origin_x", "origin_y", "origin_z", "look_at_x", "look_at_y", "look_at_z")
"""The columns of every view's vector."""


def view_columns(spec: SceneSpec) -> int:
    """The number of columns of a scene's view vectors, D: one more where each view has its own field of view."""
    return len(AXES) + (spec.view.fov is not None)


def field_of_view(spec: SceneSpec, fov_deg: float | None) -> np.float32 | None:
    """What a view of a spec has as `fov`, given one in degrees or None; where all share the spec's, that is None."""
    if spec.view.fov is None:
        return None if fov_deg in (None, spec.view.fov_deg) else np.float32(fov_deg)
    return np.float32(spec.view.fov_deg if fov_deg is None else fov_deg)


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A pinhole camera in world coordinates, in float64: what a view means for one film."""

    origin: NDArray[np.float64]  # (3,)
    right: NDArray[np.float64]  # (3,) unit
    down: NDArray[np.float64]  # (3,) unit
    forward: NDArray[np.float64]  # (3,) unit
    focal_px: float  # focal length in pixels, equal along both axes
    width: int
    height: int

    @classmethod
    def of(cls, view: View, spec: SceneSpec) -> Camera:
        """The camera of a view through the spec's film; no roll about the viewing direction."""
        origin = view.origin.astype(np.float64)
        forward = _unit(view.target.astype(np.float64) - origin)
        right = np.cross(forward, upright(view, spec.view))
        right = _unit(right)
        fov_deg = float(view.fov or spec.view.fov_deg)
        focal_px = 0.5 * spec.film.width / np.tan(0.5 * np.radians(fov_deg))
        return cls(origin, right, np.cross(forward, right), forward, float(focal_px), spec.film.width, spec.film.height)

    @property
    def world_to_camera(self) -> NDArray[np.float64]:
        """(3, 4): rows right, down, forward; maps homogeneous world points to camera coordinates."""
        rotation = np.stack([self.right, self.down, self.forward])
        return np.concatenate([rotation, -(rotation @ self.origin)[:, None]], axis=1)

    def rays(self, u: float = 0.5, v: float = 0.5) -> NDArray[np.float32]:
        """Unit world directions through one point of each pixel, (H, W, 3): normalise(T⁻¹ K⁻¹ (x+u, y+v, 1)).

        By default they go through the pixels' centres.
        """
        x = (np.arange(self.width) + u - 0.5 * self.width) / self.focal_px
        y = (np.arange(self.height) + v - 0.5 * self.height) / self.focal_px
        direction = x[None, :, None] * self.right + y[:, None, None] * self.down + self.forward
        return _unit(direction).astype(np.float32)


def upright(view: View, spec: ViewSpec) -> NDArray[np.float64]:
    """The up vector to build the camera with: the spec's, or another axis where the view is along it."""
    up = np.array(spec.up, np.float64)
    forward = _unit(view.target.astype(np.float64) - view.origin.astype(np.float64))
    if np.linalg.norm(np.cross(forward, _unit(up))) > 1e-6:
        return up
    return np.roll(up, 1)


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


MOST_DRAWS = 1000
"""The draws of a camera's position after which it is given up: then fewer than one in a hundred is free, or so."""


def sample_views(
    spec: SceneSpec, modification_keys: Sequence[Key], seed: int, indices: Sequence[int], modifications: F32
) -> F32:
    """Random views of configurations (N, G, C) with these keys, under a master seed, as vectors (N, D).

    `indices` (N,) are their numbers within each configuration. Origin and look-at point are uniform in their boxes and
    independent [supplement 2.2]. Both are drawn again where they are nearer to each other than 1e-4 of the boxes' joint
    diagonal and, in a spec with free space, where the origin is not in it. Then origins are uniform in what is free in
    the configuration. Fields of view are uniform in the spec's range, if it has one. Raises SpecError where almost
    nothing is free.
    """
    keys = [make_key("view", key, seed, index) for key, index in zip(modification_keys, indices, strict=True)]
    low = np.concatenate([spec.view.origin.low, spec.view.look_at.low])
    high = np.concatenate([spec.view.origin.high, spec.view.look_at.high])
    corners = np.concatenate([low, high]).reshape(-1, 3)
    least = 1e-4 * np.linalg.norm(np.ptp(corners, axis=0))
    vectors, left = np.empty((len(keys), view_columns(spec)), np.float32), np.arange(len(keys))
    if spec.view.fov is not None:
        share = uniform_of(keys, "field of view", 1)[:, 0]
        vectors[:, 6] = spec.view.fov.min + share * (spec.view.fov.max - spec.view.fov.min)
    for draw in range(MOST_DRAWS):
        if not len(left):
            return vectors
        vectors[left, :6] = low + uniform_of([keys[i] for i in left.tolist()], "placement", 6, 6 * draw) * (high - low)
        origin, target = vectors[left, :3], vectors[left, 3:6].astype(np.float64)
        is_kept = np.linalg.norm(target - origin, axis=1) >= least
        left = left[~(is_kept & are_in_free_space(spec, origin, modifications[left]))]
    raise SpecError(
        f"{spec.name}: view.origin: of {MOST_DRAWS} cameras none stood in the open, by view.free_space; make the box "
        "larger, or let groups leave room in it"
    )


def sample_view(
    spec: SceneSpec, modification_key: Key, seed: int, index: int, modification: Modification | None = None
) -> View:
    """The `index`-th random view of one configuration, or of the scene at rest; see `sample_views`."""
    standing = (rest(spec) if modification is None else modification).vector[None]
    return View.from_vector(sample_views(spec, [modification_key], seed, [index], standing)[0])


def view_keys(modification_keys: Iterable[Key], vectors: F32) -> list[Key]:
    """The content keys of views (N, D) of configurations with these keys."""
    return [view_key(key, vector) for key, vector in zip(modification_keys, vectors, strict=True)]


def are_in_free_space(spec: SceneSpec, origins: F32, modifications: F32) -> NDArray[np.bool_]:
    """Whether origins (N, 3) are in the open in configurations (N, G, C), (N,): in free cells, in no group's box.

    All are in a spec without free space.
    """
    space = spec.view.free_space
    if space is None:
        return np.ones(len(origins), np.bool_)
    free = space.holds(spec.view.origin.low, spec.view.origin.high, origins)
    for g in range(len(spec.groups)):
        free &= ~are_in_group(spec, g, origins, modifications)
    return free


def are_in_group(spec: SceneSpec, g: int, origins: F32, modifications: F32) -> NDArray[np.bool_]:
    """Whether origins (N, 3) are in the box around a group, where configurations (N, G, C) put it, (N,)."""
    space, group = spec.view.free_space, spec.groups[g]
    if space is None or group.name not in space.groups:
        return np.zeros(len(origins), np.bool_)
    low, high = np.array(space.groups[group.name])
    offset = origins.astype(np.float64) - (np.array(group.at) + modifications[:, g, :3])
    if modifications.shape[-1] > len(FIELDS):  # as seen from the group
        back = turn_matrix(-modifications[:, g, len(FIELDS)], np.array(spec.view.up, np.float64))
        offset = np.einsum("nij,nj->ni", back, offset)
    within: NDArray[np.bool_] = ((low <= offset) & (offset <= high)).all(axis=1) & (modifications[:, g, 3] != 0)
    return within
