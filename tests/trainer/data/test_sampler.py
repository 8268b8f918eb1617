"""Which samples are drawn while more of them arrive."""

from collections import Counter

import pytest

from photonfarm.trainer.data.batch_stream import RoundSampler


def grown(sampler: RoundSampler) -> list[tuple[int, ...]]:
    """Draws while rows arrive in three lots."""
    draws = []
    for first, last, times in ((0, 10, 12), (10, 14, 5), (14, 40, 9)):
        sampler.add(range(first, last))
        draws += [sampler.draw(4) for _ in range(times)]
    return draws


def test_once_nothing_arrives_all_are_drawn_equally_often_to_within_one() -> None:
    sampler = RoundSampler(seed=3, catch_up=2)
    grown(sampler)
    for _ in range(100):
        sampler.draw(4)
    visits = sampler.state()["visits"]
    assert visits.max() - visits.min() <= 1


def test_rows_that_arrive_late_are_drawn_more_often_but_not_alone() -> None:
    sampler = RoundSampler(seed=0, catch_up=2)
    sampler.add(range(20))
    for _ in range(50):
        sampler.draw(4)
    sampler.add(range(20, 40))
    drawn = Counter(row >= 20 for _ in range(20) for row in sampler.draw(4))
    assert drawn[True] > 1.5 * drawn[False] > 0


@pytest.mark.parametrize("rows", [4, 5, 40])
def test_the_rows_of_a_batch_differ_where_there_are_enough(rows: int) -> None:
    sampler = RoundSampler(seed=1, catch_up=5)
    sampler.add(range(rows - 1))
    for _ in range(9):
        sampler.draw(3)
    sampler.add([rows - 1])
    assert all(len(set(sampler.draw(4))) == 4 for _ in range(50))


def test_nothing_can_be_drawn_before_anything_arrives() -> None:
    with pytest.raises(ValueError, match="arrived"):
        RoundSampler(seed=0, catch_up=2).draw(1)


def test_equal_seeds_and_arrivals_give_equal_draws_and_other_seeds_do_not() -> None:
    assert grown(RoundSampler(0, 2)) == grown(RoundSampler(0, 2)) != grown(RoundSampler(1, 2))


@pytest.mark.parametrize("lot", [1, 2, 3, 6])
def test_draws_do_not_depend_on_the_lots_in_which_rows_arrived_between_them(lot: int) -> None:
    whole, lots = RoundSampler(0, 2), RoundSampler(0, 2)
    for first in (0, 12, 24):
        whole.add(range(first, first + 12))
        for row in range(first, first + 12, lot):
            lots.add(range(row, row + lot))
        again = RoundSampler(0, 2)
        again.restore(lots.state())
        lots = again
        assert [whole.draw(4) for _ in range(7)] == [lots.draw(4) for _ in range(7)]


def test_a_restored_sampler_goes_on_as_the_first_would_have() -> None:
    first, second = RoundSampler(5, 2), RoundSampler(5, 2)
    grown(first)
    second.restore(first.state())
    assert [first.draw(3) for _ in range(30)] == [second.draw(3) for _ in range(30)]
