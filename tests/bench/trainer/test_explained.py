"""How much of a change is explained, of changes that are made up."""

from __future__ import annotations

import numpy as np
import pytest

from bench.harness.network_errors import F64, Errors
from bench.trainer.explained import Change, Explained

VIEWS = 40
UNITS = tuple(bytes([unit]) * 16 for unit in range(VIEWS))


@pytest.fixture(scope="module")
def made_up() -> tuple[Change, F64]:
    """Changes of some size, known by halves whose noise is larger than they are; the upper half of the pixels stays."""
    rng = np.random.default_rng(0)
    true = 0.1 * rng.normal(size=(VIEWS, 1, 32, 32, 3))
    same = np.zeros((VIEWS, 32, 32), np.bool_)
    same[:, :16] = True
    return Change(true + 0.3 * rng.normal(size=(VIEWS, 2, 32, 32, 3)), same, UNITS), true[:, 0]


# With noise of 0.3 on each half the sums over 120 000 values are known to 3 %.
@pytest.mark.parametrize(("factor", "expected"), [(0.5, 0.75), (1.0, 1.0), (-1.0, -3.0)])
def test_the_noise_of_the_halves_is_taken_out(made_up: tuple[Change, F64], factor: float, expected: float) -> None:
    change, true = made_up
    for left, there in zip(change.left(factor * true), change.there(), strict=True):
        explained = Explained(Errors(left[None], UNITS), there)
        low, high = explained.interval()
        assert explained.share == pytest.approx(expected, abs=0.1)
        assert low < explained.share < high


def test_of_nothing_no_share_is_explained() -> None:
    nothing = Errors(np.zeros((1, VIEWS)), UNITS)
    explained = Explained(Errors(np.ones((2, VIEWS)), UNITS), nothing)
    assert explained.share == -np.inf
    assert explained.interval() == (-np.inf, -np.inf)
