"""The page about what samples cost: from costs that are made up, what it says is best."""

from __future__ import annotations

import pytest
from analytic_scene import small_spec

from bench.studies.sample_costs import SPP, RoomCosts, line, shared_out
from photonfarm.plan.allocation import Allocation
from photonfarm.plan.sample_costs import SampleCosts

BUDGET = 200.0


def room(**changes: float) -> RoomCosts:
    """A scene with movable groups; a configuration costs as much as 50 samples per pixel."""
    parts = {"configuration_s": 0.5, "view_s": 0.05, "pass_s": 0.0, "spp_s": 0.01, "relative_variance": 40.0} | changes
    return RoomCosts("made-up", spec := small_spec(), SampleCosts(spec.scene_id, **parts))


def test_none_of_the_shares_is_better_than_the_best() -> None:
    of = room()
    assert of.terms.seconds(of.terms.best(BUDGET)) <= BUDGET
    assert all(of.more_than_best(spp, BUDGET) >= 0.99 for spp in SPP)


def test_the_share_that_is_the_best_has_its_excess() -> None:
    of = room(configuration_s=0.0, view_s=0.0, relative_variance=0.0)
    best = of.terms.best(BUDGET)
    assert best == Allocation(best.modifications, 1, 1, 2)
    assert of.more_than_best(2, BUDGET) == pytest.approx(1, rel=0.01)


@pytest.mark.parametrize("noise", [0.1, 1000.0])
def test_noisier_scenes_are_said_to_want_more_samples_per_pixel(noise: float) -> None:
    of = room(relative_variance=noise)
    cells = line(of, BUDGET)
    assert cells[0] == "made-up"
    assert cells[1:6] == ["8 × 8", "500.0", "50.0", "0.0", "10.0"]
    assert (float(cells[7]) > 8) == (noise > 1)


def test_views_of_a_static_scene_are_of_one_configuration() -> None:
    assert shared_out(Allocation(7, 1, 1, 4), static=True) == "1 × 7 × 4 spp"
    assert shared_out(Allocation(7, 2, 1, 4), static=False) == "7 × 2 × 4 spp"
