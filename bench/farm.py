#!/usr/bin/env python3
"""What a farm costs besides rendering: where a worker's time goes, and two workers against one.

    python bench/farm.py [--spec room] [--jobs 10] [--rows 32] [--repetitions 4] [--quick] [--folder DIR] [--out DIR]

The account is kept inside a worker's child, as it is but for clocks around its parts, which takes jobs from an embedded
Redis and commits them to a store. Two workers against one are `photonfarm work --until-complete` on the same samples;
beside them the same rendering without queue and store, and computing that needs nothing but a processor, as two
processors that share a core do less than twice the work. Exit code 0.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import results
import workers
from photonfarm.renderer import jobs
from photonfarm.renderer.worker_child import RenderWorker
from photonfarm.renderer.worker_settings import WorkerSettings
from photonfarm.shared import queue
from photonfarm.shared.plan import SHARD_ROWS
from photonfarm.shared.processes import tied
from photonfarm.shared.redis_server import EmbeddedRedis
from photonfarm.shared.scene import load_spec
from photonfarm.shared.store import JobWriter, SceneStore, Store, markers
from photonfarm.shared.submission import submit

QUICK = {"jobs": 8, "rows": 4, "repetitions": 1}
QUEUE_TARGET = 0.01
PAIR_TARGET = 1.85
SPINS = 12_000_000  # of a loop: about a second
WRITER = "writer of job"  # how a JobWriter's thread is named


# ---------------------------------------------------------------------------------------------------------- the account


@dataclass(frozen=True, slots=True)
class Account:
    """Where the time of one worker went, its first job apart; seconds per job, wall and processor."""

    jobs: int  # those after the first
    start_s: float  # from the process's start until it takes its first job
    first_s: float  # the first job, which loads the scene and compiles its kernels
    wall_s: Mapping[str, float]  # by part
    cpu_s: Mapping[str, float]  # by part, of all threads while the worker's own is there
    writer_cpu_s: float  # of the thread that writes rows
    queue_shares: Sequence[float]  # of wall time, job by job

    def share(self, *parts: str) -> float:
        """Of the loop's wall time."""
        return sum(self.wall_s[part] for part in parts) / sum(self.wall_s.values())


PARTS = {
    "scene": "rendering: edits, buffers, photons, half-estimates",
    "rows": "store: rows checked, encoded and handed to the writer",
    "commit": "store: commit",
    "rest": "rest of a job: seeds, checks, the plan's rows",
    "queue": "queue: all outside the job",
}


class Ledger:
    """Seconds by part of a worker, added up in its own process, with a copy of the sums for every job."""

    def __init__(self) -> None:
        self._sums: defaultdict[str, float] = defaultdict(float)
        self.copies: list[dict[str, float]] = []  # when the first job is taken, and after each

    def watch(self, owner: Any, name: str, part: str) -> None:
        """Count the time inside a method of a class or an object."""
        method = getattr(owner, name)

        def timed(*arguments: Any, **options: Any) -> Any:
            wall, cpu = time.perf_counter(), time.process_time()
            try:
                return method(*arguments, **options)
            finally:
                self._sums[part] += time.perf_counter() - wall
                self._sums[f"{part}, cpu"] += time.process_time() - cpu

        setattr(owner, name, timed)

    def watch_threads(self, prefix: str, part: str) -> None:
        """Count the processor time of threads with such a name, each at its end."""
        run = threading.Thread.run

        def timed(thread: threading.Thread) -> None:
            run(thread)
            if thread.name.startswith(prefix):
                self._sums[part] += time.thread_time()

        threading.Thread.run = timed  # type: ignore[method-assign, assignment]

    def load(self, spec: Any) -> jobs.SceneRenderer:
        """What a worker loads, watched."""
        scene = jobs.load_scene(spec)
        for name in ("apply", "buffers", "photons", "render_halves"):
            self.watch(scene, name, "scene")
        return scene

    def copy(self) -> None:
        """Keep the sums as they are now, with the clocks."""
        self.copies.append({**self._sums, "loop": time.perf_counter(), "loop, cpu": time.process_time()})


