"""How much a film flickers: what changes of the surfaces that stay in view from one frame to the next.

A surface is followed by depth and camera, which are exact where nothing moves but the camera. What a still surface
shows may change truly, as in a mirror, and following it interpolates between pixels: so the figure of an image is to be
read beside that of the truth along the same path.

Shape letters: H W image, N pixels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.records import F32
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import Camera, View

SAME_SURFACE = 0.02
"""The share of its depth within which a surface that is followed is taken to be the one that was there."""


@dataclass(frozen=True, slots=True, eq=False)
class Register:
    """Where each pixel's surface stood in the frame before: the four pixels around it with their weights."""

    index: NDArray[np.int64]  # (4, N) into the pixels of the frame before
    weight: NDArray[np.float64]  # (4, N)
    pixels: NDArray[np.int64]  # (N,) those of this frame whose surface was in view

    def change(self, before: F32, now: F32) -> NDArray[np.float64]:
        """What is new at each pixel whose surface was in view, (N, 3), of two images (H, W, 3)."""
        flat, own = (image.reshape(-1, image.shape[-1]).astype(np.float64) for image in (before, now))
        shown: NDArray[np.float64] = own[self.pixels] - (self.weight[..., None] * flat[self.index]).sum(axis=0)
        return shown


def register(spec: SceneSpec, views: tuple[View, View], depths: tuple[F32, F32]) -> Register:
    """Follow the surfaces of a frame back into the frame before; views and depths (H, W) of both, the earlier first.

    A pixel counts if its surface was inside the earlier image, and all four pixels around it lay at its depth.
    """
    before, now = (Camera.of(view, spec) for view in views)
    ray = now.rays().astype(np.float64)
    place = now.origin + ray * (depths[1] / (ray @ now.forward))[..., None]
    seen = (place.reshape(-1, 3) - before.origin) @ np.stack([before.right, before.down, before.forward], axis=1)
    depth = np.where(seen[:, 2] > 0, seen[:, 2], np.inf)
    at = before.focal_px * seen[:, :2] / depth[:, None] + 0.5 * np.array([before.width, before.height]) - 0.5
    corner = np.floor(at)
    low, part = corner.astype(np.int64), at - corner
    inside = ((low >= 0) & (low < np.array([before.width - 1, before.height - 1]))).all(axis=1)
    inside &= (depths[1].reshape(-1) > 0) & np.isfinite(depth)
    pixels = np.flatnonzero(inside)
    depth = depth[pixels]
    columns, rows = (np.stack([first, first + 1]) for first in low[pixels].T)
    right, below = (np.stack([1 - share, share]) for share in part[pixels].T)
    index = (rows[:, None] * before.width + columns).reshape(4, -1)
    weight = (below[:, None] * right).reshape(4, -1)
    same = (np.abs(depths[0].reshape(-1)[index] - depth) < SAME_SURFACE * depth).all(axis=0)
    return Register(index[:, same], weight[:, same], pixels[same])


class Flicker:
    """What changes from frame to frame of several films of one path, by their names."""

    def __init__(self, spec: SceneSpec) -> None:
        """Begin before the first frame."""
        self._spec = spec
        self._before: tuple[View, F32, Mapping[str, Sequence[F32]]] | None = None
        self._sums: dict[str, float] = {}
        self._count = 0

    def add(self, view: View, depth: F32, images: Mapping[str, Sequence[F32]]) -> None:
        """Take the next frame: its depth (H, W), and of each film its image (H, W, 3) as it is shown.

        A film may be two images with noise of their own, as the halves of a truth: then the mean product of both
        changes is taken, in which that noise cancels.
        """
        if self._before is not None:
            seen, deep, shown = self._before
            follow = register(self._spec, (seen, view), (deep, depth))
            self._count += 3 * len(follow.pixels)
            for name, now in images.items():
                first, second = (follow.change(shown[name][i], now[i]) for i in (0, -1))
                self._sums[name] = self._sums.get(name, 0.0) + float((first * second).sum())
        self._before = view, depth, images

    def result(self) -> dict[str, float | None]:
        """The root of the mean square of what changed, of each film; empty where no surface stayed in view.

        It is None where the mean product of two noisy images is negative, and so not told apart from 0.
        """
        return {
            name: float(np.sqrt(total / self._count)) if total >= 0 else None
            for name, total in self._sums.items()
            if self._count
        }
