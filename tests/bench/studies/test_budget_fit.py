"""Whether κ and ρ are found again in errors that the model itself makes."""

from __future__ import annotations

import numpy as np
import pytest

from bench.harness.network_errors import Errors, own_errors
from bench.studies.budget_fit import KAPPAS, RHOS, Fit, RoomErrors, fit
from photonfarm.plan.allocation import Allocation, excess

KAPPA, RHO = 40.0, 2.0
ARMS = [
    Allocation(m, v, 1, s)
    for m, v, s in [(900, 1, 2), (500, 1, 8), (160, 1, 32), (45, 1, 128), (300, 4, 2), (150, 4, 8), (48, 4, 32)]
]
VIEWS = 48
UNITS = tuple(bytes([unit]) * 16 for unit in range(VIEWS))


def errors(level: float, hard: float, own: float, rng: np.random.Generator) -> Errors:
    """Errors of two seeds: views are `hard` alike for all arms, and each network errs by a share `own` of its own."""
    of_views = 1 + hard * np.random.default_rng(99).normal(size=VIEWS)
    of_seeds = 1 + own * rng.normal(size=(2, 1))
    return Errors(level * of_seeds * (of_views / of_views.mean() + own * rng.normal(size=(2, VIEWS))), UNITS)


def rooms(own: float = 1e-6, seed: int = 0) -> list[RoomErrors]:
    rng = np.random.default_rng(seed)
    found = []
    for number, (name, noise, a, b) in enumerate((("one", 3.0, 0.01, 1.0), ("other", 60.0, 0.02, 0.5))):
        levels = [a + b * excess(noise, arm, kappa=KAPPA, rho=RHO) for arm in ARMS]
        arms = [(arm, errors(level, 0.3, own, rng)) for arm, level in zip(ARMS, levels, strict=True)]
        found.append(RoomErrors.of(name, noise, arms, number))
    return found


def test_the_constants_are_found_where_the_model_holds() -> None:
    made = rooms()
    found = fit(made)
    assert found.kappa == pytest.approx(KAPPA, rel=0.15)
    assert found.rho == pytest.approx(RHO, rel=0.15)
    assert found.levels["one"] == pytest.approx((0.01, 1.0), rel=0.1)
    assert found.levels["other"] == pytest.approx((0.02, 0.5), rel=0.1)
    for room in made:
        assert found.predicted(room) == pytest.approx(room.errors, rel=0.01)


def test_how_hard_the_views_are_moves_neither_constants_nor_their_ranges() -> None:
    """Their share of an arm's mean is the same for all arms: a and b take it up."""
    found = fit(rooms())
    assert len(set(found.kappas)) <= 2
    assert len(set(found.rhos)) <= 2


def test_ranges_hold_the_truth_nearly_always_and_not_for_being_endless() -> None:
    found = [fit(rooms(0.005, seed)) for seed in range(6)]
    assert sum(map(_holds, found)) >= 5
    assert np.median([high / low for low, high in (one.kappa_range for one in found)]) < 20
    assert 0.3 < np.median([one.chi2 / one.freedom for one in found]) < 3


def _holds(found: Fit) -> bool:
    """Each constant is found, but for a step of the grid."""
    ends = ((KAPPA, found.kappa_range, KAPPAS), (RHO, found.rho_range, RHOS))
    return all(low * grid[1] / grid[2] <= truth <= high * grid[2] / grid[1] for truth, (low, high), grid in ends)


def test_own_errors_leave_out_what_is_common_and_hold_what_seeds_and_views_add() -> None:
    rng = np.random.default_rng(5)
    arms = [errors(level, 0.3, 0.02, rng) for level in np.linspace(0.01, 0.05, 40)]
    alone = np.array([arm.estimate().standard_error for arm in arms])
    expected = 0.02 * np.sqrt(1 / 2 + 1 / (2 * VIEWS))  # of a mean of two seeds and of 48 views of each
    means = [arm.estimate().mean for arm in arms]
    assert np.median(own_errors(arms) / means) == pytest.approx(expected, rel=0.15)
    assert np.median(own_errors(arms) / alone) < 0.6


def test_the_best_arm_is_told_with_how_often_it_is_the_best() -> None:
    (room, _), (unsure, _) = rooms(), rooms(0.3)
    place, won = room.best()
    assert place == np.argmin(room.errors)
    assert won[place] == won.sum() == 1
    assert max(unsure.best()[1]) < 1


def test_too_few_arms_are_refused() -> None:
    made = [RoomErrors.of("one", 3.0, [(arm, errors(1, 0.3, 0.02, np.random.default_rng(0))) for arm in ARMS[:3]], 0)]
    with pytest.raises(ValueError, match="3 arms"):
        fit(made)
