"""A share that holds out just enough; what a share holds out stays as it is, since stores and runs depend on it."""

import hashlib

import pytest

from photonfarm.plan.hold_out import HOLD_OUT, are_held_out, enough, places_of

UNITS = [hashlib.sha256(bytes([i])).digest()[:16] for i in range(200)]


HELD = "3 9 14 15 29 40 44 45 47 49 57 60 66 75 81 93 102 115 118 121 134 147 157 163 166 170 173 183 188"
"""The units that the share HOLD_OUT has held out since there are stores."""


def test_what_is_held_out_is_a_contract() -> None:
    held = [i for i, out in enumerate(are_held_out(UNITS, HOLD_OUT)) if out]
    assert " ".join(map(str, held)) == HELD


@pytest.mark.parametrize("count", [2, 3, 5, 8, 30, 59])
@pytest.mark.parametrize("least", [0.0, HOLD_OUT])
def test_a_share_leaves_something_on_both_sides_of_any_plan(count: int, least: float) -> None:
    share = enough(UNITS[:count], least)
    if share is None:
        assert all(are_held_out(UNITS[:count], least))
        return
    held = sum(are_held_out(UNITS[:count], share))
    assert share >= least
    assert 0 < held < count
    assert share == least or held == 1, "no more than needed"


def test_one_is_too_few() -> None:
    assert enough(UNITS[:1]) is None
    assert enough([UNITS[0], UNITS[0]]) is None


def test_places_are_spread_over_all() -> None:
    assert sorted(places_of(UNITS))[100] / 2**64 == pytest.approx(0.5, abs=0.15)
