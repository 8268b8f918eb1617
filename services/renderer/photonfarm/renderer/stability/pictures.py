"""Pictures of outcomes, to look at: bdpt, truth and where they differ.

Shape letters: K renders, H W image, B blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from photonfarm.shared.pictures import Picture, display

from .runner import Outcome, Renders

SIDE = 96
"""Pixels of one picture's side on the sheet."""
_LABEL, _GAP, _COLUMNS = 14, 8, 3


def triple(renders: Renders, z_limit: float) -> Picture:
    """(SIDE, 3·SIDE, 3): the mean of bdpt, the truth, and the blocks' z (red: bdpt is brighter, blue: darker)."""
    bdpt, truth = (np.mean(images, axis=0).astype(np.float32) for images in (renders.bdpt, renders.truth))
    exposure = 0.9 / max(float(np.percentile(truth, 98)), 1e-12)
    parts = (display(bdpt, exposure), display(truth, exposure), of_z(renders.z, z_limit))
    return np.concatenate([_resized(part) for part in parts], axis=1)


def of_z(z: npt.NDArray[np.float64], limit: float) -> Picture:
    """(B, B, 3): white where z is 0, full red or blue at the limit."""
    strength = np.clip(np.nan_to_num(z) / limit, -1, 1)
    red, blue = np.maximum(strength, 0), np.maximum(-strength, 0)
    return np.round(255 * np.stack([1 - blue, 1 - red - blue, 1 - red], axis=-1)).astype(np.uint8)


def sheet(outcomes: Sequence[tuple[str, Picture]]) -> Any:
    """One image (PIL) with all labelled triples, in reading order."""
    from PIL import Image, ImageDraw

    width, height = 3 * SIDE + _GAP, SIDE + _LABEL + _GAP
    lines = -(-len(outcomes) // _COLUMNS)
    whole = Image.new("RGB", (_COLUMNS * width, max(lines, 1) * height), "white")
    draw = ImageDraw.Draw(whole)
    for k, (label, picture) in enumerate(outcomes):
        x, y = k % _COLUMNS * width, k // _COLUMNS * height
        draw.text((x, y), label, fill="black")
        whole.paste(Image.fromarray(picture), (x, y + _LABEL))
    return whole


def keep(outcome: Outcome, folder: Path) -> Path:
    """Write the renders [K, H, W, 3] as .npy and the triple as .png into a folder of this outcome; returns it."""
    from PIL import Image

    own = folder / f"{outcome.result.label}_{outcome.result.settings}"
    own.mkdir(parents=True, exist_ok=True)
    if outcome.renders is not None:
        np.save(own / "bdpt.npy", outcome.renders.bdpt)
        np.save(own / "truth.npy", outcome.renders.truth)
        Image.fromarray(triple(outcome.renders, outcome.result.z_limit or 1.0)).save(own / "bdpt_truth_z.png")
    (own / "result.txt").write_text(f"{outcome.result}\n", encoding="utf-8")
    return own


def _resized(picture: Picture) -> Picture:
    from PIL import Image

    return np.asarray(Image.fromarray(picture).resize((SIDE, SIDE), Image.Resampling.NEAREST))
