"""The time of images, by renderers whose time is known."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from photonfarm.renderer.strategy.budget import ImageCost, time_images
from photonfarm.renderer.strategy.candidates import PLAIN, Candidate

JOINED = Candidate(1, 1.0)
CANDIDATES = [PLAIN, JOINED]


class Machine:
    """Renders in a known time, which is disturbed; the first image of each kind has to be compiled."""

    def __init__(self, time_s: Callable[[Candidate, int], float], disturbed: float = 0.0) -> None:
        self.now = 0.0
        self.images = 0
        self._time_s = time_s
        self._disturbed = disturbed
        self._compiled: set[tuple[Candidate, int]] = set()
        self._rng = np.random.default_rng(1)

    def render(self, candidate: Candidate, _: int, spp: int) -> Any:
        compiling = 0.0 if (candidate, spp) in self._compiled else 0.5
        self._compiled.add((candidate, spp))
        self.images += 1
        self.now += compiling + self._time_s(candidate, spp) * (1 + self._disturbed * self._rng.exponential())

    def clock(self) -> float:
        return self.now


def straight(candidate: Candidate, spp: int) -> float:
    return 0.002 + spp * (0.0004 if candidate == PLAIN else 0.0011)


def test_short_images_are_repeated_until_their_times_are_known() -> None:
    """The samples that one candidate has for the time of another repeat within 5 %, where images scatter by 20 %."""
    bought = []
    for _ in range(3):
        machine = Machine(straight, disturbed=0.2)
        costs = time_images(machine.render, CANDIDATES, 4, 2.0, machine.clock)
        bought.append((costs[JOINED].time_s(4) - costs[PLAIN].fixed_s) / costs[PLAIN].sample_s)
        assert machine.now < 2.0 + 0.1 + 6 * 0.5
    assert bought == pytest.approx([11.0] * 3, rel=0.05)


def test_images_are_timed_at_the_samples_that_are_used() -> None:
    """The first 5 samples take half as long as those that follow, as if images fitted into the processor's cache."""

    def bent(candidate: Candidate, spp: int) -> float:
        return 0.002 + 0.0002 * min(spp, 5) + 0.0004 * max(spp - 5, 0)

    machine = Machine(bent)
    cost = time_images(machine.render, [PLAIN], 16, 1.0, machine.clock)[PLAIN]
    assert cost.time_s(32) == pytest.approx(bent(PLAIN, 32), rel=1e-6)


def test_large_rooms_are_timed_by_few_images_of_few_samples() -> None:
    machine = Machine(lambda _, spp: 1.0 + spp)
    costs = time_images(machine.render, CANDIDATES, 64, 12.0, machine.clock)
    assert costs == {c: ImageCost(pytest.approx(1.0), pytest.approx(1.0)) for c in CANDIDATES}
    assert machine.now < 80
    assert machine.images <= 2 * (2 + 4 * 2)


def test_a_machine_that_slows_down_slows_down_all_candidates() -> None:
    machine = Machine(straight)
    machine._time_s = lambda candidate, spp: straight(candidate, spp) * (1 + machine.images / 50)
    costs = time_images(machine.render, CANDIDATES, 4, 1.0, machine.clock)
    assert costs[JOINED].sample_s / costs[PLAIN].sample_s == pytest.approx(0.0011 / 0.0004, rel=0.1)


def test_a_time_buys_whole_samples_and_one_at_least() -> None:
    cost = ImageCost(fixed_s=1.0, sample_s=2.0)
    assert [cost.bought(s) for s in (0.5, 3.0, 5.9, 6.1, 1e9)] == [1, 1, 2, 3, 65536]
    assert [cost.pays(s) for s in (2.3, 2.5)] == [False, True]
