"""What curves of known shapes say is worth its seconds."""

import itertools
from typing import Any

import pytest

from photonfarm.trainer.runs.advice import advise


def curve(slope: float, training: float, *, noise: float = 0.0, steps: int = 4000) -> list[dict[str, Any]]:
    """The log of a run whose held-out error is step^slope, which ends with `training` of it as its training error."""
    signs = itertools.cycle((1, -1))
    validations = [
        {"kind": "validation", "step": step, "excess_held_out": step**slope * (1 + noise * next(signs))}
        for step in range(0, steps + 1, 250)
        if step
    ]
    for each in validations:
        each |= {"excess": training * each["excess_held_out"], "seconds": {"train": each["step"] / 10}}
    return [{"kind": "train", "step": 50}, *validations, {"kind": "end", "step": steps}]


@pytest.mark.parametrize(
    ("slope", "training", "images_s", "worth"),
    [
        (-0.8, 1.0, None, "more steps"),  # 43 % of them, and the images nothing
        (-0.8, 0.5, None, "more steps"),  # 43 % against 25 %
        (-0.2, 0.4, None, "more images"),  # 13 % against 30 %
        (-0.2, 0.4, 4000.0, "more steps"),  # which take a tenth of the seconds
        (-0.2, 0.4, 400.0, "more images"),
        (-0.01, 0.97, None, "a wider network"),
        (0.3, 0.95, None, "a wider network"),
        (0.3, 0.5, None, "more images"),
        (0.3, -0.5, None, "fresh passes"),
        (-0.8, -0.02, None, "more images"),  # just chance; half of it is excess
        (-0.8, -0.2, None, "fresh passes"),
    ],
)
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_the_slope_and_the_gap_say_what_is_worth_its_seconds(
    slope: float, training: float, images_s: float | None, worth: str, noise: float
) -> None:
    advice = advise(curve(slope, training, noise=noise), images_s)
    assert advice is not None
    assert advice.worth == worth
    assert worth in advice.sentence


def test_the_sentence_has_what_twice_as_much_takes_off_and_its_seconds() -> None:
    advice = advise(curve(-1, 0.6), 7200)
    assert advice is not None
    assert "twice the steps (7 min more) should take 50% off" in advice.sentence
    assert "twice the images (2.0 h more) should take 20% off" in advice.sentence


def test_nothing_is_said_of_runs_that_are_too_short_or_were_not_measured() -> None:
    assert advise([]) is None
    assert advise(curve(-1, 1, steps=500)) is None
    assert advise([{**each, "excess_held_out": -1e-4} for each in curve(-1, 1)]) is None
    assert advise([{"kind": "validation", "step": step} for step in range(9)]) is None
    assert advise([{**each, "excess_held_out": None} for each in curve(-1, 1)]) is None
