"""Images side by side, with captions and numbers.

Shape letters: N lines, H W image.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.records import F32
from photonfarm.trainer.predict.animation import enlarge

if TYPE_CHECKING:
    from PIL import Image

GAP = 4
LINE = 16  # height of a caption

Column = tuple[str, F32, NDArray[np.float64] | None]
"""A caption, images (N, H, W, 3) linear radiance × exposure, and a number for each or none."""


def mosaic(columns: Sequence[Column]) -> Image.Image:
    """Images side by side, N lines of them, the column's caption above and each image's number below it."""
    from PIL import Image, ImageDraw

    count = len(columns[0][1])
    height, width = enlarge(columns[0][1][0]).shape[:2]
    across, down = width + GAP, height + LINE
    whole = Image.new("RGB", (GAP + across * len(columns), LINE + GAP + down * count), "white")
    draw = ImageDraw.Draw(whole)
    for place, (caption, images, numbers) in enumerate(columns):
        x = GAP + across * place
        draw.text((x, 2), caption, fill="black")
        for line, image in enumerate(images):
            y = LINE + GAP + down * line
            whole.paste(Image.fromarray(enlarge(image)), (x, y))
            if numbers is not None:
                draw.text((x, y + height + 1), f"{numbers[line]:.4f}", fill="black")
    return whole
