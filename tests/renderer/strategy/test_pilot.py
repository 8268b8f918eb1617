"""The pilot on renderers whose variance and time are known, and on scenes whose answer is."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from photonfarm.renderer.scene import backend

mi = backend.load(threads=1)

from photonfarm.renderer.strategy.candidates import (  # noqa: E402
    PLAIN,
    Candidate,
    CandidateAtCost,
    ImageCost,
    Render,
    best,
    compare_at_cost,
)
from photonfarm.renderer.strategy.noise import pair_errors, view_weights  # noqa: E402
from photonfarm.renderer.strategy.pilot import PilotResult, measure_errors  # noqa: E402
from photonfarm.renderer.strategy.plan import reasons_for  # noqa: E402
from tests.stability.scenes.hard_scenes import HARD_SCENES  # noqa: E402 - after the variant is set

LIGHT, JOINED = Candidate(0, 1.0), Candidate(1, 1.0)
CANDIDATES = [PLAIN, LIGHT, JOINED]
EQUAL = dict.fromkeys(CANDIDATES, 0.01)
SHAPE = (32, 32, 3)
LATER_S = 1e4
"""A time that buys many samples, so that only their own times count."""


class Clock:
    """Seconds that pass only when somebody renders."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def run(
    renders: Sequence[Render], times: dict[Candidate, float], clock: Clock, spp: int = 4, **options: Any
) -> tuple[PilotResult, dict[Candidate, CandidateAtCost]]:
    """A pilot of candidates whose samples take these times, and the comparison of what it measured."""
    costs = {c: ImageCost(0.0, time_s) for c, time_s in times.items()}
    found = measure_errors(renders, costs, later_s=LATER_S, spp=spp, clock=clock, **options)
    return found, compare_at_cost(found.measured, spp, LATER_S) if found.measured else {}


def gamma_noise(variance: dict[Candidate, float], time_s: dict[Candidate, float], clock: Clock) -> Render:
    """Images of mean 1 and a known variance of one sample, gamma distributed, at a known time a sample."""

    def render(candidate: Candidate, seed: int, spp: int) -> Any:
        clock.now += time_s[candidate] * spp
        rng = np.random.default_rng([seed, CANDIDATES.index(candidate)])
        v = variance[candidate] / spp
        return rng.gamma(1 / v, v, SHAPE).astype(np.float32)

    return render


def test_error_times_time_is_what_it_is_by_construction() -> None:
    clock, times = Clock(), {PLAIN: 0.01, LIGHT: 0.02, JOINED: 0.08}
    render = gamma_noise({PLAIN: 0.5, LIGHT: 0.1, JOINED: 0.05}, times, clock)
    found, compared = run([render], times, clock, seconds=50, keep=CANDIDATES)
    assert best(compared.values()).candidate == LIGHT
    # relMSE against r² + 0.01·mean² is v/(4·1.01), a little less as the brighter of two noisy references counts
    assert [row.errors.mean for row in found.measured] == pytest.approx([v / 4.04 for v in (0.5, 0.1, 0.05)], rel=0.08)
    for candidate, cost in zip(CANDIDATES, [1, 0.4, 0.8], strict=True):
        row = compared[candidate]
        assert abs(row.relative_cost - cost) <= 4 * (row.spread or 0) + 1e-12  # 6e-5 by chance


def test_the_better_half_is_measured_longer_and_what_is_kept_to_the_end() -> None:
    clock = Clock()
    many = [PLAIN, *(Candidate(0, float(r)) for r in range(1, 8))]

    def render(candidate: Candidate, seed: int, spp: int) -> Any:
        clock.now += 0.01
        v = 0.1 + 0.1 * abs(candidate.light_ratio - 3)
        return np.random.default_rng([seed, int(candidate.light_ratio)]).gamma(1 / v, v, SHAPE).astype(np.float32)

    found, _ = run([render], dict.fromkeys(many, 0.01), clock, spp=1, seconds=100, keep=[many[7]])
    images = {row.candidate: row.errors.images for row in found.measured}
    assert images[PLAIN] == images[many[7]] == max(images.values())
    assert min(images.values()) == 8 < max(images.values())


@pytest.mark.parametrize("seed", range(4))
def test_light_that_a_candidate_is_too_unlikely_to_find_counts_against_it(seed: int) -> None:
    """A background of little noise, and in a corner light of mean 1 that comes in samples of some odds."""
    clock = Clock()
    odds = {PLAIN: 1e-7, LIGHT: 0.5, JOINED: 1e-7}  # 64 pixels of some dozen images: never seen

    def render(candidate: Candidate, seed: int, spp: int) -> Any:
        clock.now += 0.01
        rng = np.random.default_rng([seed, CANDIDATES.index(candidate)])
        image = 1 + 0.1 * rng.standard_normal((*SHAPE[:2], 1))
        image[:8, :8] += (rng.random((8, 8, 1)) < odds[candidate]) / odds[candidate]
        return np.broadcast_to(image, SHAPE).astype(np.float32)

    found, compared = run([render], EQUAL, clock, seconds=2, seed=1000 * seed)
    plain, light = compared[PLAIN], compared[LIGHT]
    assert best(compared.values()) is light
    assert plain.missed > 0.9 * plain.errors.mean
    assert light.missed == 0
    said = reasons_for(light, list(compared.values()), found.shared)
    assert any(f"{PLAIN} misses light that others find" in reason for reason in said)
    # what is charged never exceeds the variance there is: of the corner, E²/q over its share of the image
    assert plain.missed < 1 / odds[PLAIN] * 64 / 1024


