"""The pilot on renderers whose variance and time are known, and on scenes whose answer is."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from photonfarm.renderer.scene import backend

mi = backend.load(threads=1)

from photonfarm.core.statistics import block_z_test  # noqa: E402
from photonfarm.renderer.strategy.candidates import PLAIN, Candidate, Render  # noqa: E402
from photonfarm.renderer.strategy.noise import BlockSums, charge_for_missed, pair_errors, view_weights  # noqa: E402
from photonfarm.renderer.strategy.pilot import choose  # noqa: E402
from photonfarm.renderer.strategy.plan_text import reasons_for  # noqa: E402
from tests.stability.scenes.hard_scenes import HARD_SCENES  # noqa: E402 - after the variant is set

LIGHT, JOINED = Candidate(0, 1.0), Candidate(1, 1.0)
CANDIDATES = [PLAIN, LIGHT, JOINED]
SHAPE = (32, 32, 3)


class Clock:
    """Seconds that pass only when somebody renders."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def gamma_noise(variance: dict[Candidate, float], time_s: dict[Candidate, float], clock: Clock) -> Render:
    """Images of mean 1 and a known variance of one sample, gamma distributed, at a known time a sample."""

    def render(candidate: Candidate, seed: int, spp: int) -> Any:
        clock.now += time_s[candidate] * spp
        rng = np.random.default_rng([seed, CANDIDATES.index(candidate)])
        v = variance[candidate] / spp
        return rng.gamma(1 / v, v, SHAPE).astype(np.float32)

    return render


def test_error_times_time_is_what_it_is_by_construction() -> None:
    clock = Clock()
    render = gamma_noise({PLAIN: 0.5, LIGHT: 0.1, JOINED: 0.05}, {PLAIN: 0.01, LIGHT: 0.02, JOINED: 0.08}, clock)
    choice = choose(render, CANDIDATES, seconds=50, spp=4, clock=clock, keep=CANDIDATES)
    assert choice.candidate == LIGHT
    # relMSE against r² + 0.01·mean² is v/(4·1.01), a little less as the brighter of two noisy references counts
    assert [row.error for row in choice.measured] == pytest.approx([v / 4.04 for v in (0.5, 0.1, 0.05)], rel=0.08)
    expected = [1, 0.4, 0.8]
    for row, cost in zip(choice.measured, expected, strict=True):
        assert abs(row.relative_cost - cost) <= 4 * (row.spread or 0) + 1e-12  # 6e-5 by chance
    assert [row.time_s for row in choice.measured] == pytest.approx([0.04, 0.08, 0.32])


def test_the_pilot_keeps_its_time() -> None:
    clock = Clock()
    render = gamma_noise(dict.fromkeys(CANDIDATES, 0.2), dict.fromkeys(CANDIDATES, 0.01), clock)
    choice = choose([render] * 3, CANDIDATES, seconds=7, spp=4, clock=clock)
    assert choice.views == 3
    assert 5 < clock.now <= 7


def test_the_better_half_is_measured_longer_and_what_is_kept_to_the_end() -> None:
    clock = Clock()
    many = [PLAIN, *(Candidate(0, float(r)) for r in range(1, 8))]

    def render(candidate: Candidate, seed: int, spp: int) -> Any:
        clock.now += 0.01
        return np.random.default_rng([seed, int(candidate.light_ratio)]).gamma(
            4, (1 + 0.3 * abs(candidate.light_ratio - 3)) / 4, SHAPE
        ).astype(np.float32) / np.float32(1 + 0.3 * abs(candidate.light_ratio - 3)) + np.float32(
            0.02 * abs(candidate.light_ratio - 3) * np.random.default_rng([seed, 99]).standard_normal(SHAPE)
        )

    choice = choose(render, many, seconds=100, spp=1, clock=clock, keep=[many[7]])
    images = {row.candidate: row.errors.images for row in choice.measured}
    assert images[PLAIN] == images[many[7]] == max(images.values())
    assert min(images.values()) == 8 < max(images.values())


def caustic(odds: dict[Candidate, float], clock: Clock) -> Render:
    """A background of little noise, and in a corner light of mean 1 that comes in samples of some odds."""

    def render(candidate: Candidate, seed: int, spp: int) -> Any:
        clock.now += 0.01
        rng = np.random.default_rng([seed, CANDIDATES.index(candidate)])
        image = 1 + 0.1 * rng.standard_normal((*SHAPE[:2], 1))
        image[:8, :8] += (rng.random((8, 8, 1)) < odds[candidate]) / odds[candidate]
        return np.broadcast_to(image, SHAPE).astype(np.float32)

    return render


