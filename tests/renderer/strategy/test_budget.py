"""A budget counts all of a measurement; what does not fit is left out or said; and the time of images."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from photonfarm.core.errors import IncompleteError
from photonfarm.renderer.strategy.budget import Budget, compile_within, time_images
from photonfarm.renderer.strategy.candidates import PLAIN, Candidate, ImageCost, Render

JOINED = Candidate(1, 1.0)
CANDIDATES = [Candidate(0, 1.0), PLAIN, JOINED, Candidate(2, 1.0)]


class Machine:
    """Renders in a known time, which is disturbed, after compiling each kind of image."""

    def __init__(
        self, time_s: Callable[[Candidate, int], float], compiling_s: float = 0.5, disturbed: float = 0.0
    ) -> None:
        self.now, self.images = 0.0, 0
        self.time_s, self._compiling_s, self._disturbed = time_s, compiling_s, disturbed
        self._compiled: set[tuple[Candidate, int]] = set()
        self._rng = np.random.default_rng(1)

    def render(self, candidate: Candidate, _: int, spp: int) -> Any:
        self.now += self._compiling_s * ((candidate, spp) not in self._compiled)
        self._compiled.add((candidate, spp))
        self.images += 1
        self.now += self.time_s(candidate, spp) * (1 + self._disturbed * self._rng.exponential())

    def clock(self) -> float:
        return self.now


def chosen(seconds: float) -> list[Candidate]:
    machine = Machine(lambda _, spp: 0.01 * spp, compiling_s=1.0)
    budget = Budget(seconds, machine.clock)
    return compile_within(machine.render, CANDIDATES, {PLAIN, JOINED}, budget, "attic")


def test_with_time_for_all_every_setting_is_compared_and_with_less_the_last_are_left_out() -> None:
    """Each takes a second, and half of the time is for them."""
    assert set(chosen(100)) == set(CANDIDATES)
    assert chosen(5) == [PLAIN, JOINED, CANDIDATES[0]]
    assert chosen(3.5) == [PLAIN, JOINED]


def test_with_too_little_time_it_is_said_how_much_would_do() -> None:
    with pytest.raises(IncompleteError, match=r"attic does not fit in --seconds 3: .* give it 10$") as no:
        chosen(3)
    assert no.value.exit_code == 7
    assert chosen(10), "what the message names is enough"


# ----------------------------------------------------------------------------------------------------- times of images


def straight(candidate: Candidate, spp: int) -> float:
    return 0.002 + spp * (0.0004 if candidate == PLAIN else 0.0011)


def test_short_images_are_repeated_until_their_times_are_known() -> None:
    """The samples that one candidate has for the time of another repeat within 5 %, where images scatter by 20 %."""
    bought = []
    for _ in range(3):
        machine = Machine(straight, disturbed=0.2)
        costs = time_images([machine.render], [PLAIN, JOINED], 4, 2.0, machine.clock)
        bought.append((costs[JOINED].time_s(4) - costs[PLAIN].fixed_s) / costs[PLAIN].sample_s)
        assert machine.now < 2.0 + 0.1 + 6 * 0.5
    assert bought == pytest.approx([11.0] * 3, rel=0.05)


def test_images_are_timed_at_the_samples_that_are_used() -> None:
    """The first 5 samples take half as long as those that follow, as if images fitted into the processor's cache."""

    def bent(candidate: Candidate, spp: int) -> float:
        return 0.002 + 0.0002 * min(spp, 5) + 0.0004 * max(spp - 5, 0)

    machine = Machine(bent)
    cost = time_images([machine.render], [PLAIN], 16, 1.0, machine.clock)[PLAIN]
    assert cost.time_s(32) == pytest.approx(bent(PLAIN, 32), rel=1e-6)


def test_large_rooms_are_timed_by_few_images_of_few_samples_in_several_views() -> None:
    machine = Machine(lambda _, spp: 1.0 + spp)

    def view(slower_s: float) -> Render:
        def render(candidate: Candidate, seed: int, spp: int) -> Any:
            machine.now += slower_s
            machine.render(candidate, seed, spp)

        return render

    costs = time_images([view(0.0), view(1.0), view(0.5)], [PLAIN, JOINED], 64, 12.0, machine.clock)
    assert costs == {c: ImageCost(pytest.approx(1.5), pytest.approx(1.0)) for c in (PLAIN, JOINED)}
    assert machine.images <= 2 * (2 + 4 * 2)


def test_a_machine_that_slows_down_slows_down_all_candidates() -> None:
    machine = Machine(straight)
    machine.time_s = lambda candidate, spp: straight(candidate, spp) * (1 + machine.images / 50)
    costs = time_images([machine.render], [PLAIN, JOINED], 4, 1.0, machine.clock)
    assert costs[JOINED].sample_s / costs[PLAIN].sample_s == pytest.approx(0.0011 / 0.0004, rel=0.1)
