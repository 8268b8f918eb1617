"""The pictures of several predictors side by side, one exposure for all.

Shape letters: H W image.
"""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

import numpy as np

from photonfarm.core.pictures import Picture
from photonfarm.trainer.compare.evaluation_samples import Target
from photonfarm.trainer.predict.animation import enlarged

if TYPE_CHECKING:
    from photonfarm.trainer.compare.evaluate import Evaluation

from collections.abc import Iterable, Sequence


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """The head, a rule and the rows, a line each; raises ValueError for a row of another number of cells."""
    lines = [head, ["---"] * len(head), *rows]
    if wrong := next((line for line in lines if len(line) != len(head)), None):
        raise ValueError(f"a table of {len(head)} columns has a row of {len(wrong)} cells: {wrong}")
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


COMPARISON = "comparison.png"

TEXT = 14  # pixels, of the letters
LINE = 18  # pixels, from one line of text to the next
GAP = 8  # pixels, between pictures


def comparison(evaluation: Evaluation) -> Picture:
    """A column for the target and one for each predictor, a row for each of a few held-out samples.

    All are shown as clip(exposure · I, 0, 1)^(1/2.2) with the scene's own exposure; the head of each column names it.
    """
    from PIL import Image, ImageDraw, ImageFont

    cells = _cells(evaluation)
    height, width = cells[0][0].shape[:2]
    font = ImageFont.load_default(TEXT)
    letters = int(width // font.getlength("n"))
    heads = [
        textwrap.wrap(head, letters) for head in [_of_targets(evaluation.shown), *(row.name for row in evaluation.rows)]
    ]
    top = max(map(len, heads)) * LINE + GAP
    step = height + LINE + GAP  # each row has its own line of text
    sheet = Image.new("RGB", (len(heads) * (width + GAP) - GAP, top + len(cells) * step - GAP), "white")
    draw = ImageDraw.Draw(sheet)
    for column, head in enumerate(heads):
        draw.multiline_text((column * (width + GAP), 0), "\n".join(head), fill="black", font=font, spacing=LINE - TEXT)
    for place, (target, row) in enumerate(zip(evaluation.shown, cells, strict=True)):
        draw.text((0, top + place * step), f"row {target.row} of the store", fill="black", font=font)
        for column, picture in enumerate(row):
            sheet.paste(Image.fromarray(picture), (column * (width + GAP), top + place * step + LINE))
    return np.asarray(sheet)


def _cells(evaluation: Evaluation) -> list[list[Picture]]:
    """The pictures of each shown sample; black where a predictor could not be measured, after a repair."""
    found = []
    for target in evaluation.shown:
        images = [row.shown.get(target.row, np.zeros_like(target.image)) for row in evaluation.rows]
        found.append([enlarged(image) for image in (target.image, *images)])
    return found


def _of_targets(shown: tuple[Target, ...]) -> str:
    """The head of the first column."""
    fewest = min(target.spp for target in shown)
    if all(target.is_reference for target in shown):
        return f"reference, {fewest} samples per pixel or more"
    return f"target: mean of A and B, {fewest} samples per pixel, noisy"
