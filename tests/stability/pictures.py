"""Pictures of outcomes: bdpt, the truth and their difference.

Shape letters: K renders, H W image, B blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from photonfarm.core.pictures import Picture, display
from tests.stability.runner import Renders, SceneOutcome

SIDE = 96
"""The pixels of one picture's side on the sheet."""
FULL_Z = 5.0
"""The |z| that is shown in full colour; the limits lie a little above."""
_LABEL, _GAP, _COLUMNS = 14, 8, 3
_WIDTH, _HEIGHT = 3 * SIDE + _GAP, SIDE + _LABEL + _GAP  # of a labelled triple
_LEGEND = 56  # pixels above the triples
_NOT_A_NUMBER = (0, 0, 0)


def triple(renders: Renders) -> Picture:
    """(SIDE, 3·SIDE, 3): the mean of bdpt, the truth, and the blocks' z (red: bdpt is brighter, blue: darker)."""
    bdpt, truth = (np.mean(images, axis=0).astype(np.float32) for images in (renders.bdpt, renders.truth))
    exposure = 0.9 / max(float(np.percentile(truth, 98)), 1e-12)
    parts = (display(bdpt, exposure), display(truth, exposure), of_z(renders.z))
    return np.concatenate([_resized(part) for part in parts], axis=1)


def of_z(z: npt.NDArray[np.float64]) -> Picture:
    """Colours (…, 3) of z (…): white at 0, full red at `FULL_Z`, full blue at −`FULL_Z`, black for NaN."""
    strength = np.clip(np.nan_to_num(z) / FULL_Z, -1, 1)
    red, blue = np.maximum(strength, 0), np.maximum(-strength, 0)
    colours = np.round(255 * np.stack([1 - blue, 1 - red - blue, 1 - red], axis=-1)).astype(np.uint8)
    colours[np.isnan(z)] = _NOT_A_NUMBER
    return colours


def sheet(outcomes: Sequence[tuple[str, Picture]]) -> Any:
    """One image (PIL): the legend, then all labelled triples in reading order."""
    from PIL import Image, ImageDraw

    lines = -(-len(outcomes) // _COLUMNS)
    whole = Image.new("RGB", (_COLUMNS * _WIDTH, _LEGEND + max(lines, 1) * _HEIGHT), "white")
    _draw_legend(whole)
    draw = ImageDraw.Draw(whole)
    for k, (label, picture) in enumerate(outcomes):
        x, y = k % _COLUMNS * _WIDTH, _LEGEND + k // _COLUMNS * _HEIGHT
        draw.text((x, y), label, fill="black")
        whole.paste(Image.fromarray(picture), (x, y + _LABEL))
    return whole


def _draw_legend(whole: Any) -> None:
    """Draw the legend: the three parts of a triple, and the colours of z from −`FULL_Z` to `FULL_Z`."""
    from PIL import Image, ImageDraw, ImageFont

    draw, font = ImageDraw.Draw(whole), ImageFont.load_default(size=15)
    # Pillow's own font has no minus sign
    draw.text((_GAP, 4), "Each scene: bdpt | truth | z of each block = (bdpt - truth) / standard error", "black", font)
    darker, brighter = f"bdpt is darker  -{FULL_Z:g}", f"+{FULL_Z:g}  brighter; black: not a number"
    bar = of_z(np.tile(np.linspace(-FULL_Z, FULL_Z, 2 * SIDE), (_LABEL, 1)))
    x = 2 * _GAP + round(draw.textlength(darker, font))
    draw.text((_GAP, 27), darker, "black", font)
    whole.paste(Image.fromarray(bar), (x, 30))
    draw.rectangle((x - 1, 29, x + bar.shape[1], 30 + bar.shape[0]), outline="black")
    draw.text((x + bar.shape[1] + _GAP, 27), brighter, "black", font)


def keep(outcome: SceneOutcome, folder: Path) -> Path:
    """Write the renders [K, H, W, 3] as .npy and the triple as .png into a folder of this outcome; returns it."""
    from PIL import Image

    own = folder / f"{outcome.result.label}_{outcome.result.settings}"
    own.mkdir(parents=True, exist_ok=True)
    if outcome.renders is not None:
        np.save(own / "bdpt.npy", outcome.renders.bdpt)
        np.save(own / "truth.npy", outcome.renders.truth)
        Image.fromarray(triple(outcome.renders)).save(own / "bdpt_truth_z.png")
    (own / "result.txt").write_text(f"{outcome.result}\n", encoding="utf-8")
    return own


def _resized(picture: Picture) -> Picture:
    from PIL import Image

    return np.asarray(Image.fromarray(picture).resize((SIDE, SIDE), Image.Resampling.NEAREST))
