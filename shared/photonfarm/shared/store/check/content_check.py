"""The check of stored values: it finds images and views that are certainly or probably wrong.

Shape letters: H W image, P pixels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.scene.spec import SceneSpec
from photonfarm.shared.scene.view import Camera, View
from photonfarm.shared.store.check.halves import Fingerprints, HalvesTest
from photonfarm.shared.store.format.schema import bit_counts
from photonfarm.shared.store.write.findings import Cause

_FLOAT = {2: (np.uint16, 0x7FFF, 0x7C00), 4: (np.uint32, 0x7FFFFFFF, 0x7F800000)}
"""The integer type, the mask of the magnitude and the magnitude of infinity, by the bytes of a float."""


@dataclass(slots=True)
class CheckTotals:
    """Totals over the jobs of a scene."""

    halves: HalvesTest
    fingerprints: Fingerprints = field(default_factory=Fingerprints)
    jobs: int = 0
    samples: int = 0
    size_bytes: int = 0
    hit_pixels: int = 0  # first hits, of all views
    back_facing_pixels: int = 0  # of these, seen from behind

    def add(self, other: CheckTotals) -> None:
        """Add the totals of other jobs of the scene."""
        self.halves.merge(other.halves)
        self.fingerprints.merge(other.fingerprints)
        for name in ("jobs", "samples", "size_bytes", "hit_pixels", "back_facing_pixels"):
            setattr(self, name, getattr(self, name) + getattr(other, name))


class ContentCheck:
    """Checks the rows of a scene, one after the other; yields each finding as a cause and a detail."""

    def __init__(self, spec: SceneSpec) -> None:
        self._spec = spec
        self._rays: NDArray[np.float32] | None = None

    def radiance(self, row: int, halves: NDArray[Any], totals: CheckTotals) -> Iterator[tuple[Cause, str]]:
        """Check the halves of a sample, (2, H, W, 3), whose values are finite and scaled as they are stored."""
        totals.samples += 1
        totals.halves.add(halves)
        black = [half for half, values in zip("AB", halves, strict=True) if not largest(values)]
        prints = [totals.fingerprints.add(row, values) for values in halves if largest(values)]
        if not prints:
            yield Cause.BLACK, "all zero"
        elif black:
            yield Cause.BLACK_HALF, f"{black[0]} is all zero"
        elif prints[0] == prints[-1] and np.array_equal(*halves) and not is_constant(halves[0]):
            yield Cause.EQUAL_HALVES, "A = B in every pixel"

    def view(
        self, depth: NDArray[Any], normal: NDArray[Any], view: View | None, totals: CheckTotals
    ) -> Iterator[tuple[Cause, str]]:
        """Check the buffers of a view: depth (H, W) and the modelled normals (H, W, 3).

        Normals are not turned to the camera, so the inside of a box or the back of a leaf is rightly seen from behind.
        Views from inside an object are allowed too. So such pixels are only counted, and a view is reported only if it
        shows nothing else.
        """
        hit = depth > 0
        hits = int(np.count_nonzero(hit))
        if not hits:
            yield Cause.EMPTY_VIEW, "depth is 0 in every pixel"
        elif view is not None:
            behind = int(np.count_nonzero((self._cosine(normal, view) > 0) & hit.reshape(-1)))
            totals.hit_pixels += hits
            totals.back_facing_pixels += behind
            if behind == hits:
                yield Cause.BACK_FACING, f"all {hits} pixels that meet something"

    def bits(self, name: str, packed: NDArray[np.uint8]) -> Iterator[tuple[Cause, str]]:
        """Check the stored bits of which points or photons a view sees: `point_seen` or `photon_seen`."""
        count = bit_counts(self._spec)[name]
        if count % 8 and packed[-1] >> count % 8:
            yield Cause.UNUSED_BIT, f"{name} has a bit above those of {count}"

    def _cosine(self, normal: NDArray[Any], view: View) -> NDArray[np.float32]:
        """The cosine between each pixel's normal and the ray through its centre, (P,): positive where seen from behind.

        It is computed in the camera's axes, in which the rays are the same for every view.
        """
        camera = Camera.of(view, self._spec)
        if self._rays is None:
            x, y, z = np.eye(3)
            rays = replace(camera, right=x, down=y, forward=z).rays()
            self._rays = np.ascontiguousarray(rays.reshape(-1, 3).T)  # (3, P)
        axes = camera.world_to_camera[:, :3].astype(np.float32)
        cosine: NDArray[np.float32] = (axes @ normal.reshape(-1, 3).astype(np.float32).T * self._rays).sum(axis=0)
        return cosine


def is_constant(half: NDArray[Any]) -> bool:
    """Whether all pixels of an image (H, W, 3) are equal: it then has no noise, and does not depend on the seed."""
    return bool((half == half[0, 0]).all())


def is_finite(values: NDArray[Any]) -> bool:
    """Whether no value of an array of floats is NaN or infinite."""
    return largest(values) < _FLOAT[values.dtype.itemsize][2]


def largest(values: NDArray[Any]) -> int:
    """The bits of the largest magnitude in an array of floats, 0 if all are zero; NaN is above infinity."""
    bits, magnitude, _ = _FLOAT[values.dtype.itemsize]
    return int((values.view(bits) & bits(magnitude)).max())
