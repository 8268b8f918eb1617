"""Mean squared errors of display values.

Shape letters: N images, H W image.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from photonfarm.trainer.metrics.metric_space import check_pairs


def mse(
    predictions: Tensor, references: Tensor, other_halves: Tensor | None = None, *, having_seen_a: bool = False
) -> NDArray[np.float64]:
    """Mean squared difference of each pair of display images, 2 × (N, H, W, 3) → (N,) [supplement 4].

    With references in two independent halves it is mean (f − A)(f − B), whose noise averages to nothing; the remaining
    bias is the shift of their noise by the display's curve, of second order. It may be negative below the noise. For
    predictions that depend on a part of A it is mean f² − 2fB + AB, as in `clean_error_having_seen_a`. Raises
    ValueError for shapes that do not match.
    """
    halves = references, references if other_halves is None else other_halves
    for half in halves:
        check_pairs(predictions, half)
    f, a, b = (images.double() for images in (predictions, *halves))
    product = f * (f - 2 * b) + a * b if having_seen_a else (f - a) * (f - b)
    errors: NDArray[np.float64] = product.mean((1, 2, 3)).cpu().numpy()
    return errors