def keep_account(pipe: Any, store: Path, url: str) -> None:
    """A worker's child until all is complete; sends what its ledger holds."""
    ledger = Ledger()

    class Watched(RenderWorker):
        def execute_job(self, job: Any, queue: Any) -> None:
            if not ledger.copies:
                ledger.copy()
            super().execute_job(job, queue)
            ledger.copy()

    for name in ("radiance", "buffers", "photons"):
        ledger.watch(JobWriter, name, "rows")
    ledger.watch(JobWriter, "commit", "commit")
    ledger.watch(jobs.ShardRenderer, "render", "render")
    ledger.watch_threads(WRITER, "writer")
    settings = WorkerSettings(store=str(store), redis_url=url, name="worker-1", until_complete=True, quiet=True)
    opened = Store(store)
    jobs.serve(jobs.ShardRenderer(opened, worker=settings.name, load=ledger.load))
    Watched(settings, opened, queue.connect(url)).run()
    pipe.send(ledger.copies)


def account(folder: Path, options: argparse.Namespace) -> Account:
    """Of one worker, over `options.jobs` jobs after its first."""
    with EmbeddedRedis(folder / "redis") as redis:
        planned(folder / "store", redis.url, options.jobs + 1, options)
        context = multiprocessing.get_context("spawn")  # Dr.Jit does not outlive a fork
        here, there = context.Pipe()
        began = time.perf_counter()
        process = context.Process(target=keep_account, args=(there, folder / "store", redis.url), daemon=True)
        process.start()
        there.close()
        copies = here.recv()
        process.join()
    return accounted(began, copies)


def accounted(began: float, copies: Sequence[Mapping[str, float]]) -> Account:
    """The account that a ledger's copies hold, of a process that began at a time of the same clock."""
    taken, first, last = copies[0], copies[1], copies[-1]
    count = len(copies) - 2
    whole, cpu = (parts_between(first, last, unit) for unit in ("", ", cpu"))
    each = [parts_between(before, after, "") for before, after in pairwise(copies[1:])]
    return Account(
        jobs=count,
        start_s=taken["loop"] - began,
        first_s=first["loop"] - taken["loop"],
        wall_s={part: seconds / count for part, seconds in whole.items()},
        cpu_s={part: seconds / count for part, seconds in cpu.items()},
        writer_cpu_s=(last["writer"] - first["writer"]) / count,
        queue_shares=[parts["queue"] / sum(parts.values()) for parts in each],
    )


def parts_between(before: Mapping[str, float], after: Mapping[str, float], unit: str) -> dict[str, float]:
    """Seconds of each part between two copies; together they are the loop's."""
    spent = {part: after[part + unit] - before[part + unit] for part in ("loop", "render", "scene", "rows", "commit")}
    rest = spent["render"] - spent["scene"] - spent["rows"] - spent["commit"]
    found = {**spent, "rest": rest, "queue": spent["loop"] - spent["render"]}
    return {part: found[part] for part in PARTS}


# -------------------------------------------------------------------------------------------------- two workers and one


@dataclass(frozen=True, slots=True)
class Run:
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


def pair_of(what: str, runs: Sequence[tuple[Run, Run]]) -> Pair:
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


def cost_of_company(one: Run, two: Run) -> float:
    """Processor time of two at work over that of one, for the pieces of work that both have done."""
    same = one.cpu_s.keys() & two.cpu_s.keys()
    return sum(two.cpu_s[number] for number in same) / sum(one.cpu_s[number] for number in same)


def planned(store: Path, url: str, count: int, options: argparse.Namespace) -> SceneStore:
    """A new store with a number of whole jobs, which are queued: every sample has a configuration of its own."""
    request = {"modifications": count * options.rows, "views": 1, "passes": 1, "seed": 0}
    submission = submit(options.spec, store, url, shard_rows=options.rows, **request)
    return Store(store).scene(submission.scene_id)


