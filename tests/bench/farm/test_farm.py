"""The farm's account, the steady state, and the figures of the page; its workers are run by `make bench-farm` alone."""

from __future__ import annotations

import argparse
import threading

import pytest

from bench.farm import farm, pairs
from bench.farm.account import WRITER, Account, Ledger, accounted

# of three jobs after the first, in seconds: 10 of rendering, 1 of the store's, 0.5 of the rest, 0.1 of the queue
JOB = {"loop": 11.6, "render": 11.5, "scene": 10.0, "rows": 0.4, "commit": 0.6}


def copy_after(jobs: float) -> dict[str, float]:
    sums = {part: 5.0 + jobs * seconds for part, seconds in JOB.items()}
    return {**sums, **{f"{part}, cpu": seconds / 2 for part, seconds in sums.items()}, "writer": 0.2 * jobs}


def account() -> Account:
    taken = {"loop": 2.0, "loop, cpu": 1.0}
    return accounted(1.25, [taken, *map(copy_after, range(4))])


def test_the_account_is_of_the_jobs_after_the_first() -> None:
    found = account()
    assert (found.jobs, found.start_s, found.first_s) == (3, 0.75, 3.0)
    assert found.wall_s == pytest.approx({"scene": 10.0, "rows": 0.4, "commit": 0.6, "rest": 0.5, "queue": 0.1})
    assert found.cpu_s == pytest.approx({part: seconds / 2 for part, seconds in found.wall_s.items()})
    assert found.writer_cpu_s == pytest.approx(0.2)
    assert found.queue_shares == pytest.approx([0.1 / 11.6] * 3)
    assert found.share("rows", "commit") == pytest.approx(1.0 / 11.6)


def test_the_ledger_counts_threads_by_their_names(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threading.Thread, "run", threading.Thread.run)  # put back afterwards
    ledger = Ledger()
    ledger.watch_threads(WRITER, "writer")
    for name in ("writer of job 3", "another"):
        thread = threading.Thread(target=sum, args=(range(1_000_000),), name=name)
        thread.start()
        thread.join()
        ledger.copy()
    counted = [copy["writer"] for copy in ledger.copies]
    assert counted[0] > 0
    assert counted[1] == counted[0]


def ends(*times: float) -> list[pairs.End]:
    return [pairs.End(at, job, 1.0) for job, at in enumerate(times)]


def test_the_steady_state_is_while_every_worker_has_whole_jobs_to_do() -> None:
    early, late = ends(2.0, 4.0, 6.0, 8.0, 10.0), ends(5.0, 7.0, 9.0)
    assert pairs.steady_ends([early, late], 2) == [early[2:4], late]
    assert pairs.steady_ends([early], 1) == [early]


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_run_without_a_steady_state_ends_the_program(count: int) -> None:
    with pytest.raises(SystemExit, match="take more"):
        pairs.steady_ends([ends(1.0, 9.0), ends(8.0, 9.5)], count)


def test_the_page_has_the_figures_and_their_targets() -> None:
    options = argparse.Namespace(spec="room", rows=32, jobs=10, repetitions=4)
    two = [
        pairs.Pair(what, 1.0, factor, factor, factor, factor, 1.95)
        for what, factor in (("workers", 1.87), ("rendering", 1.91), ("computing", 1.99))
    ]
    text = farm.page(account(), two, options)
    assert "**Queue overhead: 0.86 %**" in text
    assert "**Store overhead: 8.62 %**" in text
    assert "**×1.87** the jobs of one. The target is ×1.85" in text
    assert "| queue: all outside the job | 100.0 | 0.86 % | 50.0 | 0.86 % |" in text
    assert "| computing | 1.000 | 1.990 | ×1.99 (1.99 … 1.99) | ×1.95 |" in text
