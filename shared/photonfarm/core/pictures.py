"""Arrays as pictures that a person can look at, and pictures side by side.

For display only: nothing here is on the way to the store. Shape letters: H W image.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import store_errors
from photonfarm.core.records import F32

Picture = NDArray[np.uint8]  # (H, W, 3)

GAMMA = 2.2

EXACT = 96
"""The width up to which pictures are in pages without loss."""

V = TypeVar("V", np.uint8, np.float32)


def display_values(exposed: F32) -> F32:
    """clip(I, 0, 1)^(1/2.2) of exposed linear radiance, in any shape: what a display is given, in [0, 1]."""
    shown: F32 = np.clip(exposed, 0, 1) ** np.float32(1 / GAMMA)
    return shown


def display(radiance: F32, exposure: float) -> Picture:
    """Linear radiance (H, W, 3) as clip(exposure · I, 0, 1)^(1/2.2)."""
    return _bytes(display_values(exposure * np.nan_to_num(radiance)))


def draw_albedo(albedo: F32) -> Picture:
    """Reflectance (H, W, 3) in [0, 1], gamma 2.2."""
    return _bytes(display_values(albedo))


def draw_normal(normal: F32) -> Picture:
    """World normals (H, W, 3) as colours: −1…1 becomes 0…255."""
    return _bytes(0.5 + 0.5 * np.clip(normal, -1, 1))


def draw_depth(depth: F32) -> Picture:
    """Depth (H, W) in greys, near bright; 0 (nothing hit) is black."""
    hit = depth > 0
    far = np.percentile(depth[hit], 99) if hit.any() else 1.0
    return _bytes(np.repeat((hit * (1 - 0.9 * np.clip(depth / far, 0, 1)))[..., None], 3, axis=2))


CONTRAST = 4
"""The factor by which differences are stronger in pictures."""


def draw_difference(exposed: F32, wanted: F32) -> Picture:
    """Two exposed images (H, W, 3) compared as a display shows them: red too bright, blue too dark, white equal."""
    off = CONTRAST * (display_values(exposed) - display_values(wanted)).mean(axis=-1)
    colour = 1 - np.stack([np.maximum(-off, 0), np.abs(off), np.maximum(off, 0)], axis=-1)
    return _enlarge(_bytes(np.clip(colour, 0, 1)))


def reduce_image(image: NDArray[V], most: int) -> NDArray[V]:
    """An image (H, W, C) of at most `most` pixels along each side: means over blocks, less a rest at the edges."""
    by = -(-max(image.shape[:2]) // most)
    if by == 1:
        return image
    height, width = (side // by for side in image.shape[:2])
    blocks = image[: height * by, : width * by].reshape(height, by, width, by, -1)
    return blocks.mean(axis=(1, 3)).astype(image.dtype)


def data_uri(picture: Picture, most: int | None = None) -> str:
    """The picture as a `data:` address: PNG, or WebP if it is wider than `EXACT`; of at most `most` pixels a side."""
    from PIL import Image

    stream = io.BytesIO()
    shown = picture if most is None else reduce_image(picture, most)
    kind = "PNG" if shown.shape[1] <= EXACT else "WEBP"
    Image.fromarray(shown).save(stream, kind, quality=90)
    return f"data:image/{kind.lower()};base64,{base64.b64encode(stream.getvalue()).decode()}"


PICTURE_WIDTH = 256  # px, at least


def enlarge(exposed: F32) -> Picture:
    """Exposed linear radiance, (H, W, 3), as a display shows it; the pixels of a small image are enlarged."""
    return _enlarge(display(exposed, 1.0))


def _enlarge(picture: Picture) -> Picture:
    scale = max(1, -(-PICTURE_WIDTH // picture.shape[1]))
    return picture.repeat(scale, axis=0).repeat(scale, axis=1)


def write_png(picture: Picture, file: Path) -> None:
    """Write one picture, (H, W, 3)."""
    from PIL import Image

    with store_errors("write the picture", file):
        Image.fromarray(picture).save(file, "PNG")


def _bytes(unit: NDArray[np.floating]) -> Picture:
    return np.round(255 * unit).astype(np.uint8)


GAP = 8  # px between the pictures of a sheet
TEXT, LEADING = 14, 4  # px of letters, and between two lines of them
LINE = TEXT + LEADING  # px of a line of text


def draw_sheet(
    heads: Sequence[str], rows: Sequence[Sequence[Picture]], captions: Sequence[str], text: int = TEXT
) -> Picture:
    """Pictures of one size in rows, a head above each column and a caption above each row; letters of `text` px.

    Heads are broken into lines after blanks and underscores; a row with an empty caption has no line for it.
    """
    from PIL import Image, ImageDraw, ImageFont

    height, width = rows[0][0].shape[:2]
    font, line = ImageFont.load_default(text), text + LEADING
    wrapped = [_wrap(head, int(width // font.getlength("n"))) for head in heads]
    top = max(map(len, wrapped)) * line + GAP
    steps = [height + GAP + (line if caption else 0) for caption in captions]
    sheet = Image.new("RGB", (len(heads) * (width + GAP) - GAP, top + sum(steps) - GAP), "white")
    draw = ImageDraw.Draw(sheet)
    for column, lines in enumerate(wrapped):
        draw.multiline_text((column * (width + GAP), 0), "\n".join(lines), "black", font, spacing=LEADING)
    for row, caption, step in zip(rows, captions, steps, strict=True):
        draw.text((0, top), caption, "black", font)
        for column, picture in enumerate(row):
            sheet.paste(Image.fromarray(picture), (column * (width + GAP), top + step - height - GAP))
        top += step
    return np.asarray(sheet)


def _wrap(head: str, letters: int) -> list[str]:
    """The lines of a head, of at most so many letters each where its parts allow."""
    lines = [""]
    for part in re.findall("[^_ ]+[_ ]?", head):
        if lines[-1] and len(lines[-1] + part.rstrip()) > letters:
            lines.append("")
        lines[-1] += part
    return lines
