"""Shares of the jobs."""

import random
from itertools import pairwise

import pytest

from photonfarm.core.errors import SpecError
from photonfarm.queue.job import Share


@pytest.mark.parametrize("text", ["4/4", "1", "/3", "-1/3", "1/0", "a/b", "1/2/3", "١/٢"])
def test_what_is_no_share_is_refused(text: str) -> None:
    with pytest.raises(SpecError):
        Share.parse(text)


def test_a_share_takes_its_own_jobs_first_and_in_order() -> None:
    order = Share.parse("2/4").order(range(40))
    assert order[:10] == list(range(2, 40, 4))
    assert sorted(order) == list(range(40))


def test_what_others_have_probably_begun_comes_last() -> None:
    missing = [5, 9, 13, 6, 10, 14, 7, 11]  # of the shares 1, 2 and 3; their owners take the first of each
    assert set(Share.parse("0/4").order(missing)[-3:]) == {5, 6, 7}
    assert sorted(Share.parse("0/4").order([5, 6])) == [5, 6], "where nothing else is left, they are taken too"


def test_helpers_take_what_is_left_in_different_orders() -> None:
    left = [job for job in range(800) if job % 8 == 7]  # of the worker that has not come
    orders = [Share.parse(f"{number}/8").order(left) for number in range(7)]
    for one, another in pairwise(orders):
        assert sum(a == b for a, b in zip(one, another, strict=True)) < 10
    assert orders[0] == Share.parse("0/8").order(left[::-1]), "the order does not depend on how they were listed"


LOOK_S, GIVEN_UP_S, JOB_S = 30.0, 2.0, 6.0


def wasted(workers: int, jobs: int, *, absent: int, seed: int = 0) -> float:
    """The share of all core time that goes into jobs that another worker commits first, of a simulated farm.

    Workers take between half and twice the usual time for a job, and some never come. As `ShareSource` does, each lists
    what is missing every 30 s, looks once more before it renders a job, and gives one up soon after another's commit.
    """
    rng = random.Random(seed)
    pace_s = [rng.uniform(0.5, 2.0) * JOB_S for _ in range(workers - absent)]
    waiting: list[list[int]] = [[] for _ in pace_s]
    look_due, began, job_of = [0.0] * len(pace_s), [0.0] * len(pace_s), dict[int, int]()
    committed: set[int] = set()
    turn_s = dict.fromkeys(range(len(pace_s)), 0.0)
    lost, now = 0.0, 0.0
    while turn_s:
        worker = min(turn_s, key=turn_s.__getitem__)
        now = turn_s.pop(worker)
        if (done := job_of.pop(worker, None)) is not None:
            if done in committed:
                lost += now - began[worker]
            committed.add(done)
            for other in (other for other, job in job_of.items() if job == done):
                turn_s[other] = min(turn_s[other], now + GIVEN_UP_S)
        if now >= look_due[worker] or committed.issuperset(waiting[worker]):
            missing = set(range(jobs)) - committed
            look_due[worker], waiting[worker] = now + LOOK_S, Share(number=worker, of=workers).order(missing)
        waiting[worker] = [job for job in waiting[worker] if job not in committed]
        if waiting[worker]:
            began[worker], job_of[worker] = now, waiting[worker].pop(0)
            turn_s[worker] = now + pace_s[worker]
    assert committed == set(range(jobs))
    return lost / (now * len(pace_s))


@pytest.mark.parametrize(("workers", "absent"), [(4, 0), (8, 0), (8, 4)])
def test_little_time_goes_into_jobs_that_another_worker_commits_first(workers: int, absent: int) -> None:
    """As docs/slurm.md says. It comes from the end, so the share is smaller the more jobs there are."""
    few, many = (
        max(wasted(workers, each * workers, absent=absent, seed=seed) for seed in (0, 1)) for each in (50, 150)
    )
    print(f"{workers} workers, {absent} absent: {few:.3f} of the time with 50 jobs each, {many:.3f} with 150")
    assert few < 0.08
    assert many < 0.04
