"""Image files: PNG, GIF, and MP4 if the extra `video` (imageio-ffmpeg) is installed. For display only.

Shape letters: H W image.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterable
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import IO

import numpy as np

from photonfarm.core.errors import StoreError, store_errors
from photonfarm.core.pictures import Picture, display
from photonfarm.core.records import F32

FFMPEG = "imageio_ffmpeg"
PICTURE_WIDTH = 256  # px, at least


def enlarge(exposed: F32) -> Picture:
    """Exposed linear radiance, (H, W, 3), as a display shows it; the pixels of a small image are enlarged."""
    scale = max(1, -(-PICTURE_WIDTH // exposed.shape[1]))
    return display(exposed, 1.0).repeat(scale, axis=0).repeat(scale, axis=1)


def write_png(picture: Picture, file: Path) -> None:
    """Write one picture, (H, W, 3)."""
    from PIL import Image

    with store_errors("write the picture", file):
        Image.fromarray(picture).save(file, "PNG")


def read_png(file: Path) -> Picture:
    """Read a picture that `write_png` wrote."""
    from PIL import Image

    with store_errors("read the picture", file), Image.open(file) as image:
        return np.asarray(image)


def write_gif(pictures: Iterable[Picture], file: Path, fps: float) -> None:
    """Write an animation that repeats for ever, with 256 colours a picture; GIF rounds times to hundredths of a second.

    Pillow holds the pictures until it writes them, at a byte a pixel.
    """
    from PIL import Image

    images = (Image.fromarray(picture) for picture in pictures)
    with store_errors("write the animation", file):
        next(images).save(
            file,
            "GIF",
            save_all=True,
            append_images=images,
            duration=max(round(100 / fps), 2) * 10,
            loop=0,
            optimize=False,
        )


def can_write_mp4() -> bool:
    """Whether the package that contains ffmpeg is installed."""
    try:
        import_module(FFMPEG)
    except ImportError:
        return False
    return True


def write_mp4(pictures: Iterable[Picture], file: Path, fps: float) -> None:
    """Write a film, H.264 with 4:2:0 colour; odd sizes are made even by repeating the last column or row.

    One picture at a time is in memory. Raises StoreError if ffmpeg fails, with its last line.
    """
    coming = iter(pictures)
    first = next(coming)
    height, width = first.shape[:2]
    given = f"-f rawvideo -pix_fmt rgb24 -s {width + width % 2}x{height + height % 2} -r {fps:g} -i -".split()
    coded = ["-an", "-c:v", "libx264", "-crf", "16", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
    ffmpeg = import_module(FFMPEG).get_ffmpeg_exe()  # its own write_frames leaves pipes open
    command = [ffmpeg, "-loglevel", "error", "-y", *given, *coded, str(file)]
    with store_errors("write the film", file), tempfile.TemporaryFile() as log:
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=log) as process:
            if process.stdin is not None:
                _write_frames(chain([first], coming), process.stdin)
        log.seek(0)
        lines = log.read().decode(errors="replace").strip().splitlines() or [f"exit code {process.returncode}"]
    if process.returncode:
        raise StoreError(f"{file}: ffmpeg cannot write the film: {lines[-1]}")


def _write_frames(pictures: Iterable[Picture], pipe: IO[bytes]) -> None:
    """Write the pictures to the pipe until it is closed, and close it."""
    try:
        with pipe:
            for picture in pictures:
                height, width = picture.shape[:2]
                pipe.write(np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge").tobytes())
    except BrokenPipeError:  # ffmpeg has ended, and states why
        return
