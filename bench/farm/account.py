"""Where the time of one worker goes: kept inside its child, which is as it is but for clocks around its parts."""

from __future__ import annotations

import argparse
import multiprocessing
import threading
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.farm.submission import submit
from photonfarm.plan.request import Request
from photonfarm.queue.job import RenderArguments
from photonfarm.renderer.jobs import render as jobs
from photonfarm.renderer.worker.child import RenderWorker
from photonfarm.renderer.worker.settings import WorkerSettings
from photonfarm.scene.spec_loading import NamedSpec
from photonfarm.store import JobWriter, SceneStore, Store

WRITER = "writer of job"  # how a JobWriter's thread is named


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
        """A part's share of the loop's wall time."""
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

    def load(self, spec: Any) -> Any:
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
        def _render(self, job: RenderArguments) -> None:
            if not ledger.copies:
                ledger.copy()
            super()._render(job)
            ledger.copy()

    for name in ("radiance", "buffers", "photons"):
        ledger.watch(JobWriter, name, "rows")
    ledger.watch(JobWriter, "commit", "commit")
    ledger.watch(jobs.ShardRenderer, "render", "render")
    ledger.watch_threads(WRITER, "writer")
    settings = WorkerSettings(store=str(store), redis_url=url, name="worker-1", until_complete=True, quiet=True)
    Watched(settings, Store(store), ledger.load).run()
    pipe.send(ledger.copies)


def planned(store: Path, url: str, count: int, options: argparse.Namespace) -> SceneStore:
    """A new store with a number of whole jobs, which are queued: every sample has a configuration of its own."""
    request = Request(modifications=count * options.rows)
    submission = submit(NamedSpec.load(options.spec), store, url, request, shard_rows=options.rows)
    return Store(store).scene(submission.scene_id)


def account(folder: Path, options: argparse.Namespace) -> Account:
    """The account of one worker, over `options.jobs` jobs after its first."""
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
