"""What rare bright targets do to a pixel: by each loss, and by each optimiser under the unbiased one.

    python -m bench.trainer.firefly [--pixels 512] [--out docs/results]

One weight, the pixel's value, is trained on noisy targets whose mean is 0.9. First: where each loss has its least, on
400 000 targets. Then: where Adam and RMSprop of the trainer hold the pixel under the squared error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bench.harness import results
from photonfarm.trainer.runs.settings import TrainSettings
from photonfarm.trainer.training.learner import build_optimiser

MEAN = 0.9
COUNTS = (4, 16, 256)  # samples a target
TARGETS = 400_000
EPSILON = 0.01  # of the weights 1 / (x² + ε)

RARITY, BRIGHT, DIM = 1e-4, 3000.0, 0.6  # the optimisers' pixel: 0.6, and rarely 3000: 0.6 + 1e-4 · 3000 = 0.9
TARGETS_PER_STEP = (1, 16, 256)
MOST_STEPS = 200_000
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


@dataclass(frozen=True, slots=True)
class Setting:
    """One optimiser."""

    name: str
    memory: float  # β₂ of Adam, α of RMSprop
    rate: float = 5e-4

    @property
    def settings(self) -> TrainSettings:
        """The same as settings of a training run."""
        key = "beta2" if self.name == "adam" else "alpha"
        return TrainSettings.model_validate({"optimiser": self.name, key: self.memory, "learning_rate": self.rate})

    @property
    def steps(self) -> int:
        """Four times its memory, at least enough for the pixel to come to rest, and at most MOST_STEPS."""
        return min(max(round(4 / (1 - self.memory)), 60_000), MOST_STEPS)


SETTINGS = [
    *(Setting("adam", beta2) for beta2 in (0.999, 0.9999, 0.99999)),
    Setting("adam", 0.999, rate=5e-5),
    *(Setting("rmsprop", alpha) for alpha in (0.99, 0.999, 0.9999, 0.99999)),
]


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


# ---------------------------------------------------------------------------------------------------------------- page


def losses_table(found: dict[str, list[float]]) -> str:
    header = ["loss", *(f"{count} samples a target" for count in COUNTS)]
    return results.table(header, [[name, *(f"{v:.2f}" for v in values)] for name, values in found.items()])


def optimisers_table(found: Sequence[dict[str, Any]]) -> str:
    header = ["optimiser", "rate", "β₂ or α", "steps", *(f"targets a step: {n}" for n in TARGETS_PER_STEP)]
    rows = [
        [f["optimiser"], f["rate"], f["memory"], f["steps"], *map(_cell, f["held_at"], _fireflies(f["memory"]))]
        for f in found
    ]
    return results.table(header, rows)


def _fireflies(memory: float) -> list[float]:
    """How many of a weight's fireflies the memory holds: targets a step × probability / (1 − memory)."""
    return [n * RARITY / (1 - memory) for n in TARGETS_PER_STEP]


def _cell(value: float, fireflies: float) -> str:
    return f"{value:.3f} ({fireflies:,.0f})" if fireflies >= 10 else f"{value:.3f} ({fireflies:.2g})"


def page(losses: dict[str, list[float]], optimisers: Sequence[dict[str, Any]]) -> str:
    return f"""# Fireflies: where losses and optimisers hold a pixel whose mean is 0.9

## Losses

Each target is the mean of a few samples: exponential ones of mean 0.3, and 60 more with probability 0.01. The value at
which each loss is least, over {TARGETS:,} targets (weights 1 / (x² + ε) with ε = {EPSILON:g}):

{losses_table(losses)}

Only what is linear in the target, but for weights that do not see its noise, ends at the mean: `loss = "linear"`,
`loss = "relative"`, and `loss = "paired"`, whose weights are from the prediction and the other half. The others are
refused. More samples a target make them less wrong, and never right.

## Optimisers, under the squared error

The squared error has the right least, and yet Adam does not hold the pixel there. Each target is 0.6, and 3000 with
probability 1e-4. Mean value of the pixel at rest, over the last half of the steps:

{optimisers_table(optimisers)}

In brackets: how many fireflies the running mean of squared gradients remembers, (targets a step) × 1e-4 / (1 − β₂).
Pixels start at 0.9; a memory of 100 000 steps is half of all, so that with one target a step they may still be moving.
Other seeds differ by about 0.003.

**Why.** Adam and RMSprop divide each weight's step by the root of the running mean of its squared gradients. A firefly
raises that root at the very step at which it pulls upwards, so that it pulls by no more than some ordinary steps; a
while later the root has forgotten it, and many ordinary steps pull downwards undivided. With few fireflies in memory
the pixel rests near 0.6, where it would be without any. A tenth of the rate leaves it dark too. RMSprop does what Adam
does at the same memory; its usual α = 0.99 is a tenth of Adam's β₂ = 0.999, and so it darkens more.

**What avoids it.** A memory that holds many fireflies of a weight, so that its divisor hardly changes when one comes:
with 10 in the brackets a few percent are missing, from 25 on less than one. So raise β₂ (`beta2` of the settings,
`alpha` for RMSprop) until 1 / (1 − β₂) steps see 25 of the rarest fireflies that matter: 0.9999 for one in 10 000 at 25
targets a step or more, 0.99999 at 3. Or average more targets in a step, by a larger batch or more samples a target.
Weights that see many pixels, as those of a convolution do, get thousands of targets a step and hardly suffer; those
that few pixels reach do first: descriptors of points, and whatever only a rare material uses. The price of a long
memory is that the large gradients of the first steps are remembered as long, and slow what follows. So the default
stays the supplement's 0.999, and a scene whose samples have fireflies, as caustics and glass make them, wants 0.9999
or more from the start of a long training."""


def main() -> None:
    parser = results.parser(__doc__)
    parser.add_argument("--pixels", type=int, default=512, help="independent pixels that are averaged")
    options = parser.parse_args()
    torch.set_num_threads(1)
    losses = least()
    optimisers = []
    for setting in SETTINGS:
        held = held_at(setting.settings, setting.steps, options.pixels)
        optimisers.append(
            {"optimiser": setting.name, "rate": setting.rate, "memory": setting.memory, "steps": setting.steps}
            | {"held_at": held}
        )
        print(optimisers[-1], flush=True)
    values = {"torch": torch.__version__, "mean": MEAN, "least": losses, "optimisers": optimisers}
    results.write("firefly", page(losses, optimisers), values, options.out)


if __name__ == "__main__":
    main()
