"""A budget counts all of a measurement, and what does not fit is left out or said with the time that it takes."""

from dataclasses import dataclass

import pytest

from photonfarm.core.errors import IncompleteError
from photonfarm.renderer.strategy.budget import Budget, affordable
from photonfarm.renderer.strategy.candidates import PLAIN, Candidate

CANDIDATES = [Candidate(0, 1.0), PLAIN, Candidate(1, 1.0), Candidate(2, 1.0)]


@dataclass
class Machine:
    """Renders at once on a clock of its own: compiling takes 1 s, an image 0.01 s."""

    now: float = 0.0
    compiled: frozenset[Candidate] = frozenset()

    def clock(self) -> float:
        return self.now

    def render(self, candidate: Candidate, _seed: int, spp: int) -> None:
        self.now += 0.01 * spp + (candidate not in self.compiled)
        self.compiled |= {candidate}


def chosen(seconds: float) -> list[Candidate]:
    machine = Machine()
    budget = Budget(seconds, machine.clock)
    return affordable(machine.render, CANDIDATES, {PLAIN, CANDIDATES[2]}, budget, 0.1, "attic")  # type: ignore[arg-type]


def test_with_time_for_all_every_setting_is_compared() -> None:
    assert set(chosen(1000)) == set(CANDIDATES)


def test_with_less_time_fewer_are_and_the_required_ones_are_among_them() -> None:
    found = chosen(22)
    assert {PLAIN, CANDIDATES[2]} <= set(found) < set(CANDIDATES)


def test_the_last_settings_are_left_out_first() -> None:
    assert chosen(30) == [PLAIN, CANDIDATES[2], CANDIDATES[0]]


def test_with_too_little_time_it_is_said_how_much_would_do() -> None:
    with pytest.raises(IncompleteError, match=r"attic does not fit in --seconds 5: .* give it 20, or 40 for all") as no:
        chosen(5)
    assert no.value.exit_code == 7
    assert chosen(20), "what the message names is enough"
    assert set(chosen(40)) == set(CANDIDATES)


def test_items_are_taken_while_their_share_of_the_time_lasts() -> None:
    machine = Machine()
    budget = Budget(10, machine.clock)
    taken = []
    for item in budget.take_within(0.25, range(9), 2):
        machine.now += 1
        taken.append(item)
    assert taken == [0, 1, 2]
    machine.now = 9
    assert list(budget.take_within(0.25, range(9), 2)) == [0, 1]
