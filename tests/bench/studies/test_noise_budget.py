"""The page about what core-seconds are best spent on: its tables and words, from errors that are made up."""

from __future__ import annotations

import json

import numpy as np
import pytest
from analytic_scene import small_spec

from bench.harness.network_errors import Errors
from bench.harness.room_study import ReferenceViews
from bench.studies import noise_budget
from bench.studies.budget_arms import SHARES
from bench.studies.budget_fit import KAPPAS, RHOS, RoomErrors, fit
from bench.studies.noise_budget import BudgetStudy, MeasuredShare
from photonfarm.plan.allocation import excess
from photonfarm.plan.sample_costs import SampleCosts

VIEWS, SIZE, BUDGET = 12, 16, 200.0
UNITS = tuple(bytes([unit]) * 16 for unit in range(VIEWS))
COSTS = SampleCosts(small_spec().scene_id, 0.1, 0.05, 0.01, 0.01, 30.0)


def room(number: int, seeds: int) -> BudgetStudy:
    rng, arms = np.random.default_rng(number), []
    hard = rng.uniform(0.5, 1.5, VIEWS)
    for share in SHARES:
        configurations = noise_budget.paid(COSTS, share, BUDGET)
        bought = MeasuredShare(share, configurations, Errors(hard[None], UNITS), Errors(hard[None], UNITS)).allocation
        level = 0.01 + excess(COSTS.relative_variance, bought, kappa=20, rho=1)
        errors = Errors(level * (hard + 0.02 * rng.normal(size=(seeds, VIEWS))), UNITS)
        arms.append(MeasuredShare(share, configurations, errors, errors))
    halves = rng.random((VIEWS, 2, SIZE, SIZE, 3), np.float32)
    shown = RoomErrors.of(f"room {number}", COSTS.relative_variance, [(a.allocation, a.shown) for a in arms], number)
    spec = small_spec(film={"width": SIZE, "height": SIZE})
    references = ReferenceViews(tuple(range(VIEWS)), UNITS, halves, 256)
    return BudgetStudy(f"room {number}", spec, COSTS, references, tuple(arms), shown)


@pytest.mark.parametrize("seeds", [1, 2])
def test_the_page_and_its_figures_are_made(seeds: int) -> None:
    told = noise_budget.options().parse_args(["--seeds", *map(str, range(seeds))])
    rooms = [room(number, seeds) for number in range(2)]
    found = fit([of.errors for of in rooms])
    assert noise_budget.page(told, rooms, found)
    values = json.loads(json.dumps(noise_budget.document(told, rooms, found), allow_nan=False))

    assert list(values["rooms"]) == ["room 0", "room 1"]
    of_room = values["rooms"]["room 1"]
    assert of_room["costs"]["spp_s"] == COSTS.spp_s
    assert (of_room["seeds"], len(of_room["units"])) == (list(range(seeds)), VIEWS)
    assert [arm["spp"] for arm in of_room["arms"]] == [share.spp for share in SHARES]
    assert all(np.shape(arm["mse"]) == (seeds, VIEWS) for arm in of_room["arms"])
    a, _ = values["model"]["levels"]["room 1"]
    assert a == pytest.approx(0.01 * 1.0, rel=0.3)  # units are as hard as 1 on average
    low, high = values["model"]["kappa_range"]
    assert low <= values["model"]["kappa"] <= high


def test_a_range_says_where_the_grid_ends_it() -> None:
    assert noise_budget.in_range(2.0, 40.0, KAPPAS) == "2 … 40"
    assert noise_budget.in_range(KAPPAS[0], KAPPAS[-1], KAPPAS) == "0.1 or less … 3e+03 or more"
    assert noise_budget.in_range(0.0, RHOS[-1], RHOS) == "0 … 30 or more"


def test_what_occurs_most_is_named_first() -> None:
    assert noise_budget.shares([8, 4, 8, 8], "spp") == "8 spp in 75%, 4 spp in 25%"


def test_a_budget_that_pays_for_none_is_refused() -> None:
    with pytest.raises(ValueError, match="--budget 1"):
        noise_budget.paid(COSTS, SHARES[3], 1.0)
