"""Mean structural similarity: Wang et al., Image quality assessment, 2004 [supplement 4].

Shape letters: N images, H W image, C channels.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from photonfarm.trainer.metrics.metric_space import check_pairs

WINDOW = 11  # pixels
SIGMA = 1.5  # pixels
C1, C2 = 0.01**2, 0.03**2  # (K · data range)², the data range being 1


def mssim(predictions: Tensor, references: Tensor) -> NDArray[np.float64]:
    """SSIM of each pair of display images averaged over windows and channels, 2 × (N, H, W, 3) → (N,).

    Windows are 11×11 Gaussians of σ 1.5 that lie in the image whole; variances are those of the population; colour
    channels are compared one by one. 1 is equality. Raises ValueError for images smaller than a window.
    """
    check_pairs(predictions, references)
    if min(predictions.shape[1:3]) < WINDOW:
        size = "×".join(map(str, predictions.shape[1:3]))
        raise ValueError(f"images are {size} pixels; MSSIM needs at least {WINDOW}×{WINDOW}, the size of its window")
    x, y = (images.movedim(-1, 1).double() for images in (predictions, references))
    mean_x, mean_y, square_x, square_y, product = (_blurred(image) for image in (x, y, x * x, y * y, x * y))
    variance_x, variance_y, covariance = square_x - mean_x**2, square_y - mean_y**2, product - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + C1) / (mean_x**2 + mean_y**2 + C1)
    structure = (2 * covariance + C2) / (variance_x + variance_y + C2)  # and contrast: C3 = C2 / 2
    similarity: NDArray[np.float64] = (luminance * structure).mean((1, 2, 3)).cpu().numpy()
    return similarity


def _blurred(images: Tensor) -> Tensor:
    """Gaussian means over whole windows: (N, C, H, W) → (N, C, H − 10, W − 10).

    Rows, then columns, as sums of shifted images: a seventh of the time of float64 convolutions on a CPU.
    """
    weight = [math.exp(-((i - WINDOW // 2) ** 2) / (2 * SIGMA**2)) for i in range(WINDOW)]
    for axis in (2, 3):
        room = images.shape[axis] - WINDOW + 1
        blurred = torch.zeros_like(images.narrow(axis, 0, room))
        for i, w in enumerate(weight):
            blurred.add_(images.narrow(axis, i, room), alpha=w / sum(weight))
        images = blurred
    return images