@pytest.mark.parametrize("seed", range(8))
def test_light_that_a_candidate_is_too_unlikely_to_find_counts_against_it(seed: int) -> None:
    clock = Clock()
    odds = {PLAIN: 1e-7, LIGHT: 0.5, JOINED: 1e-7}  # 64 pixels of some dozen images: never seen
    choice = choose(caustic(odds, clock), CANDIDATES, seconds=2, seed=1000 * seed, clock=clock)
    plain = choice.row(PLAIN)
    assert choice.candidate == LIGHT
    assert plain.missed > 0.9 * plain.error
    assert choice.row(LIGHT).missed == 0
    said = reasons_for(choice.row(LIGHT), choice.measured, choice.shared)
    assert any(f"{PLAIN} misses light that others find" in reason for reason in said)
    # what is charged never exceeds the variance there is: of the corner, E²/q over its share of the image
    assert plain.missed < 1 / odds[PLAIN] * 64 / 1024


@pytest.mark.parametrize("seed", range(4))
def test_a_cheap_candidate_that_misses_light_is_watched_until_the_time_is_up(seed: int) -> None:
    """A few images of plain path tracing tell little of the light in 16 pixels that only light paths find."""
    clock = Clock()

    def view(number: int) -> Render:
        def render(candidate: Candidate, seed: int, spp: int) -> Any:
            clock.now += 0.01 if candidate == PLAIN else 0.03
            rng = np.random.default_rng([seed, number, CANDIDATES.index(candidate)])
            image = rng.gamma(4, 0.25, SHAPE[:2])
            if candidate != PLAIN:
                image += np.kron(rng.normal(0, 0.15 / 4, (4, 4)), np.ones((8, 8)))
                image[8:12, 8:12] += rng.gamma(1, 1, (4, 4))
            return np.repeat(image[..., None], 3, -1).astype(np.float32)

        return render

    choice = choose(
        list(map(view, range(8))), CANDIDATES, seconds=60, spp=1, seed=1000 * seed, keep=[LIGHT], clock=clock
    )
    assert choice.candidate != PLAIN


@pytest.mark.slow
def test_the_spread_holds_how_much_the_views_differ() -> None:
    """Light paths are twice as good in half of the views and half as good in the others, so 8 views tell little."""
    clock, ratios, spreads = Clock(), [], []
    good = {PLAIN: 0.5, LIGHT: 0.05, JOINED: 0.5}
    bad = {PLAIN: 0.5, LIGHT: 0.5, JOINED: 0.5}
    rng = np.random.default_rng(0)
    for seed in range(24):  # the spread of so many is known to 15 %
        views = [
            gamma_noise(good if rng.random() < 0.5 else bad, dict.fromkeys(CANDIDATES, 0.01), clock) for _ in range(8)
        ]
        row = choose(views, CANDIDATES, seconds=clock.now + 8, spp=4, seed=1000 * seed, clock=clock).row(LIGHT)
        ratios.append(row.relative_cost)
        spreads.append(row.spread or 0)
    assert 0.6 < np.mean(spreads) / np.std(ratios) < 1.6


@pytest.mark.parametrize("seed", range(20))
def test_among_equal_candidates_nobody_is_charged(seed: int) -> None:
    clock = Clock()
    noisy = gamma_noise(dict.fromkeys(CANDIDATES, 20.0), dict.fromkeys(CANDIDATES, 0.01), clock)  # skewness 9
    choice = choose(noisy, CANDIDATES, seconds=2, seed=1000 * seed, clock=clock)
    assert all(row.missed < 0.1 * row.error for row in choice.measured)


def test_one_lucky_sample_does_not_convict_the_others() -> None:
    rng = np.random.default_rng(5)
    ordinary, lucky = BlockSums(), BlockSums()
    weights = np.ones(SHAPE, np.float32)
    for i in range(4):
        a, b, c, d = (1 + 0.1 * rng.standard_normal((4, *SHAPE))).astype(np.float32)
        c[3, 3] += 5000.0 * (i == 2)
        ordinary.add(a, b, weights)
        lucky.add(c, d, weights)
    assert charge_for_missed(ordinary, [lucky]) == 0


def test_bright_samples_that_all_candidates_share_are_not_counted() -> None:
    images = (1 + 0.1 * np.random.default_rng(6).standard_normal((4, *SHAPE))).astype(np.float32)
    images[[0, 2], 5, 5] += 3000.0  # in the first image of either candidate
    errors, shared = pair_errors([(images[0], images[1]), (images[2], images[3])], np.ones(SHAPE, np.float32))
    assert shared == pytest.approx(3000**2 / 2 / 1024, rel=0.01)
    assert max(errors) < 2e-4 * shared


def test_a_bright_sample_that_a_candidate_alone_has_is_counted() -> None:
    images = (1 + 0.1 * np.random.default_rng(7).standard_normal((4, *SHAPE))).astype(np.float32)
    images[0, 5, 5] += 3000.0
    (lucky, other), shared = pair_errors([(images[0], images[1]), (images[2], images[3])], np.ones(SHAPE, np.float32))
    assert shared == 0
    assert lucky == pytest.approx(3000**2 / 2 / 1024, rel=0.01)
    assert other == pytest.approx(0.01, rel=0.3)


def test_a_pixel_at_the_edge_of_a_light_does_not_rule_the_error() -> None:
    """Few samples miss the part of a light that a pixel holds; the pixels around it do not."""
    images = np.full((8, 16, 16, 3), 0.1, np.float32)
    images[:, 4:8, 4:8] = 20.0
    images[:, 4, 4:8] = 0.1  # none of the samples hit
    weights = view_weights(list(images))
    assert weights is not None
    assert weights[4, 5, 0] < 1 / 5


