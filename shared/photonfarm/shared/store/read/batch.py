"""Memory for a batch of samples in their stored types, reused for every batch, without a copy or conversion.

Shape letters: B batch, H W image, P points, K photon slots.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.core.records import F32, Guides, Visibility
from photonfarm.shared.scene.spec import SceneSpec
from photonfarm.shared.store.format import schema

GUIDE_NAMES = frozenset(field.name for field in fields(Guides))


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Samples in their stored types; `SceneReader.read_batch` fills it."""

    radiance_exponent: int
    radiance: NDArray[np.float16]  # (B, 2, H, W, 3) linear × 2^radiance_exponent, halves A and B; NaN: see `wide`
    buffers: dict[str, NDArray[Any]]  # depth (B, H, W) float32; albedo, normal (B, H, W, 3) float16; or none of them
    seen: dict[str, NDArray[np.uint8]]  # point_seen (B, ⌈P/8⌉), photon_seen (B, ⌈K/8⌉): bits; or none of them
    bits: dict[str, int]  # how many there are of each: P and K
    rows: NDArray[np.int64]  # (B,) row of each sample, of its view and of its modification
    view_rows: NDArray[np.int64]
    modification_rows: NDArray[np.int64]
    guides: dict[str, NDArray[Any]] = field(default_factory=dict)  # as `Guides` has them, (B, …); or none of them
    wide: dict[int, F32] = field(default_factory=dict)  # by place: (2, H, W, 3) unscaled, where float16 cannot hold it

    @classmethod
    def empty(cls, spec: SceneSpec, size: int, *, buffers: bool = True, guides: bool = False) -> Batch:
        """Memory for `size` samples of a scene; without memory for buffers, neither they nor visibility are read."""
        arrays = schema.output_arrays(spec)
        of_view = [name for name, array in arrays.items() if array.kind == "view"]
        names = [name for name in of_view if (guides if name in GUIDE_NAMES else buffers)]
        memory = {name: np.empty((size, *arrays[name].shape), arrays[name].dtype) for name in ("radiance", *names)}
        bits = schema.bit_counts(spec)
        seen = {name: memory.pop(name) for name in bits if name in memory}
        of_guides = {name: memory.pop(name) for name in names if name in GUIDE_NAMES}
        rows = np.zeros((3, size), np.int64)
        radiance = memory.pop("radiance")
        return cls(spec.radiance_exponent, radiance, memory, seen, bits, rows[0], rows[1], rows[2], of_guides)

    def __len__(self) -> int:
        """The number of samples that it holds, or has memory for."""
        return len(self.rows)

    def first(self, count: int) -> Batch:
        """The first samples, in the same memory."""
        if count == len(self):
            return self
        rows = {name: getattr(self, name)[:count] for name in ("rows", "view_rows", "modification_rows")}
        buffers = {name: values[:count] for name, values in self.buffers.items()}
        seen = {name: values[:count] for name, values in self.seen.items()}
        guides = {name: values[:count] for name, values in self.guides.items()}
        return replace(self, radiance=self.radiance[:count], buffers=buffers, guides=guides, seen=seen, **rows)

    def linear(self, place: int) -> F32:
        """The radiance of one sample as it was rendered, (2, H, W, 3) linear, unscaled."""
        if place in self.wide:
            return self.wide[place]
        return self.radiance[place].astype(np.float32) * np.float32(2.0**-self.radiance_exponent)

    def visibility(self, place: int) -> Visibility:
        """Which points and photons the view of one sample sees, unpacked into new memory."""
        points, photons = (self._unpacked(name, place) for name in ("point_seen", "photon_seen"))
        return Visibility(points, photons)

    def _unpacked(self, name: str, place: int) -> NDArray[np.bool_]:
        count = self.bits[name]
        if not count:
            return np.zeros(0, np.bool_)
        return np.unpackbits(self.seen[name][place], count=count, bitorder="little").view(np.bool_)
