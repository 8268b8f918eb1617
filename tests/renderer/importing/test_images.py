"""Images of every depth, as they are read and written on the way."""

from __future__ import annotations

import io
import re
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image as Pillow

from photonfarm.core.errors import SpecError
from photonfarm.renderer.tools.importing import images


def written(values: np.ndarray, kind: str) -> bytes:
    """The file that Mitsuba makes of an image."""
    from photonfarm.renderer.scene.loading import threads_to_read_with

    stream = mi.MemoryStream()
    with threads_to_read_with():
        mi.Bitmap(values).write(stream, getattr(mi.Bitmap.FileFormat, kind))
    stream.seek(0)
    return bytes(stream.read(stream.size()))


def encoded_as(kind: str) -> bytes:
    """Two texels in a file, 0.25 and 0.75 of each channel."""
    file = io.BytesIO()
    eight, sixteen = (np.array([[0.25, 0.75]]) * most for most in (255, 65535))
    if kind in ("PNG 16", "TIFF 16"):
        Pillow.fromarray(sixteen.astype(np.uint16)).save(file, kind[:-3])
    elif kind == "PNG 16 RGB":
        return written(np.dstack([sixteen] * 3).astype(np.uint16), "PNG")
    elif kind in ("OpenEXR", "RGBE"):
        return written(images.linear(np.dstack([np.array([[0.25, 0.75]], np.float32)] * 3)), kind)
    elif kind == "TIFF F":
        Pillow.fromarray(images.linear(np.array([[0.25, 0.75]], np.float32))).save(file, "TIFF")
    else:
        form, mode = kind.split()
        Pillow.fromarray(eight.astype(np.uint8)).convert("RGB").convert(mode).save(file, form)
    return file.getvalue()


EIGHT = ("PNG L", "PNG LA", "PNG P", "PNG RGBA", "JPEG L", "JPEG CMYK", "WEBP RGB", "GIF P", "BMP L", "TGA RGB")
OTHERS = ("PNG 16", "PNG 16 RGB", "TIFF 16", "TIFF F", "OpenEXR", "RGBE")


@pytest.mark.parametrize("kind", EIGHT + OTHERS)
def test_images_of_every_depth_have_their_values(kind: str) -> None:
    image = images.decode(encoded_as(kind), "it")
    assert image.shape == (1, 2, 4)
    assert np.allclose(image[0, :, :3], [[0.25] * 3, [0.75] * 3], atol=0.06)
    assert (image[..., 3] == 1).all()


@pytest.mark.parametrize("data", [b"", b"no image", b"#?RADIANCE", b"PF\n3 3\n-1\nabc", b"\x76\x2f\x31\x01\x02\0\0\0"])
def test_what_is_no_image_or_cut_off_is_told_without_addresses_and_temporary_files(data: bytes) -> None:
    with pytest.raises(SpecError, match=r"^it: is not a readable image: ") as raised:
        images.decode(data, "it")
    assert not re.search(r"0x|MemoryStream|/tmp", str(raised.value))


def test_images_keep_their_depth_when_they_are_written(tmp_path: Path) -> None:
    fine = np.linspace(0, 1, 1001, dtype=np.float32).reshape(1, -1, 1) * np.ones((1, 1, 3), np.float32)
    for values, most in (
        (fine, 1e-5),
        (np.round(fine * 255) / 255, 1e-6),
        (images.encode(3 * images.linear(fine)), 2e-3),
    ):
        file = images.save(values, tmp_path / "it.png")
        assert np.abs(images.decode(file.read_bytes(), "it")[..., :3] - values).max() < most
    assert Pillow.MAX_IMAGE_PIXELS is None  # so that textures of 16384² are read
