"""What the parts of one frame cost on a machine, and what kind of surface each pixel shows, as one file.

The renderer measures and writes it, and reports read it, where no renderer may be. Shape letters: N rows of the store,
H W image, T timed frames, K sizes of image.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.core.archives import stored_arrays, write_arrays

PARTS = ("edit_s", "buffers_s", "guides_s", "points_s", "photons_s", "photons_seen_s")
"""What a network's frame needs besides samples, in the order in which it is made."""

_ARRAYS = {
    "rows": ("N", np.int64),
    "surface": ("NHW", np.uint8),
    **dict.fromkeys(PARTS, ("T", np.float64)),
    "kept": ("K", np.int64),
    "render_s": ("KT", np.float64),
}
"""Shape and type of each array."""


@dataclass(frozen=True, slots=True)
class Seconds:
    """Wall time of a piece of work that was timed several times."""

    median: float
    low: float  # below it are 10 % of the times, as far as so few tell
    high: float  # above it are 10 %

    @classmethod
    def of(cls, times: NDArray[np.float64]) -> Self:
        """Of some times, (T,); raises ValueError where there is none."""
        if not len(times):
            raise ValueError("times is empty; a median needs at least one")
        low, median, high = np.quantile(times, (0.1, 0.5, 0.9)).tolist()
        return cls(median, low, high)


class Surface(IntEnum):
    """The first surface that a ray meets between the near and the far plane, by how it scatters."""

    NOTHING = 0  # there is none
    DIFFUSE = 1  # diffuse lobes only; also behind a mask
    SPECULAR = 2  # a glossy lobe, or a diffuse one beside a mirror's: metals, and what is coated
    MIRROR = 3  # neither diffuse nor glossy: mirrors, clear glass, and surfaces that let everything through
    EMITTER = 4  # its shape emits, whatever else it does


@dataclass(frozen=True, slots=True, eq=False)
class FrameCosts:
    """Seconds of wall time on one core, for each of some timed frames; and the first surfaces of some rows.

    Raises ValueError for arrays of other shapes or types than these, empty ones, and kinds that are no `Surface`.
    """

    scene_id: str
    rows: NDArray[np.int64]  # (N,) of the store
    surface: NDArray[np.uint8]  # (N, H, W) a `Surface` at each pixel's centre
    edit_s: NDArray[np.float64]  # (T,) bringing the scene into the frame's configuration, from another one
    buffers_s: NDArray[np.float64]  # (T,) depth, albedo, normal
    guides_s: NDArray[np.float64]  # (T,) what is known of the view beside them, direct light above all
    points_s: NDArray[np.float64]  # (T,) which points of the base cloud, or of its first, as modified, the view sees
    photons_s: NDArray[np.float64]  # (T,) tracing photons; 0 in a scene without, as the next
    photons_seen_s: NDArray[np.float64]  # (T,) which photons the view sees
    kept: NDArray[np.int64]  # (K,) k: an image of about 1/k of the pixels
    render_s: NDArray[np.float64]  # (K, T) one half-estimate of it: `half_spp` samples of each of these pixels

    def __post_init__(self) -> None:
        sizes: dict[str, int] = {}
        for name, (letters, dtype) in _ARRAYS.items():
            array = getattr(self, name)
            fits = array.dtype == dtype and array.ndim == len(letters)
            if not fits or any(sizes.setdefault(s, n) != n for s, n in zip(letters, array.shape, strict=True)):
                wanted = f"{np.dtype(dtype)} ({', '.join(letters)})"
                raise ValueError(f"{name}: is {array.dtype} {array.shape}; {wanted} is required, with {sizes}")
        if empty := [letter for letter, size in sizes.items() if not size]:
            raise ValueError(f"{', '.join(empty)} is 0; at least 1 of each is required")
        if self.surface.max() > max(Surface):
            raise ValueError(f"surface: holds {self.surface.max()}; kinds up to {max(Surface)} are allowed")

    def parts(self) -> dict[str, Seconds]:
        """Of each part of a frame by its name in `PARTS`, over the timed frames."""
        return {name: Seconds.of(getattr(self, name)) for name in PARTS}

    def renders(self) -> dict[int, Seconds]:
        """Of a half-estimate of 1/k of the pixels by k, over the timed frames."""
        return {k: Seconds.of(times) for k, times in zip(self.kept.tolist(), self.render_s, strict=True)}

    def medians(self) -> dict[str, float]:
        """The medians of `parts`."""
        return {name: part.median for name, part in self.parts().items()}

    def render_medians(self) -> dict[int, float]:
        """The medians of `renders`."""
        return {k: render.median for k, render in self.renders().items()}

    def write(self, file: Path) -> None:
        """Store them as a NumPy archive, whole or not at all; raises StoreError where the disk refuses."""
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        write_arrays(file, {"scene_id": np.array(self.scene_id), **arrays}, "frame costs")

    @classmethod
    def read(cls, file: Path) -> Self:
        """What `write` has stored; raises StoreError for anything else."""
        with stored_arrays(file, "frame costs", "measure-frames") as stored:
            return cls(str(stored["scene_id"]), **{name: stored[name] for name in _ARRAYS})
