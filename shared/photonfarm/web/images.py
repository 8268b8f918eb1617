"""Pictures and points of samples, as browsers take them. For display only.

Shape letters: H W image, N points.

Looks at the farm are shared by all who ask, browsers and scrapers. Each is kept for a hundred times as long as it took:
so whoever looks, and however large the store is, looking takes about a hundredth of a core.
"""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Callable
from typing import Generic, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from photonfarm.core import pictures
from photonfarm.core.pictures import Picture
from photonfarm.core.records import F32
from photonfarm.plan.sample_costs import FLOOR

POINT = np.dtype([("position", "<f4", 3), ("colour", "u1", 3), ("seen", "u1"), ("normal", "i1", 3), ("rest", "u1")])
"""A point as the script reads it: 20 bytes; normals are 127 long."""

NOISY = 1.0
"""The relative noise that is drawn brightest."""

_COLOURS = np.array([[59, 28, 107], [138, 39, 120], [217, 81, 78], [252, 166, 54], [247, 232, 122]], np.float64)
"""Stops of the colour scale of maps, from little to much."""

NORMALS = ("normal", "mean_normal", "beyond_normal")
REFLECTANCES = ("albedo", "specular", "throughput", "beyond_albedo")


def encode(picture: Picture, kind: Literal["PNG", "JPEG"] = "PNG") -> bytes:
    """A picture as a file's bytes: PNG is exact, and JPEG takes a tenth of the time."""
    from PIL import Image

    stream = io.BytesIO()
    image = Image.fromarray(picture)
    if kind == "JPEG":
        image.save(stream, "JPEG", quality=88)
    else:
        image.save(stream, "PNG", compress_level=3)
    return stream.getvalue()


def draw_array(name: str, values: F32, exposure: float) -> Picture:
    """A buffer or guide, (H, W) or (H, W, 3), by its name: normals, reflectances, distances, α, else radiance."""
    if name in NORMALS:
        return pictures.draw_normal(values)
    if name in REFLECTANCES:
        return pictures.draw_albedo(values)
    if name == "roughness":
        return np.repeat(np.round(255 * np.clip(values, 0, 1)).astype(np.uint8)[..., None], 3, axis=2)
    return pictures.draw_depth(values) if values.ndim == 2 else pictures.display(values, exposure)


def estimate_noise(halves: F32) -> F32:
    """Relative noise of the mean of A and B at each pixel, (H, W): a standard deviation over local brightness.

    Both are means over 3 × 3 pixels; (A − B)²/4 is the variance of (A + B)/2 in expectation.
    """
    a, b = halves.astype(np.float64)
    variance, bright = _smooth(((a - b) ** 2 / 4).mean(axis=2)), _smooth(((a + b) / 2).mean(axis=2))
    return (np.sqrt(variance) / (bright + FLOOR * max(bright.mean(), 1e-12))).astype(np.float32)


def draw_noise(halves: F32) -> Picture:
    """The noise map as a picture: dark without noise, bright where the noise is as large as the light."""
    place = np.clip(estimate_noise(halves) / NOISY, 0, 1) * (len(_COLOURS) - 1)
    stops = np.arange(len(_COLOURS))
    return np.stack([np.interp(place, stops, _COLOURS[:, i]) for i in range(3)], axis=2).round().astype(np.uint8)


def pack_points(position: F32, normal: F32, colour: Picture, seen: NDArray[np.bool_]) -> bytes:
    """Points (N, 3) with normals and colours (N, 3), and whether the view sees them (N,), as bytes."""
    points = np.zeros(len(position), POINT)
    points["position"], points["colour"], points["seen"] = position, colour, seen
    points["normal"] = np.round(127 * normal)
    return points.tobytes()


def colour_points(albedo: F32, emission: F32) -> Picture:
    """The colours (N, 3) of points: their reflectance, and white-hot where they emit."""
    return pictures.draw_albedo(np.clip(albedo + emission, 0, 1)[None])[0]


def colour_photons(power: F32) -> Picture:
    """The colours (N, 3) of photons: their power's, the brightest hundredth at full brightness."""
    bright = np.percentile(power.max(axis=1), 99) if len(power) else 1.0
    return pictures.display(power[None], 1 / max(float(bright), 1e-12))[0]


def _smooth(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """The mean over 3 × 3 pixels, edges repeated."""
    wide = np.pad(image, 1, mode="edge")
    rows = wide[:-2] + wide[1:-1] + wide[2:]
    mean: NDArray[np.float64] = (rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]) / 9
    return mean


LEAST_S = 2.0
"""The least seconds between two looks."""

SHARE = 0.01
"""The most of a core that looks take, on average."""

T = TypeVar("T")


class Cached(Generic[T]):
    """A value that is made anew now and then, so that making it takes at most SHARE of the time."""

    def __init__(
        self,
        make: Callable[[], T],
        *,
        clock: Callable[[], float] = time.monotonic,
        work: Callable[[], float] = time.thread_time,
    ) -> None:
        """Take the function that makes it; `work` counts the seconds of a core that this takes."""
        self._make, self._clock, self._work = make, clock, work
        self._lock = threading.Lock()
        self._due = 0.0
        self._value: T | None = None

    def get(self) -> T:
        """The value, made anew if that is due; raises what making it raises."""
        with self._lock:
            if self._value is None or self._clock() >= self._due:
                began = self._work()
                self._value = self._make()
                self._due = self._clock() + max(LEAST_S, (self._work() - began) / SHARE)
            return self._value
