"""What becomes of values that are stored as float16 or float32, and which radiance needs the latter."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.core.records import F32

NOISY_GUIDES = ("direct", "gloss", "point_light")
"""The guides that are sampled, with seeds of their own; they are rounded."""


def as_array(radiance: F32, exponent: int) -> tuple[str, NDArray[Any]]:
    """The array that a sample goes to, and its values: scaled, or unscaled if float16 cannot hold them."""
    with np.errstate(over="ignore", under="ignore"):
        scaled = radiance * np.float32(2.0**exponent)
    return ("radiance", scaled) if stays_finite(scaled, np.dtype(np.float16)) else ("radiance_wide", radiance)


def as_stored(radiance: F32, exponent: int) -> F32:
    """Radiance as readers give it once it is stored: rounded to float16 at the store's scale, if that can hold it."""
    name, values = as_array(radiance, exponent)
    return (
        values if name == "radiance_wide" else values.astype(np.float16).astype(np.float32) * np.float32(2.0**-exponent)
    )


def stays_finite(values: NDArray[Any], stored: np.dtype[Any]) -> bool:
    """Whether all values are finite in the type that they are stored in, to which the writer's thread rounds them.

    65504 is the largest float16 and 65520 the first number that rounds to infinity; likewise for float32. NaN is in no
    range.
    """
    if stored.kind != "f":
        return True
    end = {2: 65520.0, 4: 2.0**128 - 2.0**103}[stored.itemsize]
    return -end < float(values.min()) and float(values.max()) < end


def rounded(values: NDArray[Any]) -> F32:
    """Numbers rounded to 8 significant bits, to nearest with ties to even; noisy values need no more.

    The two lower bytes are then 0 and take no room once compressed. Finite values must not be within 0.4 % of the
    largest float32.
    """
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    to_even = (bits >> np.uint32(16)) & np.uint32(1)
    kept: F32 = ((bits + np.uint32(0x7FFF) + to_even) & np.uint32(0xFFFF0000)).view(np.float32)
    return kept
