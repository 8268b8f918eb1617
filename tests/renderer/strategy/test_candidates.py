"""Which of two candidates is better, and whether that is known; what a time buys."""

import math

import pytest

from photonfarm.renderer.strategy.candidates import (
    PLAIN,
    Candidate,
    CandidateAtCost,
    ImageCost,
    MeasuredCandidate,
    RelativeErrors,
    compare_at_cost,
    saving,
)


def measured(own: tuple[float, ...], plain: tuple[float, ...], images: int = 12, time: float = 1.0) -> CandidateAtCost:
    """A candidate whose samples take `time`, where those of plain path tracing take 1."""
    rows = [
        MeasuredCandidate(
            candidate=candidate,
            errors=RelativeErrors(images=images, own=errors, plain=plain),
            missed=0.0,
            cost=ImageCost(0.0, sample_s),
        )
        for candidate, errors, sample_s in ((PLAIN, plain, 1.0), (Candidate(0, 1.0), own, time))
    ]
    return compare_at_cost(rows, 1, 1e4)[Candidate(0, 1.0)]


def test_candidates_whose_errors_rise_and_fall_together_are_told_apart_however_much_these_vary() -> None:
    plain = (1.0, 9.0, 2.0)
    one, other = measured((0.3, 1.2, 3.0), plain), measured((0.63, 2.4, 6.0), plain)
    found = saving(one, over=other)
    assert found.factor == pytest.approx(9.03 / 4.5)
    assert found.significant
    alone = saving(one, over=measured(plain, plain))
    assert alone.factor == pytest.approx(12 / 4.5)
    assert not alone.significant


def test_of_unequally_many_images_the_ratios_to_plain_path_tracing_are_independent() -> None:
    """Residuals (-0.1, 0, 0.1) and (-0.2, 0, 0.2) of three views: standard errors 0.1/√3 and 0.2/√3."""
    one = measured((0.9, 1.0, 1.1), (1.0, 1.0, 1.0), images=12)
    other = measured((1.6, 2.0, 2.4), (2.0, 2.0, 2.0), images=24)
    found = saving(one, over=other)
    assert found.factor == pytest.approx(1)
    assert found.spread == pytest.approx(math.hypot(0.1, 0.2) / 3**0.5)


@pytest.mark.parametrize(
    ("time", "scatter", "significant"), [(1.04, 0.0, False), (1.06, 0.0, True), (1.5, 0.4, False), (1.6, 0.4, True)]
)
def test_a_gain_counts_from_five_per_cent_and_two_standard_errors(
    time: float, scatter: float, significant: bool
) -> None:
    """The standard error of the logarithm is scatter/√3: 0.23, of which log 1.5 = 0.41 is not twice as much."""
    one = measured((1 - scatter, 1.0, 1 + scatter), (1.0,) * 3)
    other = measured((1.0,) * 3, (1.0,) * 3, time=time)
    assert saving(one, over=other).significant == significant
    assert not saving(other, over=one).significant


def test_a_single_value_tells_nothing_of_its_error() -> None:
    found = saving(measured((1.0,), (1.0,)), over=measured((9.0,), (1.0,)))
    assert (found.factor, found.spread, found.significant) == (9.0, None, False)


def test_a_time_buys_whole_samples_and_one_at_least() -> None:
    cost = ImageCost(fixed_s=1.0, sample_s=2.0)
    assert [cost.samples_for(s) for s in (0.5, 3.0, 5.9, 6.1, 1e9)] == [1, 1, 2, 3, 65536]
    assert [cost.pays(s) for s in (2.3, 2.5)] == [False, True]
