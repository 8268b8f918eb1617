"""Runs that diverge are caught within a few steps by their losses, and runs whose losses have heavy tails never."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from photonfarm.trainer.training.recent_losses import BEFORE, FEW, LOOK_EVERY, RecentLosses, judge

Losses = np.ndarray[tuple[int, ...], np.dtype[np.float64]]


def looks(losses: Losses, untrained: Losses | None = None) -> list[int]:
    """The steps at which a run of these losses is found to diverge; without `untrained` ones the first are these."""
    told, first = losses.tolist(), (losses if untrained is None else untrained)[:FEW].tolist()
    return [
        end
        for end in range(LOOK_EVERY, len(told) + 1, LOOK_EVERY)
        if judge(told[max(end - LOOK_EVERY - BEFORE, 0) : end], first[:end]).is_diverging
    ]


def two_values(share: float) -> Callable[[np.random.Generator, int], Losses]:
    """A share of the batches is a thousand times brighter."""
    return lambda rng, count: np.where(rng.random(count) < share, 1e3, 1.0) * rng.uniform(0.5, 1.5, count)


HEAVY_TAILS: dict[str, Callable[[np.random.Generator, int], Losses]] = {
    "no variance": lambda rng, count: 1 + rng.pareto(1.5, count),
    "no mean": lambda rng, count: 1 + rng.pareto(0.7, count),
    "log-normal": lambda rng, count: np.exp(2 * rng.standard_normal(count)),
    **{f"{share:g} of them bright": two_values(share) for share in (0.003, 0.03, 0.1, 0.3, 0.7)},
}


@pytest.mark.parametrize("name", HEAVY_TAILS)
def test_losses_of_a_heavy_tail_never_send_a_run_back(name: str) -> None:
    """A run of the supplement's length, whose loss falls to a hundredth on the way."""
    rng, steps = np.random.default_rng(0), 150_000
    assert looks(HEAVY_TAILS[name](rng, steps) * np.geomspace(1, 0.01, steps)) == []


@pytest.mark.parametrize("name", HEAVY_TAILS)
def test_the_first_steps_of_a_run_that_learns_nothing_never_send_it_back(name: str) -> None:
    """1000 runs, whose losses are a third to 1.2 of those that the untrained network has on the same batches."""
    rng = np.random.default_rng(1)
    noise = HEAVY_TAILS[name](rng, 1000 * (BEFORE + LOOK_EVERY)).reshape(1000, -1)
    losses = noise * np.exp(rng.uniform(np.log(1 / 3), np.log(1.2), noise.shape))
    assert [looks(*run) for run in zip(losses, noise, strict=True)] == [[]] * 1000


@pytest.mark.parametrize("name", HEAVY_TAILS)
@pytest.mark.parametrize("begins", [1, 4, 15, 25, 40, 60])
def test_a_divergence_in_the_first_steps_is_found_under_the_same_noise(name: str, begins: int) -> None:
    """Losses grow by a half a step to 100 000 times theirs, and stay there, as a network's whose weights are lost."""
    grown = np.minimum(1.5 ** np.maximum(np.arange(200) - begins, 0), 1e5)
    for seed in range(20):
        noise = HEAVY_TAILS[name](np.random.default_rng(seed), 200)
        found = looks(noise * grown, noise)
        assert found
        assert begins < found[0] <= begins + 50


@pytest.mark.parametrize("name", HEAVY_TAILS)
def test_a_divergence_is_found_within_a_few_looks_under_the_same_noise(name: str) -> None:
    """Losses grow by half a step, from any step, and stand out once they are as high as the bright ones, 1000."""
    caught = []
    for begins in range(300, 400):
        losses = HEAVY_TAILS[name](np.random.default_rng(begins), 480)
        found = looks(losses * 1.5 ** np.maximum(np.arange(480) - begins, 0))
        assert found, begins
        caught.append(found[0] - begins)
    assert min(caught) > 0
    stands_out = np.log(1000) / np.log(1.5) if name.split()[0] in ("0.1", "0.3", "0.7") else 4
    assert np.quantile(caught, 0.9) <= stands_out + 25


MEASURED = [0.43, 0.49, 1.06, 0.38, 0.57, 1.23, 1.63, 10.1, 3.66, 27.0, 2.34, 68.3, 1.71, 67.7, 1.03, 1.21, 1.61, 1.48]
"""Of guided_transport at width 64 and rate 1e-3 in veach-ajar, from step 268 on.

The relative loss of images that are far too bright is 1, whatever their size.
"""


def test_one_that_was_measured_is_found_within_twenty_steps() -> None:
    usual = np.random.default_rng(0).uniform(0.35, 0.75, 268)
    later = [1.24, 82.1, 91790.0, 5e5, 3.0, 1.0, 1.0, 2e5, 1.0, 1.0, 1.0, 1.0]
    assert looks(np.concatenate([usual, MEASURED, later]))[0] == 290


def test_losses_that_are_a_little_higher_from_now_on_are_no_divergence() -> None:
    """As where samples arrive that are brighter than all before."""
    rng = np.random.default_rng(0)
    assert looks(np.concatenate([rng.uniform(0.5, 1, 200), rng.uniform(1.5, 4, 200)])) == []


def test_a_loss_that_is_not_finite_is_one_at_once_and_otherwise_the_first_ones_are_judged_by_untrained_ones() -> None:
    assert judge([1.0, float("nan")], []).is_diverging
    assert not judge([1.0] * LOOK_EVERY, [1.0, float("nan")]).is_diverging, "the batch was damaged, and is gone"
    assert judge([1.0] * 500 + [float("inf")], []).is_diverging
    few = [1.0] * (FEW - 1) + [1e9] * LOOK_EVERY
    assert not judge(few, []).is_diverging
    assert judge([1.0, *few], []).is_diverging
    assert judge([1e9] * LOOK_EVERY, [1.0] * LOOK_EVERY).is_diverging
    assert not judge([1e9] * (LOOK_EVERY - 1), [1.0] * LOOK_EVERY).is_diverging
    assert not judge([1e9] * BEFORE + [1e9] * LOOK_EVERY, [1.0] * FEW).is_diverging, "by then they are usual"


def test_a_loss_that_may_be_negative_is_judged_alike() -> None:
    """By its distance from the usual one, in units of that."""
    assert not judge([-1.0] * 100 + [-0.9] * 10, []).is_diverging
    assert judge([-1.0] * 100 + [4.0] * 10, []).is_diverging


def test_losses_are_read_all_at_once_and_continue_from_a_checkpoint() -> None:
    losses, other = RecentLosses(), RecentLosses()
    for step in range(BEFORE + 25):
        losses.add(torch.tensor(0.1 * step, dtype=torch.float32))
    other.restore(losses.state())
    kept = np.arange(15, BEFORE + 25).astype(np.float32) * np.float32(0.1)
    assert other.read() == losses.read() == pytest.approx(kept.tolist())
    assert len(losses.read()) == BEFORE + LOOK_EVERY
