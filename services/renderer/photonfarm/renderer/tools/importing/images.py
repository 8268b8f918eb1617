"""Images of all depths, as they are read and written on the way. Letters: H W image, C channels."""

from __future__ import annotations

import io
import tempfile
from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow
from PIL import UnidentifiedImageError

from photonfarm.core.errors import SpecError

Pillow.MAX_IMAGE_PIXELS = None  # textures of 16384² are beyond it

Image = NDArray[np.float32]
"""Linear or encoded values (H, W, C), in [0, 1] but for light."""

_OF_FLOATS = (b"\x76\x2f\x31\x01", b"#?", b"PF", b"Pf")
"""How files of OpenEXR, Radiance and PFM begin."""

RGB_OF_XYZ = np.array([[3.24048, -1.53715, -0.498535], [-0.969256, 1.87599, 0.041556], [0.055648, -0.204043, 1.05731]])
"""Linear sRGB of CIE XYZ (ITU-R BT.709's primaries)."""


def decode(data: bytes, what: str, *, raw: bool = False) -> Image:
    """An encoded image of any depth as RGBA (H, W, 4), its values as they are stored; profiles of colour are ignored.

    Images of floats hold linear light, and their colours are encoded here, unless `raw`. Raises SpecError if an image
    cannot be decoded.
    """
    is_light = data.startswith(_OF_FLOATS)
    try:
        if is_light or (data.startswith(b"\x89PNG") and data[24:25] == b"\x10"):
            values = _decode_by_mitsuba(data)  # of which Pillow keeps 8 bits
        else:
            with Pillow.open(io.BytesIO(data)) as image:
                is_light = image.mode == "F"
                values = np.asarray(image if image.mode[0] in "IF" else image.convert("RGBA"), np.float32)
                values = values / np.float32({"F": 1, "I": 65535}.get(image.mode[0], 255))
    except (UnidentifiedImageError, RuntimeError) as error:  # which name addresses in memory and temporary files
        raise SpecError(f"{what}: is not a readable image: its format is not known, or it is cut off") from error
    except (OSError, ValueError, SyntaxError) as error:
        raise SpecError(f"{what}: is not a readable image: {error}") from error
    if values.ndim == 2:
        values = np.dstack([values, values, values, np.ones_like(values)])
    if is_light and not raw:
        values[..., :3] = encode(values[..., :3])
    return values


def _decode_by_mitsuba(data: bytes) -> Image:
    from photonfarm.renderer.scene.loading import threads_to_read_with

    with tempfile.NamedTemporaryFile() as file, threads_to_read_with():  # its streams of memory have no end
        file.write(data)
        file.flush()
        image = mi.Bitmap(mi.FileStream(file.name))
        made = image.convert(mi.Bitmap.PixelFormat.RGBA, mi.Struct.Type.Float32, image.srgb_gamma())
    return np.array(made, np.float32)


def linear(encoded: Image) -> Image:
    """The linear values of sRGB ones."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4).astype(np.float32)


def encode(values: Image) -> Image:
    """The sRGB values of linear ones, by the same curve above 1."""
    values = values.clip(0)
    return np.where(values <= 0.0031308, values * 12.92, 1.055 * values ** (1 / 2.4) - 0.055).astype(np.float32)


def save(values: Image, file: Path) -> Path:
    """Write numbers (H, W) or (H, W, 1), or sRGB colours (H, W, 3), as PNG; the file, whose ending may be another.

    It has 16 bits where 8 would round. Colours above 1 become OpenEXR, which is linear.
    """
    if values.ndim == 3 and values.shape[2] == 3 and values.max() > 1:
        return save_radiance(linear(values), file.with_suffix(".exr"))
    values = values.clip(0, 1)
    rounded = np.round(values * 255)
    fits = np.abs(values * 255 - rounded).max() < 1e-3
    stored = rounded.astype(np.uint8) if fits else np.round(values * 65535).astype(np.uint16)
    mi.Bitmap(np.ascontiguousarray(stored)).write(str(file))
    return file


def save_radiance(values: Image, file: Path) -> Path:
    """Write linear values without a bound, (H, W, 3), as OpenEXR."""
    from photonfarm.renderer.scene.loading import threads_to_read_with

    with threads_to_read_with():  # the encoder, too, waits for ever in a pool of one
        mi.Bitmap(np.ascontiguousarray(values, np.float32)).write(str(file))
    return file
