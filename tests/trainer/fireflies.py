"""What rare bright targets do to a pixel: by each loss, and by each optimiser under the unbiased one.

One weight, the pixel's value, is trained on noisy targets whose mean is 0.9. `least` has where each loss has its least,
on 400 000 targets, and `held_at` where an optimiser of the trainer holds the pixel under the squared error. The
figures of docs/results/networks.md were made so.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from photonfarm.trainer.runs.settings import TrainSettings
from photonfarm.trainer.training.learner import build_optimiser

MEAN = 0.9
COUNTS = (4, 16, 256)  # samples a target
TARGETS = 400_000
EPSILON = 0.01  # of the weights 1 / (x² + ε)

RARITY, BRIGHT, DIM = 1e-4, 3000.0, 0.6  # the optimisers' pixel: 0.6, and rarely 3000: 0.6 + 1e-4 · 3000 = 0.9
TARGETS_PER_STEP = (1, 16, 256)
BLOCK = 1000  # steps drawn at a time


# --------------------------------------------------------------------------------------------------------------- losses


def noisy_targets(count: int, seed: int = 0) -> NDArray[np.float64]:
    """Targets of `count` samples each: exponential of mean 0.3, and 60 more with probability 0.01."""
    rng = np.random.default_rng(seed)
    return rng.gamma(count, 0.3 / count, TARGETS) + rng.binomial(count, 0.01, TARGETS) * 60 / count


def zero(gradient: Callable[[float], float]) -> float:
    """Where a function that is negative at 0 and positive at 10 is 0; by bisection."""
    low, high = 0.0, 10.0
    for _ in range(40):
        f = 0.5 * (low + high)
        low, high = (f, high) if gradient(f) < 0 else (low, f)
    return 0.5 * (low + high)


def clipped_gradient_rest(targets: NDArray[np.float64], norm: float = 1.0) -> float:
    """Where the mean of 2(f − t), each clipped at `norm`, is 0."""
    return zero(lambda f: float(np.clip(2 * (f - targets), -norm, norm).mean()))


def paired_rest(targets: NDArray[np.float64]) -> float:
    """Where the mean of (f − a) / (f² + b² + ε) is 0, over pairs of targets a and b, and b and a."""
    a, b = targets, np.roll(targets.reshape(-1, 2), 1, axis=1).reshape(-1)
    return zero(lambda f: float(((f - a) / (f**2 + b**2 + EPSILON)).mean()))


def undetached_least(targets: NDArray[np.float64]) -> float:
    """Least of mean (f − t)² / (f² + ε): the positive root of f² m + f (ε − E t²) − m ε, m = E t."""
    m, square = targets.mean(), (targets**2).mean()
    return float(np.roots([m, EPSILON - square, -m * EPSILON]).max())


def weighted_mean(targets: NDArray[np.float64]) -> float:
    """Least of mean (f − t)² / (t² + ε): the mean of t under that weight."""
    weight = 1 / (targets**2 + EPSILON)
    return float((weight * targets).sum() / weight.sum())


LEAST: dict[str, Callable[[NDArray[np.float64]], float]] = {
    "squared error; relative with detached weight": lambda t: float(t.mean()),
    "absolute error (L1)": lambda t: float(np.median(t)),
    "squared error of log(1 + x)": lambda t: float(np.expm1(np.log1p(t).mean())),
    "squared error after clip to 1 and gamma 2.2": lambda t: float((np.minimum(t, 1) ** (1 / 2.2)).mean() ** 2.2),
    "squared error, targets clamped at 1": lambda t: float(np.minimum(t, 1).mean()),
    "relative, weight from the noisy target": weighted_mean,
    "relative, weight from the prediction, not detached": undetached_least,
    "relative, weight from the prediction and from another noisy target": paired_rest,
    "squared error, gradient of each step clipped at 1 (Huber)": clipped_gradient_rest,
}
"""Each loss with the value of the pixel at which it is least."""


def least() -> dict[str, list[float]]:
    """Each loss's pixel at 4, 16 and 256 samples a target."""
    drawn = [noisy_targets(count) for count in COUNTS]
    return {name: [round(find(t), 4) for t in drawn] for name, find in LEAST.items()}


# ----------------------------------------------------------------------------------------------------------- optimisers


def held_at(settings: TrainSettings, steps: int, pixels: int, seed: int = 0) -> list[float]:
    """The mean value over the last half of `steps` of pixels that start at 0.9, for each of TARGETS_PER_STEP.

    All three and all pixels are one tensor: both optimisers treat each number for itself.
    """
    weight = torch.nn.Parameter(torch.full((len(TARGETS_PER_STEP), pixels), MEAN))
    optimiser = build_optimiser([weight], settings)
    weight.grad = torch.zeros_like(weight)
    rng = np.random.default_rng(seed)
    total = torch.zeros(len(TARGETS_PER_STEP))
    for start in range(0, steps, BLOCK):
        for target in _targets(rng, pixels):
            torch.sub(weight.detach(), target, out=weight.grad).mul_(2)
            optimiser.step()
            if 2 * start >= steps:
                total += weight.detach().mean(dim=1)
    summed = sum(BLOCK for start in range(0, steps, BLOCK) if 2 * start >= steps)
    return [round(v, 4) for v in (total / summed).tolist()]


def _targets(rng: np.random.Generator, pixels: int) -> Tensor:
    """A block of targets, (BLOCK, 3, pixels); each the mean of as many as a step has."""
    rows = [rng.binomial(n, RARITY, (BLOCK, pixels)) / n for n in TARGETS_PER_STEP]
    share = np.stack(rows, axis=1).astype(np.float32)
    return torch.from_numpy(DIM + share * np.float32(BRIGHT))
