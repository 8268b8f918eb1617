"""FLIP: how strongly a viewer who flips between two images sees them differ. Andersson et al., 2020.

Shape letters: N images, H W image.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from photonfarm.trainer.metrics.metric_space import check_pairs


def flip(predictions: Tensor, references: Tensor) -> NDArray[np.float64]:
    """Mean FLIP (low dynamic range) of each pair of display images, 2 × (N, H, W, 3) → (N,); 0 is equality, 1 the most.

    The authors' package computes it for its default viewer: 67 pixels per degree. It takes display values as sRGB.
    """
    from flip_evaluator import evaluate  # type: ignore[import-untyped]

    check_pairs(predictions, references)
    pairs = zip(predictions.float().cpu().numpy(), references.float().cpu().numpy(), strict=True)
    return np.array(
        [evaluate(reference, image, "LDR", applyMagma=False, parameters={})[1] for image, reference in pairs],
        np.float64,
    )