def farm(folder: Path, options: argparse.Namespace, count: int) -> Run:
    """Jobs of a number of workers in the steady state."""
    folder = Path(tempfile.mkdtemp(dir=folder))
    with EmbeddedRedis(folder / "redis") as redis:
        scene = planned(folder / "store", redis.url, options.jobs, options)
        told = {"PHOTONFARM_STORE": str(folder / "store"), "PHOTONFARM_REDIS_URL": redis.url}
        verb = [sys.executable, "-m", "photonfarm.shared.cli", "work", "--until-complete", "--quiet", "--name"]
        running = [
            subprocess.Popen(tied([*verb, f"worker-{i}"]), env={**os.environ, **told}, stdin=subprocess.DEVNULL)
            for i in range(count)
        ]
        codes = [process.wait() for process in running]
    if any(codes):
        raise SystemExit("a worker has failed; what it said stands above")
    steady = steady_ends(ends_of_jobs(scene), count)
    rate = sum((len(ends) - 1) / (ends[-1].at - ends[0].at) for ends in steady)
    return Run(rate, {end.job: end.cpu_s for ends in steady for end in ends[1:]})


class End(NamedTuple):
    """The end of a job."""

    at: float
    job: int
    cpu_s: float  # its processor time


def ends_of_jobs(scene: SceneStore) -> Sequence[Sequence[End]]:
    """Every worker's, in order, by the times of the markers and what is in them."""
    found: dict[str, list[End]] = {}
    for job in scene.committed_jobs():
        placed = scene.storage.local(markers.name_of(scene.name, job)).stat().st_mtime
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


class Twins:
    """Two processes that do the same piece of work whenever they are asked to, and answer with its processor time."""

    def __init__(self, serve: Callable[..., None], *options: Any) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipes = []
        for _ in range(2):
            here, there = context.Pipe()
            context.Process(target=serve, args=(there, *options), daemon=True).start()
            there.close()
            self._pipes.append(here)
        self.run(2)  # both are up and warm

    def run(self, count: int) -> Run:
        """One piece by each of the first processes, at once."""
        start = time.perf_counter()
        for pipe in self._pipes[:count]:
            pipe.send(True)
        cpu_s = statistics.fmean([pipe.recv() for pipe in self._pipes[:count]])
        return Run(count / (time.perf_counter() - start), {0: cpu_s})

    def end(self) -> None:
        """Let them go."""
        for pipe in self._pipes:
            pipe.send(False)


def render(pipe: Any, name: str, rows: int) -> None:
    """A process whose piece of work is a job's samples, without a queue or a store."""
    spec = load_spec(name)
    scene = jobs.load_scene(spec)

    def one_job() -> None:
        for number in range(rows):
            workers.make_sample(scene, number)

    answer(pipe, one_job)


def compute(pipe: Any) -> None:
    """A process whose piece of work needs nothing but a processor."""

    def loop() -> None:
        total = 0
        for i in range(SPINS):
            total ^= i

    answer(pipe, loop)


def answer(pipe: Any, work: Callable[[], object]) -> None:
    """Do a piece of work as often as it is asked for."""
    while pipe.recv():
        began = time.process_time()
        work()
        pipe.send(time.process_time() - began)


def pairs(folder: Path, options: argparse.Namespace) -> list[Pair]:
    """All pairs, the runs of each next to each other, one and two first by turns."""
    rendering, computing = Twins(render, options.spec, options.rows), Twins(compute)
    ways: dict[str, Callable[[int], Run]] = {
        "workers, jobs": partial(farm, folder, options),
        "the same rendering without queue and store, jobs": rendering.run,
        "computing alone, loops": computing.run,
    }
    runs: dict[str, list[tuple[Run, Run]]] = {what: [] for what in ways}
    for i in range(options.repetitions):
        for what, run in ways.items():
            found = {count: run(count) for count in ((1, 2) if i % 2 == 0 else (2, 1))}
            runs[what].append((found[1], found[2]))
    rendering.end()
    computing.end()
    return [pair_of(what, found) for what, found in runs.items()]


# ------------------------------------------------------------------------------------------------------------- the page


