"""Images changed on the way: channels taken out, factors multiplied in. Letters: H W image."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.core.errors import SpecError

Image = NDArray[np.float32]
"""Linear or encoded values in [0, 1], (H, W, 4)."""


def decoded(data: bytes, what: str) -> Image:
    """An encoded image as RGBA, its values as they are stored; raises SpecError if it cannot be decoded."""
    from PIL import Image as Pillow

    try:
        with Pillow.open(io.BytesIO(data)) as image:
            return np.asarray(image.convert("RGBA"), np.float32) / np.float32(255)
    except (OSError, ValueError, SyntaxError) as error:
        raise SpecError(f"{what}: is not a readable image: {error}") from error


def linear(encoded: Image) -> Image:
    """The linear values of sRGB ones."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4).astype(np.float32)


def encoded(values: Image) -> Image:
    """The sRGB values of linear ones."""
    values = values.clip(0, 1)
    return np.where(values <= 0.0031308, values * 12.92, 1.055 * values ** (1 / 2.4) - 0.055).astype(np.float32)


def tinted(image: Image, factor: Sequence[float]) -> Image:
    """An sRGB image with a linear factor for each of its colours."""
    return encoded(linear(image[..., :3]) * np.array(factor[:3], np.float32))


def save(values: Image, file: Path) -> Path:
    """Write values in [0, 1], (H, W) or (H, W, 3), as PNG."""
    from PIL import Image as Pillow

    Pillow.fromarray((values.clip(0, 1) * 255 + 0.5).astype(np.uint8)).save(file)
    return file


def save_radiance(values: Image, file: Path) -> Path:
    """Write linear values without a bound, (H, W, 3), as OpenEXR."""
    import mitsuba as mi

    from photonfarm.renderer.scene.loading import threads_to_read_with

    with threads_to_read_with():  # the encoder, too, waits for ever in a pool of one
        mi.Bitmap(np.ascontiguousarray(values, np.float32)).write(str(file))
    return file
