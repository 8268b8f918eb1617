"""The page about data by `bdpt` and by `path`: its factors, bias and noise from made-up figures, and its tables."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from analytic_scene import small_spec
from numpy.typing import NDArray
from store_samples import guides

from bench.harness.contents import Pool, commit
from bench.harness.network_errors import Errors, replicates, seed_spread
from bench.harness.room_study import ReferenceViews
from bench.studies import path_data, path_data_page, path_statistics
from bench.studies.path_data import BUDGETS, HELD_OUT, FirstSamples
from bench.studies.path_data_study import METRICS, MeasuredArm, Study, Targets
from bench.studies.path_scene import Costs, Rendered
from bench.studies.path_statistics import BudgetFactor, bias, crossing, factor, noise, ratio, relative_noise
from photonfarm.core.records import F32, Photons, ViewBuffers, Visibility
from photonfarm.plan.hold_out import are_held_out
from photonfarm.store import Store

VIEWS, SIZE = 24, 16
UNITS = tuple(bytes([unit]) * 16 for unit in range(VIEWS))
ARMS = (0.25, 0.5, 1.0, 2.0, 4.0)


# ------------------------------------------------------------------------------------------------------------ factors


def test_errors_are_interpolated_in_the_logarithm_of_the_budget() -> None:
    errors = [0.5, 0.4, 0.3, 0.2, 0.1]
    assert crossing(ARMS, errors, 0.25) == pytest.approx(math.sqrt(2))
    assert crossing(ARMS, errors, 0.125) == pytest.approx(2 * 2**0.75)
    assert crossing(ARMS, errors, 0.2) == pytest.approx(2)


def test_what_lies_beyond_the_arms_is_no_number() -> None:
    errors = [0.5, 0.4, 0.3, 0.2, 0.1]
    assert crossing(ARMS, errors, 0.09) == math.inf
    assert crossing(ARMS, errors, 0.5) == 0
    assert path_data_page.in_words(math.inf, ARMS) == "more than 4.00"
    assert path_data_page.in_words(0.0, ARMS) == "less than 0.25"
    assert path_data_page.within_words(BudgetFactor(1.5, 0.0, math.inf), ARMS) == "less than 0.25 … more than 4.00"


def test_of_errors_that_rise_again_the_first_crossing_counts() -> None:
    assert crossing(ARMS, [0.5, 0.3, 0.4, 0.1, 0.2], 0.35) == pytest.approx(0.25 * 2**0.75)


def errors(level: float, number: int, seed_noise: float = 0.02) -> Errors:
    """Errors of two seeds; a view is equally hard for all arms, and each seed moves all views of an arm alike."""
    rng = np.random.default_rng(number)
    hard = np.random.default_rng(99).uniform(0.5, 1.5, VIEWS)
    moved = 1 + seed_noise * rng.normal(size=(2, 1))
    return Errors(level * moved * (hard + 0.05 * rng.normal(size=(2, VIEWS))), UNITS)


def arms(dearer: float, seed_noise: float = 0.02) -> list[Errors]:
    """Arms whose errors fall with the root of the budget, which is spent on samples `dearer` times as noisy."""
    return [errors(0.01 * math.sqrt(dearer / budget), i, seed_noise) for i, budget in enumerate(ARMS)]


def test_the_factor_of_noisier_data_is_found_within_its_interval() -> None:
    found = factor(errors(0.01, 7), arms(2.5), ARMS, 0.02)
    assert found.value == pytest.approx(2.5, rel=0.2)
    assert found.low < found.value < found.high
    assert found.high / found.low < 2
    assert [one > 1.8 for one in path_statistics.factors_of_seeds(errors(0.01, 7), arms(2.5), ARMS)] == [True, True]


def test_a_factor_beyond_the_arms_is_told_as_such() -> None:
    found = factor(errors(0.01, 7), arms(16), ARMS, 0.02)
    assert (found.value, found.low, found.high) == (math.inf,) * 3


def test_seeds_that_disagree_widen_the_interval() -> None:
    quiet, loud = (factor(errors(0.01, 7, spread), arms(2, spread), ARMS, spread) for spread in (0.005, 0.15))
    assert math.log(loud.high / loud.low) > 2 * math.log(quiet.high / quiet.low)


def test_the_spread_of_seeds_is_pooled_over_arms() -> None:
    apart = [Errors(np.array([[1 - d] * VIEWS, [1 + d] * VIEWS]), UNITS) for d in (0.1, 0.2)]
    assert seed_spread(apart) == pytest.approx(math.sqrt(2 * 0.1**2 + 2 * 0.2**2) / math.sqrt(2))
    assert seed_spread([Errors(np.ones((1, VIEWS)), UNITS)]) == 0


def test_replicates_vary_as_configurations_do_and_together() -> None:
    """One seed, so that nothing but the choice of configurations moves them: by the standard error, but for n − 1."""
    one = Errors(errors(0.01, 1).values[:1], UNITS)
    twice = Errors(2 * one.values, UNITS)
    drawn = replicates([one, twice])
    expected = one.estimate().standard_error * math.sqrt(1 - 1 / VIEWS)
    assert drawn[:, 0].std() == pytest.approx(expected, rel=0.05)
    np.testing.assert_allclose(drawn[:, 1], 2 * drawn[:, 0])


def test_views_of_one_configuration_are_drawn_together() -> None:
    values = np.repeat(np.random.default_rng(0).random(VIEWS // 4), 4)
    alone, together = (
        ratio(values, np.ones(VIEWS), units) for units in (UNITS, tuple(UNITS[i // 4] for i in range(VIEWS)))
    )
    assert alone.value == pytest.approx(together.value)
    assert together.high - together.low > 1.5 * (alone.high - alone.low)


# ------------------------------------------------------------------------------------------------------------ targets


def halves(mean: NDArray[np.float64], deviation: float, seed: int) -> F32:
    """Two halves of views with these means (N,): all pixels alike, normal noise of so much of the mean."""
    rng = np.random.default_rng(seed)
    apart = 1 + deviation * rng.normal(size=(len(mean), 2, SIZE, SIZE, 3))
    return np.asarray(mean[:, None, None, None, None] * apart, np.float32)


def test_targets_of_one_mean_pass_and_darker_ones_do_not() -> None:
    mean = np.random.default_rng(5).uniform(0.1, 10, 200)
    for found in bias(halves(mean, 0.1, 1), halves(mean, 0.5, 2)):
        assert found.ratio == pytest.approx(1, abs=0.01)
        assert abs(found.z) < 4
    for found in bias(halves(mean, 0.1, 1), halves(0.98 * mean, 0.5, 2)):
        assert found.ratio == pytest.approx(0.98, abs=0.006)
        assert found.z < -4


def test_what_dark_views_lack_is_seen_where_views_count_alike() -> None:
    mean = np.where(np.arange(200) % 2, 0.01, 100.0)
    lacking = np.where(mean < 1, 0.9 * mean, mean)
    all_light, alike = bias(halves(mean, 0.1, 1), halves(lacking, 0.1, 2))
    assert abs(all_light.z) < 4
    assert alike.ratio == pytest.approx(0.95, abs=0.01)
    assert alike.z < -4


def test_noise_is_that_of_the_mean_of_both_halves() -> None:
    mean = np.array([1.0, 3.0])
    found = noise(halves(mean, 0.2, 3))
    np.testing.assert_allclose(found, (0.2 * mean) ** 2 / 2, rtol=0.1)
    clean = np.broadcast_to(mean[:, None, None, None], (2, SIZE, SIZE, 3)).astype(np.float32)
    np.testing.assert_allclose(relative_noise(halves(mean, 0.2, 3), clean), found / (mean**2 + 0.05), rtol=1e-4)


# --------------------------------------------------------------------------------------------------------------- page


def study(seeds: tuple[int, ...] = (0, 1)) -> tuple[Study, Targets]:
    """Networks whose errors fall with the root of the budget; data of `path` is 2.5 times as noisy."""
    told = path_data.options().parse_args(["--seeds", *map(str, seeds)])
    images = np.random.default_rng(0).random((VIEWS, SIZE, SIZE, 3), np.float32)
    references = ReferenceViews(tuple(range(VIEWS)), UNITS, np.stack([images, images], axis=1), 256)
    measured = []
    for number, arm in enumerate(path_data.arms(told)):
        level = 0.01 * math.sqrt((1 if arm.kind == "bdpt" else 2.5) / arm.share)
        of_seeds = Errors(errors(level, number).values[: len(seeds)], UNITS)
        measured.append(MeasuredArm(arm, 60.0, images=images, **dict.fromkeys(METRICS.values(), of_seeds)))
    made = {kind: Rendered(Path(kind), spp, 0.8, 0) for kind, spp in (("bdpt", 4), ("path", 22))}
    spec = small_spec(film={"width": SIZE, "height": SIZE})
    settings = path_data.settings_of(told, 0, HELD_OUT)
    found = Study(told, spec, settings, Costs(0.5, 0.04, 0.021), made, references, measured)
    mean = np.random.default_rng(6).uniform(0.5, 2, VIEWS)
    return found, Targets(halves(mean, 0.1, 1), halves(mean, 0.2, 2), UNITS, tuple(reversed(range(VIEWS))))


@pytest.mark.parametrize("seeds", [(0, 1), (0,)])
def test_the_page_and_its_figures_and_the_picture_are_made(seeds: tuple[int, ...]) -> None:
    found, targets = study(seeds)
    page = path_data_page.page(found, targets, "path_data.png")
    values = json.loads(json.dumps(path_data_page.document(found, targets), allow_nan=False))

    assert [row["samples"] for row in values["arms"]] == [50, 100, 200, 50, 100, 200, 400, 800]
    assert all(np.shape(row[metric]) == (len(seeds), VIEWS) for row in values["arms"] for metric in METRICS.values())
    assert values["factors"]["shown"]["value"] == pytest.approx(2.5, rel=0.2)
    assert values["noise"]["linear"]["ratio"]["value"] == pytest.approx(4, rel=0.1)
    assert page.count("| `path` |") == 1 + len(BUDGETS["path"])
    assert path_data_page.picture(found, targets).width > 6 * SIZE


def test_budgets_are_of_measured_core_seconds() -> None:
    found, targets = study()
    dearer = Study(
        found.arguments, found.spec, found.settings, found.costs,
        {**found.made, "path": Rendered(Path("path"), 22, 1.6, 0)}, found.references, found.measured,
    )  # fmt: skip
    assert found.budgets == pytest.approx(list(ARMS))
    assert dearer.budgets == pytest.approx([2 * budget for budget in ARMS])
    assert dearer.factor("shown")[0].value == pytest.approx(2 * found.factor("shown")[0].value)
    assert dearer.noise(targets, relative=False)[2].value == pytest.approx(8, rel=0.1)


# ------------------------------------------------------------------------------------------------------------- stores

SAMPLES = 24  # of bdpt at budget 1


@pytest.fixture(scope="module")
def roots(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, str]]:
    """A store of each kind with what the benchmark asks for, and images that were never rendered."""
    told = path_data.options().parse_args(["--samples", str(SAMPLES), "--reference-spp", "16"])
    rng, spec, found = np.random.default_rng(1), small_spec(), {}
    buffers = ViewBuffers(*(rng.random(shape, np.float32) for shape in ((8, 8), (8, 8, 3), (8, 8, 3))))
    photons = Photons(*rng.random((4, 8, 3), np.float32), np.zeros(8, np.int8))
    images = [rng.random((2, 8, 8, 3), np.float32) for _ in range(7)]
    for kind, asked in path_data.requests(told).items():
        store = Store(tmp_path_factory.mktemp(kind) / "store", create=True)
        scene = store.add(spec)
        for request in asked:
            scene.plan(request, shard_rows=16)
        seen = Visibility(np.ones(16, np.bool_), np.ones(8, np.bool_))
        pool = Pool(images, [buffers], [guides(spec, 0)], [seen], [photons])
        for job in scene.missing_jobs():
            commit(scene, job, pool)
        found[kind] = Path(store.root), spec.scene_id
    return found


def views(source: FirstSamples) -> list[bytes]:
    return source.view_keys(source.chosen)


def test_both_kinds_are_trained_on_the_same_views(roots: dict[str, tuple[Path, str]]) -> None:
    ours, theirs = (FirstSamples(*roots[kind], SAMPLES) for kind in ("bdpt", "path"))
    assert views(ours) == views(theirs)
    assert len(set(views(ours))) == SAMPLES


def test_smaller_budgets_are_parts_of_larger_ones(roots: dict[str, tuple[Path, str]]) -> None:
    few, many = (views(FirstSamples(*roots["path"], round(share * SAMPLES))) for share in (0.25, 4))
    assert (len(few), len(set(many))) == (SAMPLES // 4, 4 * SAMPLES)
    assert many[: len(few)] == few


def test_none_is_trained_on_what_is_held_out(roots: dict[str, tuple[Path, str]]) -> None:
    source = FirstSamples(*roots["path"], 4 * SAMPLES)
    references = ReferenceViews.of(Store(roots["bdpt"][0]), small_spec(), 16, HELD_OUT)
    assert len(references.rows) > 1
    assert not set(source.modification_keys(source.chosen)) & set(references.units)
    *trained_on, looked_at = source.refresh().tolist()
    assert trained_on == source.chosen
    assert are_held_out(source.modification_keys([looked_at]), HELD_OUT) == [True]


def test_networks_with_guides_can_be_trained_on_chosen_samples(roots: dict[str, tuple[Path, str]]) -> None:
    source = FirstSamples(*roots["path"], SAMPLES)
    rows = source.refresh().tolist()
    assert all(sample.guides is not None for sample in (source.read(row, guides=True) for row in rows[:2]))
    assert sum(are_held_out(source.modification_keys(rows), HELD_OUT)) == 1


def test_more_samples_than_there_are_is_refused(roots: dict[str, tuple[Path, str]]) -> None:
    with pytest.raises(ValueError, match="1000"):
        FirstSamples(*roots["bdpt"], 1000)


def test_targets_of_both_kinds_are_of_one_view(roots: dict[str, tuple[Path, str]]) -> None:
    spec = small_spec()
    made = {kind: Rendered(root, 4, 0.8, 0) for kind, (root, _) in roots.items()}
    references = ReferenceViews.of(Store(made["bdpt"].root), spec, 16, HELD_OUT)
    found = path_data.targets(made, spec, references)
    assert found.bdpt.shape == found.path.shape == (SAMPLES + SAMPLES // 2 + 8, 2, 8, 8, 3)
    assert [found.units[place] for place in found.held_out] == list(references.units)
