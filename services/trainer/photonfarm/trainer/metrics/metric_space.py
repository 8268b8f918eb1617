"""The metric space, in which images are compared: the values that a display would show [method §4, ours].

Shape letters: N images, H W image. Images are given as exposed linear radiance: radiance × the scene's fixed exposure.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from photonfarm.shared.core.errors import SpecError
from photonfarm.shared.core.pictures import display_values
from photonfarm.shared.core.records import F32


def metric_space(exposed: F32 | Tensor) -> Tensor:
    """clip(I, 0, 1)^(1/2.2) of exposed linear radiance, (N, H, W, 3) → float32 of the same shape in [0, 1].

    The exposure is fixed per scene: one derived from an image would hide errors of brightness. Infinite values become
    white. Raises ValueError for another shape, SpecError for values that are not numbers.
    """
    if isinstance(exposed, Tensor):
        exposed = exposed.detach().float().cpu().numpy()
    images = np.asarray(exposed, np.float32)
    if images.ndim != 4 or images.shape[-1] != 3:
        raise ValueError(f"images have the shape {images.shape}; metrics are taken of (N, H, W, 3)")
    if len(spoilt := np.flatnonzero(np.isnan(images).any(axis=(1, 2, 3)))):
        raise SpecError(
            f"image {int(spoilt[0])} of {len(images)} holds values that are not numbers, so it has no error; "
            "a network that gives them has diverged: take an earlier checkpoint"
        )
    return torch.from_numpy(display_values(images))


def check_pairs(predictions: Tensor, references: Tensor) -> None:
    """Raise ValueError unless both are as many images of the same size, one reference per prediction."""
    if predictions.shape != references.shape:
        raise ValueError(
            f"predictions have the shape {tuple(predictions.shape)} and references {tuple(references.shape)}; "
            "each prediction is compared with the reference of its own view"
        )
