"""Feature L1: the distance of two images in the averaged features of an Inception block [supplement 4, Fig. 5].

Shape letters: N images, C features.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonfarm.trainer.metrics.inception import Features

HEADLINE_BLOCK = 3
"""The block of the tables' column; Fig. 5 shows all four."""


def feature_l1(predictions: Features, references: Features) -> tuple[NDArray[np.float64], ...]:
    """Mean |f − g| over the C spatially averaged features of each pair of images: (N,) for each of the four blocks."""
    return tuple(
        np.abs(f.astype(np.float64) - g).mean(axis=1)
        for f, g in zip(predictions.blocks, references.blocks, strict=True)
    )
