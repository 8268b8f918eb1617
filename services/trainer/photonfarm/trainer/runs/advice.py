"""What a run's curves say is worth its seconds: more steps, more images, or a wider network.

The errors on held-out and on training samples are both the loss less that of the clean image, as the log has them
(`Learner.measure_excess`). That of training samples falls below 0 only for a network that has learned their noise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from photonfarm.core.waiting import format_span

Worth = Literal["fresh passes", "more steps", "more images", "a wider network"]

LEAST_GAIN = 0.05
"""The share of the held-out error that twice the steps or images must take off, so that either is worth it."""

LEARNED_BY_HEART = "learned by heart"
"""Why a run has ended that learned its samples by heart, and so got worse on others."""

BY_HEART = -0.1
"""The share of the held-out error below which a training error says that noise was learned: above it may be chance."""

LEAST_POINTS = 3
"""The validations of a slope."""


@dataclass(frozen=True, slots=True)
class Advice:
    """What is worth its seconds next, and why."""

    worth: Worth
    sentence: str


def advise(records: Sequence[Mapping[str, Any]], images_s: float | None = None) -> Advice | None:
    """Advice by the records of a run's log; None for fewer than three validations with an error above 0.

    Twice the steps multiply the held-out error by 2^slope, if it goes on as a power of the steps as since a quarter of
    them: at the end of a cosine it falls less, for want of rate and not of steps. Twice the images halve its excess
    over the training error, which falls as 1 / images; what may be chance, two standard errors of a few held-out views,
    does not count. With `images_s`, the core-seconds that the present images took, what takes off more in a second
    wins; without it, what takes off more.
    """
    measured = [each for each in records if each["kind"] == "validation" and "excess" in each]
    curve = [each for each in measured if (excess := each.get("excess_held_out")) and excess[0] > 0]
    late = [each for each in curve if 4 * each["step"] >= curve[-1]["step"] > 0]
    if len(late) < LEAST_POINTS:
        return None
    (held_out, deviation), training = late[-1]["excess_held_out"], late[-1]["excess"]
    of_steps = 1 - 2 ** _fit_slope([(each["step"], each["excess_held_out"][0]) for each in late])
    of_images = (held_out - 2 * (deviation or 0) - max(training, 0)) / held_out / 2
    gains = {"more steps": (of_steps, late[-1]["seconds"]["train"]), "more images": (of_images, images_s)}
    said = "; ".join(
        f"twice the {name.removeprefix('more ')}{'' if cost is None else f' ({format_span(cost)} more)'} should take "
        f"{max(gain, 0):.0%} off the held-out error"
        for name, (gain, cost) in gains.items()
    )
    if stop := next((each for each in records if _ended_by_heart(each) and each["step"] == late[-1]["step"]), None):
        worth: Worth = "fresh passes"
        said = (
            "it learned its samples by heart, and ended with the weights of step "
            f"{stop['back_to']}; with fresh passes of the same views, or more images, the same command goes on"
        )
    elif knows_noise(training, held_out):
        worth = "fresh passes"
        said = "it learns the noise of its samples by heart, as its training loss is below what noise alone leaves"
    elif max(of_steps, of_images) < LEAST_GAIN:
        worth = "a wider network"
    else:
        best = max(gains, key=lambda name: gains[name][0] / ((gains[name][1] or 1) if images_s else 1))
        worth = "more steps" if best == "more steps" else "more images"
    return Advice(worth, f"worth its seconds next: {worth}; {said}")


def knows_noise(training: float, held_out: float) -> bool:
    """Whether the error on training samples is so far below 0 that a network has learned their noise by heart."""
    return training < BY_HEART * abs(held_out)


def _ended_by_heart(record: Mapping[str, Any]) -> bool:
    return record["kind"] == "recovered" and record["cause"] == LEARNED_BY_HEART


def _fit_slope(curve: Sequence[tuple[float, float]]) -> float:
    """The slope of log(error) over log(step), by least squares."""
    points = [(math.log(step), math.log(error)) for step, error in curve]
    x_mean, y_mean = (sum(values) / len(points) for values in zip(*points, strict=True))
    spread = sum((x - x_mean) ** 2 for x, _ in points)
    return sum((x - x_mean) * (y - y_mean) for x, y in points) / spread
