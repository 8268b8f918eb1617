"""Whether κ and ρ are found again in errors that the model itself makes."""

from __future__ import annotations

import numpy as np
import pytest

from budget_fit import Fit, Point, fit
from photonfarm.shared.allocation import Allocation, excess

KAPPA, RHO = 40.0, 2.0
ARMS = [
    Allocation(m, v, 1, s)
    for m, v, s in [(900, 1, 2), (500, 1, 8), (160, 1, 32), (45, 1, 128), (300, 4, 2), (150, 4, 8), (48, 4, 32)]
]


def points(noise: float = 0.0, seed: int = 0) -> list[Point]:
    rng = np.random.default_rng(seed)
    found = []
    for room, of_room, a, b in (("one", 3.0, 0.01, 1.0), ("other", 60.0, 0.02, 0.5)):
        for arm in ARMS:
            error = a + b * excess(of_room, arm, kappa=KAPPA, rho=RHO)
            found.append(Point(room, arm, of_room, error + noise * rng.standard_normal(), max(noise, 1e-6)))
    return found


def test_the_constants_are_found_where_the_model_holds() -> None:
    found = fit(points())
    assert found.kappa == pytest.approx(KAPPA, rel=0.15)
    assert found.rho == pytest.approx(RHO, rel=0.15)
    assert found.levels["one"] == pytest.approx((0.01, 1.0), rel=0.1)
    assert found.levels["other"] == pytest.approx((0.02, 0.5), rel=0.1)
    for point in points():
        assert found.predicted(point) == pytest.approx(point.error, rel=0.01)


def test_ranges_hold_the_truth_about_as_often_as_one_standard_error_does() -> None:
    within = [_holds(fit(points(3e-4, seed))) for seed in range(12)]
    assert 4 <= sum(within) < 12


def _holds(found: Fit) -> bool:
    return found.kappa_range[0] <= KAPPA <= found.kappa_range[1] and found.chi2 < 3 * found.freedom


def test_too_few_arms_are_refused() -> None:
    with pytest.raises(ValueError, match="6 at least tell 2 rooms' constants"):
        fit([points()[0], points()[-1]])
