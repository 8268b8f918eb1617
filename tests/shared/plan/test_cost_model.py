"""How a budget is best spent on configurations, views and samples per pixel."""

import math
from dataclasses import replace
from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from photonfarm.plan.sample_costs import MOST_SPP, MOST_VIEWS, Allocation, CostModel, SampleCosts

ROOM = SampleCosts("room", 0.04, 0.035, 0.005, 0.032, 0.3)
FIT = 30.0, 1.0  # κ and ρ
positive = st.floats(1e-3, 1e3)
any_costs = st.builds(lambda values: SampleCosts("any", *values), st.tuples(*[positive] * 5))


def test_seconds_and_excess_are_those_of_the_model() -> None:
    model = CostModel(SampleCosts("made", 1000.0, 100.0, 10.0, 1.0, 60.0), kappa=3, rho=0.5)
    asked = Allocation(modifications=3, views=2, passes=4, spp=5)
    assert asked.samples == 24
    assert model.seconds(asked) == 3 * 1000 + 6 * 100 + 24 * (10 + 5)
    assert model.excess(asked) == pytest.approx(0.5 / 3 + (1 + 60 / (3 * 4 * 5)) / 6)


@given(any_costs, st.floats(1, 1e4), st.floats(0.1, 100), st.floats(0, 10))
def test_no_allocation_of_the_same_budget_is_better_than_the_best(
    of: SampleCosts, budget: float, kappa: float, rho: float
) -> None:
    model = CostModel(of, kappa, rho)
    budget_s = budget * model.seconds(Allocation(1, 1, 1, 2))
    best = model.best(budget_s)
    assert model.seconds(best) <= budget_s * (1 + 1e-6)
    assert best.passes == 1
    for views, power in product(range(1, MOST_VIEWS + 1), range(1, 11)):
        one_s = of.configuration_s + views * (of.view_s + of.pass_s + of.spp_s * 2**power)
        if count := math.floor(budget_s / one_s):
            error = rho / count + (1 + of.relative_variance / (kappa * 2**power)) / (count * views)
            assert model.excess(best) <= error * (1 + 1e-9)


@given(any_costs, st.integers(1, 1000), st.integers(1, 16), st.integers(1, 10))
def test_rounding_takes_nothing_from_an_allocation_that_is_asked_for(
    of: SampleCosts, modifications: int, views: int, power: int
) -> None:
    asked = Allocation(modifications, views, 1, 2**power)
    reduction, best = CostModel(of).improve(asked)
    assert CostModel(of).excess(best) <= CostModel(of).excess(asked)
    assert 0 <= reduction < 1


def test_dear_configurations_call_for_views_and_noise_for_samples_per_pixel() -> None:
    noisy, dear = replace(ROOM, relative_variance=3000.0), replace(ROOM, configuration_s=10.0)
    plain, noisy, dear = (CostModel(of, *FIT).best(1e4) for of in (ROOM, noisy, dear))
    assert noisy.spp > plain.spp == 2
    assert plain.views == 1
    assert dear.views == round(math.sqrt(1.005 * 10 / 0.104))  # V* of the product (ρ + w/V)·(c + V·k)
    assert CostModel(SampleCosts("free samples", 0, 1, 0, 0, 1)).best(1e4).spp == MOST_SPP


def test_of_a_static_scene_each_view_stands_for_itself() -> None:
    best = CostModel.of(ROOM, static=True).best(1e3)
    assert (best.views, best.modifications) == (1, int(1e3 / (0.035 + 0.005 + 2 * 0.032)))


def test_a_budget_that_pays_for_nothing_is_refused_with_what_the_least_costs() -> None:
    with pytest.raises(ValueError, match=r"budget_s is 0\.1;.*0\.14"):
        CostModel(ROOM).best(0.1)
