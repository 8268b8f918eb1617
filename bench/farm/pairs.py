"""Two at work against one: workers, the same rendering without queue and store, and computing alone."""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from bench.farm.account import planned
from bench.harness.processes import Processes, answer
from photonfarm.core.processes import tie
from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.renderer.jobs import render as jobs
from photonfarm.scene.spec_loading import load_spec
from photonfarm.store import SceneStore
from photonfarm.store.format import markers

SPINS = 12_000_000  # of a loop: about a second


@dataclass(frozen=True, slots=True)
class ConcurrentWork:
    """What a number of processes did at once."""

    rate: float  # per second, all together
    cpu_s: Mapping[int, float]  # processor time of each piece of work, by number: equal ones have equal numbers


@dataclass(frozen=True, slots=True)
class Pair:
    """Two of something against one: work per second, medians, and ratios of neighbouring runs."""

    what: str
    one: float
    two: float
    ratio: float  # median
    ratio_from: float
    ratio_to: float
    cpu_ratio: float  # twice one's processor time for the same work over two's: with a processor for each


def pair_of(what: str, runs: Sequence[tuple[ConcurrentWork, ConcurrentWork]]) -> Pair:
    """The row of neighbouring runs, (one, two)."""
    ratios = sorted(two.rate / one.rate for one, two in runs)
    return Pair(
        what=what,
        one=statistics.median(one.rate for one, _ in runs),
        two=statistics.median(two.rate for _, two in runs),
        ratio=statistics.median(ratios),
        ratio_from=ratios[0],
        ratio_to=ratios[-1],
        cpu_ratio=statistics.median(2 / cost_of_company(one, two) for one, two in runs),
    )


def cost_of_company(one: ConcurrentWork, two: ConcurrentWork) -> float:
    """Processor time of two at work over that of one, for the pieces of work that both have done."""
    same = one.cpu_s.keys() & two.cpu_s.keys()
    return sum(two.cpu_s[number] for number in same) / sum(one.cpu_s[number] for number in same)


def make_sample(scene: Any, number: int) -> None:
    """All that a worker renders for one sample; sample n is the same in every process."""
    from photonfarm.scene.modification import sample_modification
    from photonfarm.scene.view import sample_view

    modification = sample_modification(scene.spec, 0, number)
    view = sample_view(scene.spec, modification.key(scene.spec.radiance_id), 0, 0)
    scene.apply(modification)
    scene.buffers(view)
    scene.photons(number)
    scene.render_halves(view, (2 * number, 2 * number + 1))


def farm(folder: Path, options: argparse.Namespace, count: int) -> ConcurrentWork:
    """Jobs of a number of workers in the steady state."""
    folder = Path(tempfile.mkdtemp(dir=folder))
    with EmbeddedRedis(folder / "redis") as redis:
        scene = planned(folder / "store", redis.url, options.jobs, options)
        told = {"PHOTONFARM_STORE": str(folder / "store"), "PHOTONFARM_REDIS_URL": redis.url}
        verb = [sys.executable, "-m", "photonfarm.cli", "work", "--until-complete", "--quiet", "--name"]
        running = [
            subprocess.Popen(tie([*verb, f"worker-{i}"]), env={**os.environ, **told}, stdin=subprocess.DEVNULL)
            for i in range(count)
        ]
        codes = [process.wait() for process in running]
    if any(codes):
        raise SystemExit("a worker has failed; what it said stands above")
    steady = steady_ends(ends_of_jobs(scene), count)
    rate = sum((len(ends) - 1) / (ends[-1].at - ends[0].at) for ends in steady)
    return ConcurrentWork(rate, {end.job: end.cpu_s for ends in steady for end in ends[1:]})


class End(NamedTuple):
    """The end of a job."""

    at: float
    job: int
    cpu_s: float  # its processor time


def ends_of_jobs(scene: SceneStore) -> Sequence[Sequence[End]]:
    """Every worker's, in order, by the times of the markers and what is in them."""
    found: dict[str, list[End]] = {}
    for job in scene.committed_jobs():
        placed = scene.storage.local(markers.marker_name(scene.name, job)).stat().st_mtime
        figures = scene.marker(job)["figures"]
        found.setdefault(figures["worker"], []).append(End(placed, job, figures["core_s"]))
    return [sorted(ends) for ends in found.values()]


def steady_ends(found: Sequence[Sequence[End]], count: int) -> Sequence[Sequence[End]]:
    """Those of jobs that ended while each of `count` workers was past its first and had not ended its last.

    Between the first and the last of them a worker did whole jobs and nothing else. Ends the program if one did none.
    """
    begin, end = max(ends[0].at for ends in found), min(ends[-1].at for ends in found)
    steady = [[one for one in ends if begin <= one.at <= end] for ends in found]
    if len(steady) != count or any(len(ends) < 2 for ends in steady):
        raise SystemExit("too few jobs for a steady state; take more (--jobs)")
    return steady


def run(twins: Processes, count: int) -> ConcurrentWork:
    """One piece of work by each of the first processes, at once."""
    seconds, cpu_s = twins.ask([True] * count)
    return ConcurrentWork(count / seconds, {0: statistics.fmean(cpu_s)})


def render(pipe: Any, name: str, rows: int) -> None:
    """A process whose piece of work is a job's samples, without a queue or a store."""
    spec = load_spec(name)
    scene = jobs.load_scene(spec)

    def one_job() -> None:
        for number in range(rows):
            make_sample(scene, number)

    timed(pipe, one_job)


def compute(pipe: Any) -> None:
    """A process whose piece of work needs nothing but a processor."""

    def loop() -> None:
        total = 0
        for i in range(SPINS):
            total ^= i

    timed(pipe, loop)


def timed(pipe: Any, work: Callable[[], object]) -> None:
    """Do a piece of work as often as it is asked for, and answer with its processor time."""

    def once(_: Any) -> float:
        began = time.process_time()
        work()
        return time.process_time() - began

    answer(pipe, once)


def pairs(folder: Path, options: argparse.Namespace) -> list[Pair]:
    """All pairs, the runs of each next to each other, one and two first by turns."""
    rendering, computing = Processes(2, render, options.spec, options.rows), Processes(2, compute)
    for twins in (rendering, computing):
        run(twins, 2)  # warms both
    ways: dict[str, Callable[[int], ConcurrentWork]] = {
        "workers, jobs": partial(farm, folder, options),
        "the same rendering without queue and store, jobs": partial(run, rendering),
        "computing alone, loops": partial(run, computing),
    }
    runs: dict[str, list[tuple[ConcurrentWork, ConcurrentWork]]] = {what: [] for what in ways}
    for i in range(options.repetitions):
        for what, way in ways.items():
            found = {count: way(count) for count in ((1, 2) if i % 2 == 0 else (2, 1))}
            runs[what].append((found[1], found[2]))
    rendering.end()
    computing.end()
    return [pair_of(what, found) for what, found in runs.items()]