def account_table(found: Account) -> str:
    """The parts, and below them the writer's thread, whose time is within theirs."""
    wall, cpu = sum(found.wall_s.values()), sum(found.cpu_s.values())
    lines = [
        [text, *(cells(found.wall_s[part], wall)), *(cells(found.cpu_s[part], cpu))] for part, text in PARTS.items()
    ]
    lines.append(["**all**", *cells(wall, wall), *cells(cpu, cpu)])
    lines.append(["among it: the writer's thread", "", "", *cells(found.writer_cpu_s, cpu)])
    return results.table(["part", "ms per job", "share", "processor, ms per job", "share"], lines)


def cells(seconds: float, whole: float) -> tuple[str, str]:
    return f"{1e3 * seconds:.1f}", f"{100 * seconds / whole:.2f} %"


def pair_table(found: Sequence[Pair]) -> str:
    lines = [
        [
            pair.what,
            f"{pair.one:.3f}",
            f"{pair.two:.3f}",
            f"×{pair.ratio:.2f} ({pair.ratio_from:.2f} … {pair.ratio_to:.2f})",
            f"×{pair.cpu_ratio:.2f}",
        ]
        for pair in found
    ]
    header = ["two against one", "one, per second", "two, per second", "ratio", "by processor time"]
    return results.table(header, lines)


def page(found: Account, two: Sequence[Pair], options: argparse.Namespace) -> str:
    spec = load_spec(options.spec)
    shares = sorted(100 * share for share in found.queue_shares)
    job_by_job = f"{shares[0]:.2f} … {shares[-1]:.2f} %, job by job"
    queue_share, store_share = 100 * found.share("queue"), 100 * found.share("rows", "commit")
    farm, rendering, computing = two
    return f"""# The farm

`{options.spec}` at {spec.film.width} × {spec.film.height}, 2 × {spec.transport.half_spp} samples per pixel, in jobs of
{options.rows} samples, each with a configuration of its own.

- **Queue overhead: {queue_share:.2f} %** of a worker's time passes outside its jobs ({job_by_job}).
  The target is at most {100 * QUEUE_TARGET:g} %.
- **Store overhead: {store_share:.2f} %** of a worker's time its rendering thread spends on the store.
- **Two workers** do **×{farm.ratio:.2f}** the jobs of one. The target is ×{PAIR_TARGET:g}. On this machine two
  processes that render the same without queue and store do ×{rendering.ratio:.2f} what one does, and two that only
  compute ×{computing.ratio:.2f}.

## Where a worker's time goes

Inside a worker's child, from the end of its first job to that of its last, {found.jobs} jobs later, with clocks around
the parts of the thread that renders. Apart from that, it starts in {found.start_s:.1f} s, and its first job, which
loads the scene and compiles its kernels or finds them in Dr.Jit's cache, takes {found.first_s:.1f} s. Processor time is
that of all threads while the rendering one is in a part; so the writer's thread, which writes rows while the next ones
are rendered, is spread over them.

{account_table(found)}

## Two workers

`photonfarm work --until-complete` with an embedded Redis, the same {options.jobs} jobs for one worker and for two.
What is counted are whole jobs, from when each worker has ended its first until one has ended its last. All sides
{options.repetitions} times by turns; medians. **Ratio**: of neighbouring runs, median (least … greatest). **By
processor time**: twice what work takes with one at it over what the same takes with two (a worker's jobs as their
markers tell, without the commit), which is the ratio if nobody had to wait: for a processor that others use, the disk,
or each other.

{pair_table(two)}

{results.footer("farm")}"""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--spec", default="room", help="a built-in spec")
    parser.add_argument("--jobs", type=int, default=10, help="of a run")
    parser.add_argument("--rows", type=int, default=SHARD_ROWS, help="samples of a job")
    parser.add_argument("--repetitions", type=int, default=4)
    parser.add_argument("--quick", action="store_true", help="a minute, for figures that only show that it works")
    parser.add_argument("--folder", type=Path, help="on the disk to use (that of temporary files)")
    results.add_options(parser)
    options = parser.parse_args()
    if options.quick:
        vars(options).update(QUICK)
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        found = account(Path(folder, "account"), options)
        two = pairs(Path(folder), options)
    values = {"account": asdict(found), "pairs": [asdict(pair) for pair in two]}
    results.write("farm", page(found, two, options), values, options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
