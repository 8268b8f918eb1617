"""The overview: rows of pictures as one file, as README shows them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from photonfarm.shared.core.pictures import Picture
from photonfarm.trainer.report.views import ShownView

OVERVIEW = "overview.png"
WIDTH = 192  # px, of each picture
GAP = 6  # px between them
TITLE = 26  # px, the height of the line above them
LAYERS = 4  # of each view: noisy half, prediction, target, difference


def overview(views: Sequence[ShownView]) -> Picture:
    """The views as rows, best first, with titles above; small images are enlarged by Lanczos' filter."""
    ordered = sorted(views, key=lambda view: view.mse)
    lines = [np.concatenate([_framed(layer.picture) for layer in view.images[:LAYERS]], axis=1) for view in ordered]
    sheet = np.concatenate(lines)[:-GAP, :-GAP]
    return np.concatenate([_titles([layer.name for layer in ordered[0].images[:LAYERS]], sheet.shape[1]), sheet])


def _titles(titles: Sequence[str], width: int) -> Picture:
    """A line of titles, each at the left of its column."""
    from PIL import Image, ImageDraw, ImageFont

    line = Image.new("RGB", (width, TITLE), "white")
    for column, title in enumerate(titles):
        left = column * (width + GAP) // len(titles)
        ImageDraw.Draw(line).text((left, 3), title, "#222222", ImageFont.load_default(size=16))
    return np.asarray(line)


def _framed(picture: Picture) -> Picture:
    """The picture at the width of the columns, with a white margin to the right and below."""
    from PIL import Image

    height = round(WIDTH * picture.shape[0] / picture.shape[1])
    scaled = Image.fromarray(picture).resize((WIDTH, height), Image.Resampling.LANCZOS)
    framed: Picture = np.pad(np.asarray(scaled), ((0, GAP), (0, GAP), (0, 0)), constant_values=255)
    return framed