def test_black_views_are_left_out_and_nothing_but_black_is_path_traced() -> None:
    clock = Clock()
    dark: Render = lambda *_: np.zeros(SHAPE, np.float32)  # noqa: E731
    lit = gamma_noise({PLAIN: 0.5, LIGHT: 0.1, JOINED: 0.3}, dict.fromkeys(CANDIDATES, 0.01), clock)
    assert choose([dark, lit], CANDIDATES, seconds=1, clock=clock).views == 1
    choice = choose([dark], CANDIDATES, seconds=1, clock=clock)
    assert (choice.candidate, choice.views, choice.measured) == (PLAIN, 0, ())


def test_no_views_and_images_that_are_not_finite_are_refused() -> None:
    broken: Render = lambda *_: np.full(SHAPE, np.nan, np.float32)  # noqa: E731
    for renders, named in (([], "renders"), (broken, "finite")):
        with pytest.raises(ValueError, match=named):
            choose(renders, CANDIDATES)


# -------------------------------------------------------------------------------------------------------- real scenes


def renderer(scene: Any, max_depth: int = 8) -> Callable[[Candidate, int, int], Any]:
    plugins: dict[Candidate, Any] = {}

    def render(candidate: Candidate, seed: int, spp: int) -> Any:
        if candidate not in plugins:
            settings = {"connections": candidate.connections, "light_ratio": candidate.light_ratio}
            plugins[candidate] = mi.load_dict({"type": "bdpt", "max_depth": max_depth, **settings})
        image = plugins[candidate].render(scene, sensor=scene.sensors()[0], seed=seed, spp=spp)
        return np.array(image, np.float32)[..., :3]

    return render


def sample_count_clock(render: Render, clock: Clock) -> Render:
    """Time as the paths it takes, so that the outcome does not depend on the machine."""

    def timed(candidate: Candidate, seed: int, spp: int) -> Any:
        clock.now += spp * (1 + candidate.light_ratio + candidate.connections) * 1e-3
        return render(candidate, seed, spp)

    return timed


@pytest.mark.parametrize("seed", [1, 2])
def test_a_glass_caustic_gets_light_paths_whatever_a_short_pilot_happens_to_see(seed: int) -> None:
    clock = Clock()
    scene = mi.load_dict(HARD_SCENES["glass_caustic"](32), optimize=False)
    render = sample_count_clock(renderer(scene), clock)
    choice = choose(render, CANDIDATES, seconds=1.5, spp=4, seed=seed * 10_000, clock=clock)
    assert choice.candidate.light_ratio > 0
    assert choice.row(choice.candidate).relative_cost < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cornell", "mirror_room", "cove"])
def test_the_choice_holds_on_images_that_the_pilot_has_not_seen(name: str) -> None:
    """Error × time of the chosen settings is within a fifth of the least, which leaves room for the noise of both."""
    clock = Clock()
    render = sample_count_clock(renderer(mi.load_dict(HARD_SCENES[name](32), optimize=False)), clock)
    choice = choose(render, CANDIDATES, seconds=1.0, spp=4, clock=clock)
    weights = view_weights([render(JOINED, 50_000 + i, 32) for i in range(4)])
    assert weights is not None
    errors = [
        pair_errors([(render(c, 60_000 + 2 * i, 4), render(c, 60_001 + 2 * i, 4)) for c in CANDIDATES], weights)[0]
        for i in range(16)
    ]
    costs = np.mean(errors, axis=0) * [1 + c.light_ratio + c.connections for c in CANDIDATES]
    assert costs[CANDIDATES.index(choice.candidate)] < 1.2 * costs.min()


def test_a_ball_under_the_sky_gets_none() -> None:
    clock = Clock()
    scene = mi.load_dict(HARD_SCENES["rotated_envmap"](32), optimize=False)
    render = sample_count_clock(renderer(scene), clock)
    choice = choose(render, CANDIDATES, seconds=1, spp=4, clock=clock)
    assert choice.candidate == PLAIN


def test_chosen_and_unchosen_settings_have_one_mean() -> None:
    scene = mi.load_dict(HARD_SCENES["cove"](32), optimize=False)
    render = renderer(scene)
    clock, candidates = Clock(), [PLAIN, LIGHT, Candidate(0, 0.25), JOINED]
    choice = choose(sample_count_clock(render, clock), candidates, seconds=1, spp=4, clock=clock)
    assert len(choice.measured) == 4
    chosen = np.stack([render(choice.candidate, 500 + i, 32) for i in range(16)])
    for row in choice.measured:
        if row.candidate != choice.candidate:
            other = np.stack([render(row.candidate, 900 + i, 32) for i in range(16)])
            test = block_z_test(chosen, other, blocks=4, significance=1e-4)
            assert test.passed, f"{row.candidate}: largest |z| {test.z_max:.2f}, mean ratio {test.mean_ratio:.4f}"