@pytest.mark.parametrize("seed", range(3))
def test_a_cheap_candidate_that_misses_light_is_watched_until_the_time_is_up(seed: int) -> None:
    """A few images of plain path tracing tell little of the light in 16 pixels that only light paths find."""
    clock, times = Clock(), {PLAIN: 0.01, LIGHT: 0.03, JOINED: 0.03}

    def view(number: int) -> Render:
        def render(candidate: Candidate, seed: int, spp: int) -> Any:
            clock.now += times[candidate]
            rng = np.random.default_rng([seed, number, CANDIDATES.index(candidate)])
            image = rng.gamma(4, 0.25, SHAPE[:2])
            if candidate != PLAIN:
                image += np.kron(rng.normal(0, 0.15 / 4, (4, 4)), np.ones((8, 8)))
                image[8:12, 8:12] += rng.gamma(1, 1, (4, 4))
            return np.repeat(image[..., None], 3, -1).astype(np.float32)

        return render

    _, compared = run(list(map(view, range(8))), times, clock, spp=1, seconds=60, seed=1000 * seed, keep=[LIGHT])
    assert best(compared.values()).candidate != PLAIN


@pytest.mark.slow
def test_the_spread_holds_how_much_the_views_differ() -> None:
    """Light paths are twice as good in half of the views and half as good in the others, so 8 views tell little."""
    clock, ratios, spreads = Clock(), [], []
    good = {PLAIN: 0.5, LIGHT: 0.05, JOINED: 0.5}
    bad = {PLAIN: 0.5, LIGHT: 0.5, JOINED: 0.5}
    rng = np.random.default_rng(0)
    for seed in range(24):  # the spread of so many is known to 15 %
        views = [gamma_noise(good if rng.random() < 0.5 else bad, EQUAL, clock) for _ in range(8)]
        row = run(views, EQUAL, clock, seconds=8, seed=1000 * seed)[1][LIGHT]
        ratios.append(row.relative_cost)
        spreads.append(row.spread or 0)
    assert 0.6 < np.mean(spreads) / np.std(ratios) < 1.6


def test_black_views_are_left_out_and_nothing_but_black_is_not_measured() -> None:
    clock = Clock()
    dark: Render = lambda *_: np.zeros(SHAPE, np.float32)  # noqa: E731
    lit = gamma_noise({PLAIN: 0.5, LIGHT: 0.1, JOINED: 0.3}, EQUAL, clock)
    assert run([dark, lit], EQUAL, clock, seconds=1)[0].views == 1
    assert run([dark], EQUAL, clock, seconds=1)[0] == PilotResult((), 0.0, 0)


def test_no_views_and_images_that_are_not_finite_are_refused() -> None:
    broken: Render = lambda *_: np.full(SHAPE, np.nan, np.float32)  # noqa: E731
    for renders, named in (([], "renders"), ([broken], "finite")):
        with pytest.raises(ValueError, match=named):
            run(renders, EQUAL, Clock())


# -------------------------------------------------------------------------------------------------------- real scenes


def renderer(name: str, clock: Clock) -> tuple[Render, dict[Candidate, float]]:
    """A hard scene by `bdpt`; times are those of the paths, so that the outcome depends on no machine."""
    scene, plugins = mi.load_dict(HARD_SCENES[name](32), optimize=False), {}
    times = {c: (1 + c.light_ratio + c.connections) * 1e-3 for c in CANDIDATES}

    def render(candidate: Candidate, seed: int, spp: int) -> Any:
        clock.now += spp * times[candidate]
        if candidate not in plugins:
            settings = {"connections": candidate.connections, "light_ratio": candidate.light_ratio}
            plugins[candidate] = mi.load_dict({"type": "bdpt", "max_depth": 8, "record": True, **settings})
        image = plugins[candidate].render(scene, sensor=scene.sensors()[0], seed=seed, spp=spp)
        return np.array(image, np.float32)[..., :3]

    return render, times


def test_a_glass_caustic_gets_light_paths_whatever_a_short_pilot_happens_to_see() -> None:
    clock = Clock()
    render, times = renderer("glass_caustic", clock)
    _, compared = run([render], times, clock, seconds=1.5, seed=10_000)
    assert best(compared.values()).candidate.light_ratio > 0
    assert best(compared.values()).relative_cost < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cornell", "mirror_room", "cove", "rotated_envmap"])
def test_the_choice_holds_on_images_that_the_pilot_has_not_seen(name: str) -> None:
    """Error × time of the chosen settings is within a fifth of the least, which leaves room for the noise of both."""
    clock = Clock()
    render, times = renderer(name, clock)
    chosen = best(run([render], times, clock, seconds=1.0)[1].values()).candidate
    weights = view_weights([render(JOINED, 50_000 + i, 32) for i in range(4)])
    assert weights is not None
    errors = [
        pair_errors([(render(c, 60_000 + 2 * i, 4), render(c, 60_001 + 2 * i, 4)) for c in CANDIDATES], weights)[0]
        for i in range(16)
    ]
    costs = np.mean(errors, axis=0) * list(times.values())
    assert costs[CANDIDATES.index(chosen)] < 1.2 * costs.min()
