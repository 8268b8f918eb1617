"""Mean squared errors of what a display shows.

Shape letters: N images, H W image.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from photonfarm.trainer.metrics.metric_space import check_pairs


def mse(predictions: Tensor, references: Tensor) -> NDArray[np.float64]:
    """Mean squared difference of each pair of display images, 2 × (N, H, W, 3) → (N,) [supplement 4].

    The display's curve is not linear, so that noise of a reference cannot be taken out of it: references are to be
    converged. The error in linear radiance needs none (`evaluation.measure`).
    """
    check_pairs(predictions, references)
    errors: NDArray[np.float64] = (predictions.double() - references.double()).square().mean((1, 2, 3)).cpu().numpy()
    return errors
