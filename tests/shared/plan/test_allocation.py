"""How a budget is best spent on configurations, views and samples per pixel."""

import math
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from photonfarm.plan.allocation import MOST_SPP, MOST_VIEWS, Allocation, CostModel, excess, seconds
from photonfarm.plan.sample_costs import SampleCosts

NAMES = ("configuration_s", "view_s", "pass_s", "spp_s", "relative_variance")
ROOM = SampleCosts("room", 0.04, 0.035, 0.005, 0.032, 0.3)
FIT = 30.0, 1.0  # κ and ρ
positive = st.floats(1e-3, 1e3)
any_costs = st.builds(lambda values: SampleCosts("any", *values), st.tuples(*[positive] * 5))


def costs(**values: float) -> SampleCosts:
    """Everything costs nothing but what is given."""
    return SampleCosts("made", **{**dict.fromkeys(NAMES, 0.0), **values})


def at_one_budget(of: SampleCosts, views: int, passes: int, spp: Any, kappa: float, rho: float) -> Any:
    """Excess × budget, written out from the model: configurations are as many as the budget pays for."""
    error = rho + (1 + of.relative_variance / (kappa * passes * spp)) / views
    return error * (of.configuration_s + views * (of.view_s + passes * (of.pass_s + of.spp_s * spp)))


def test_seconds_and_excess_are_those_of_the_model() -> None:
    of = SampleCosts("made", 1000.0, 100.0, 10.0, 1.0, 60.0)
    asked = Allocation(modifications=3, views=2, passes=4, spp=5)
    assert asked.samples == 24
    assert seconds(of, asked) == 3 * 1000 + 6 * 100 + 24 * (10 + 5)
    assert excess(of.relative_variance, asked, kappa=3, rho=0.5) == pytest.approx(0.5 / 3 + (1 + 60 / (3 * 4 * 5)) / 6)


@given(any_costs, st.integers(1, 16), st.integers(1, 8), st.floats(0.1, 100), st.floats(0, 10))
def test_the_best_samples_per_pixel_are_at_the_numeric_minimum(
    of: SampleCosts, views: int, passes: int, kappa: float, rho: float
) -> None:
    found = CostModel(of, kappa, rho).best_spp(views, passes)
    tried = found * np.geomspace(1e-3, 1e3, 60_001)  # a step is 0.02 %
    errors = at_one_budget(of, views, passes, tried, kappa, rho)
    assert at_one_budget(of, views, passes, found, kappa, rho) <= errors.min() * (1 + 1e-9)
    flat = np.flatnonzero(errors <= errors.min() * (1 + 1e-9))  # rounding hides the minimum within
    assert tried[max(flat[0] - 1, 0)] <= found <= tried[min(flat[-1] + 1, len(tried) - 1)]


def test_the_best_samples_per_pixel_of_an_example_by_hand() -> None:
    of = SampleCosts("made", 6.0, 2.0, 1.0, 0.5, 30.0)  # c₀ = 6/2 + 2 + 1 of two views
    assert CostModel(of, 10, 1).best_spp(2) == pytest.approx(math.sqrt(6 * 30 / (10 * 0.5 * 3)))
    assert CostModel(of, 10, 1).best_spp(2, 3) == pytest.approx(math.sqrt(8 * 30 / (10 * 0.5 * 3)) / 3)


def test_without_noise_no_sample_is_worth_its_cost_and_of_free_ones_there_are_never_enough() -> None:
    assert CostModel(costs(view_s=1, spp_s=1)).best_spp(1) == 0
    assert CostModel(costs(view_s=1, relative_variance=1)).best_spp(1) == math.inf


@given(any_costs, st.integers(1, 16), st.integers(2, 8), st.integers(1, 512))
def test_passes_only_repeat_the_fixed_part(of: SampleCosts, views: int, passes: int, half_spp: int) -> None:
    several = Allocation(10, views, passes, 2 * half_spp)
    one = Allocation(10, views, 1, 2 * half_spp * passes)
    assert excess(of.relative_variance, several) == pytest.approx(excess(of.relative_variance, one))
    assert seconds(of, several) - seconds(of, one) == pytest.approx(
        10 * views * (passes - 1) * of.pass_s, abs=1e-9 * seconds(of, several)
    )


@given(any_costs, st.floats(1, 1e4), st.floats(0.1, 100), st.floats(0, 10))
def test_no_allocation_of_the_same_budget_is_better_than_the_best(
    of: SampleCosts, budget: float, kappa: float, rho: float
) -> None:
    budget_s = budget * seconds(of, Allocation(1, 1, 1, 2))
    found = CostModel(of, kappa, rho).best(budget_s)
    assert seconds(of, found) <= budget_s * (1 + 1e-6)
    assert found.passes == 1
    least = excess(of.relative_variance, found, kappa=kappa, rho=rho)
    for views, power in product(range(1, MOST_VIEWS + 1), range(1, 11)):
        one_s = of.configuration_s + views * (of.view_s + of.pass_s + of.spp_s * 2**power)
        if count := math.floor(budget_s / one_s):
            error = rho / count + (1 + of.relative_variance / (kappa * 2**power)) / (count * views)
            assert least <= error * (1 + 1e-9)


@given(any_costs, st.integers(1, 1000), st.integers(1, 16), st.integers(1, 10))
def test_rounding_takes_nothing_from_an_allocation_that_is_asked_for(
    of: SampleCosts, modifications: int, views: int, power: int
) -> None:
    asked = Allocation(modifications, views, 1, 2**power)
    found = CostModel(of).best(seconds(of, asked))
    assert excess(of.relative_variance, found) <= excess(of.relative_variance, asked)


def test_the_best_whole_numbers_are_next_to_the_real_one() -> None:
    of = replace(ROOM, relative_variance=3000.0)
    found = CostModel(of, *FIT).best(1e4)
    assert found.spp / 2 < CostModel(of, *FIT).best_spp(found.views) < found.spp * 2


def test_dear_configurations_call_for_views_and_noise_for_samples_per_pixel() -> None:
    noisy, dear = replace(ROOM, relative_variance=3000.0), replace(ROOM, configuration_s=10.0)
    plain, noisy, dear = (CostModel(of, *FIT).best(1e4) for of in (ROOM, noisy, dear))
    assert noisy.spp > plain.spp == 2
    assert plain.views == 1
    assert dear.views == round(math.sqrt(1.005 * 10 / 0.104))  # V* of the product (ρ + w/V)·(c + V·k)
    assert CostModel(costs(view_s=1, relative_variance=1)).best(1e4).spp == MOST_SPP


def test_of_a_static_scene_each_view_stands_for_itself() -> None:
    terms = CostModel.of(ROOM, static=True)
    found = terms.best(1e3)
    assert found.views == 1
    assert found.modifications == int(1e3 / (0.035 + 0.005 + 2 * 0.032))


def test_a_budget_that_pays_for_nothing_is_refused_with_what_the_least_costs() -> None:
    with pytest.raises(ValueError, match=r"budget_s is 0\.1;.*0\.14"):
        CostModel(ROOM).best(0.1)
