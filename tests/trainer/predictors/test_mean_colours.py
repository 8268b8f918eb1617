"""The best predictions without any input, which reports compare with."""

import numpy as np
import torch

from photonfarm.trainer.data.batch import TrainingBatch
from photonfarm.trainer.networks.inputs import Inputs
from photonfarm.trainer.predictors.evaluation import BLOCK, average_colours, make_constant_predictor, measure


def batch(image: torch.Tensor) -> TrainingBatch:
    """One sample without noise."""
    inputs = Inputs(torch.zeros(1, 3, 4), *(torch.zeros(1, *image.shape[: 2 + of]) for of in (0, 1, 1)))
    return TrainingBatch((0,), (bytes(16),), inputs, torch.stack([image, image])[None])


def test_each_is_the_best_colour_by_its_own_error() -> None:
    """A lamp fills one of four blocks: it makes most of the mean, and little of the mean that a display shows."""
    image = torch.full((2 * BLOCK, 2 * BLOCK, 3), 0.2)
    image[:BLOCK, :BLOCK] = 100.0
    colour, shown = average_colours([np.stack([image, image])])
    np.testing.assert_allclose(colour, (100 + 3 * 0.2) / 4, rtol=1e-6)
    np.testing.assert_allclose(shown, (1 + 3 * 0.2) / 4, rtol=1e-6)
    of_colour, of_shown = (measure(make_constant_predictor(each), iter([batch(image)])) for each in (colour, shown))
    assert of_colour.error.mean < of_shown.error.mean
    assert of_shown.shown.mean() < of_colour.shown.mean()
