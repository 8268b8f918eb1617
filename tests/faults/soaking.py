"""A soak: workers, Redis and submitters are killed, stopped and made to forget at random, while a reader looks on.

Invariants, checked all the time: the committed set only grows, and what is committed reads whole and is what an
undisturbed worker renders. In the end every slot is there once, bit for bit, and every marker is the one that was seen
first.
"""

import contextlib
import os
import random
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import analytic_scene as analytic
import redis
import soak_evidence as evidence

from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.plan.request import Request
from photonfarm.queue.connection import connect
from photonfarm.queue.reconciliation import reconcile
from photonfarm.renderer.worker.settings import GRACE_S
from photonfarm.store import SceneStore, Store

HEARTBEAT_TTL_S = 2.0
STOPPED_S = 20.0  # at most, where nobody takes the job meanwhile
COMES_BACK_S = 10.0  # what a child that goes on gets to end its job in
STEADY_S = 0.5  # a child that is killed is started again at once, however often that happens
AT_WORK_S = 5.0  # for so long a child is looked for that has a job in hand
ORPHAN_S = GRACE_S + 10.0  # what a child without its supervisor gets on a busy machine; it takes GRACE_S itself
PORTION = 4  # modifications planned at once: the queue runs dry often, and whoever is idle finds what others left


@dataclass
class Toll:
    """How often each thing was done."""

    kills: int = 0  # workers' children with a job in hand, by SIGKILL
    supervisor_kills: int = 0  # by SIGKILL; its child ends itself, and another supervisor is started
    stops: int = 0  # workers' children with a job in hand, by SIGSTOP, until another worker has committed it
    races: int = 0  # of these: have gone on, and found the job that they had in hand committed by another worker
    redis_kills: int = 0  # by SIGKILL; back after up to 3 s, once after 40 s
    flushes: int = 0  # FLUSHALL
    submitters: int = 0  # pairs of submitters at once

    def left(self, wanted: "Toll") -> list[str]:
        """The names of what has not been done often enough, each as often as it is missing."""
        done = asdict(self)
        return [name for name, count in asdict(wanted).items() for _ in range(count - done[name])]


@dataclass(frozen=True)
class Race:
    """A worker was stopped in a job, and found it committed when it went on."""

    job: int
    worker: str
    committed_by: str


@dataclass(frozen=True)
class Outcome:
    """What a soak showed."""

    toll: Toll
    races: list[Race]
    jobs: int
    samples: int
    reads: int  # samples read and compared while it went on
    seconds: float
    differences: list[str]  # from what must hold


class Soak:
    """One soak, in a folder of its own."""

    def __init__(self, folder: Path, *, jobs: int, workers: int, pause_s: float, seed: int) -> None:
        """Plan at least `jobs` jobs of two samples, a portion at a time; each half takes `pause_s` to render."""
        self._folder = folder
        self._random = random.Random(seed)
        self._jobs = jobs
        self._workers = [f"worker-{number}" for number in range(workers)]
        self._store = Store(folder / "store", create=True)
        self._request = Request(modifications=PORTION, views_per_modification=4, passes=2)
        plan = self._store.plan(analytic.small_spec(), self._request, shard_rows=2)
        self.scene: SceneStore = self._store.scene(plan.scene_id)
        self._journal = evidence.Journal(folder / "journal")
        self._command = self._journal.command(pause_s)
        self._stack = contextlib.ExitStack()
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._orphans: dict[int, float] = {}  # children whose supervisor was killed, and when
        self._stopped: set[str] = set()  # workers that are to be left alone until they have come back
        self._threads: list[threading.Thread] = []
        self._had_outage = False
        self.toll = Toll()
        self.races: list[Race] = []

    # ----------------------------------------------------------------------------------------------------- what happens

    def run(self, wanted: Toll, *, pace_s: tuple[float, float], long_outage_s: float) -> Outcome:
        """Do all that is wanted, in random order, and wait until every job is committed."""
        begun = time.monotonic()
        with EmbeddedRedis(self._folder / "redis") as server, self._stack:
            watcher = self._stack.enter_context(evidence.Watcher(self._store.root, self.scene.scene_id))
            reconcile(self._store, connect(server.url))
            for worker in self._workers:
                self._start(server, worker)
            while self.toll.left(wanted) or self.scene.jobs() < self._jobs:
                time.sleep(self._random.uniform(*pace_s))
                if due := self._due(wanted):
                    getattr(self, f"_do_{self._random.choice(due)}")(server, long_outage_s)
                self._keep_busy()
                self._check(watcher)
            for thread in self._threads:
                thread.join()
            analytic.wait_for(lambda: self._check(watcher) or not self.scene.missing_jobs(), 600)
            for process in self._running.values():
                process.send_signal(signal.SIGTERM)
            assert [process.wait(60) for process in self._running.values()] == [0] * len(self._workers)
            analytic.wait_for(lambda: self._check_orphans() or not self._orphans)
        watcher.check()
        self._store.sweep(stray_age_s=0)
        differences = evidence.differences(self.scene, self._folder / "clean", self._journal, watcher)
        samples = self.scene.progress().committed_samples
        seconds = time.monotonic() - begun
        return Outcome(self.toll, self.races, self.scene.jobs(), samples, watcher.reads, seconds, differences)

    def _start(self, server: EmbeddedRedis, worker: str) -> None:
        """Start a supervisor, and wait until it has its child: it wants a Redis to begin with."""
        process = analytic.start_worker(
            self._store.root,
            server.url,
            self._command,
            name=worker,
            heartbeat_ttl_s=HEARTBEAT_TTL_S,
            steady_s=STEADY_S,
            log=self._folder / f"{worker}.log",
        )
        self._stack.enter_context(process)
        self._stack.callback(process.kill)
        self._running[worker] = process
        analytic.wait_for(lambda: analytic.child_of(process))

    def _keep_busy(self) -> None:
        """Plan more if what is planned is nearly done."""
        if len(self.scene.missing_jobs()) < 2 * len(self._workers):
            self._submit_more()

    def _submit_more(self) -> None:
        modifications = self._request.modifications + PORTION
        self._request = self._request.model_copy(update={"modifications": modifications})
        racers = [
            threading.Thread(target=Store(self._store.root).plan, args=(analytic.small_spec(), self._request))
            for _ in range(2)
        ]
        for racer in racers:
            racer.start()
        for racer in racers:
            racer.join()

    def _due(self, wanted: Toll) -> list[str]:
        """What is left to do, without the races that may be under way."""
        left = self.toll.left(wanted)
        races = left.count("races") - len(self._stopped)
        return [name for name in left if name != "races"] + ["races"] * races

    def _do_kills(self, *_: Any) -> None:
        """The job may be committed, and its end not told to Redis."""
        if found := self._stop_at_work(lambda _: True):
            os.kill(found[1], signal.SIGKILL)
            self.toll.kills += 1

    def _do_supervisor_kills(self, server: EmbeddedRedis, _: float) -> None:
        worker = self._random.choice(self._at_large())
        child = analytic.child_of(self._running[worker])
        if child is None:
            return
        self._running[worker].kill()
        self._running[worker].wait()
        self._orphans[child] = time.monotonic()
        self._start(server, worker)
        self.toll.supervisor_kills += 1

    def _do_races(self, *_: Any) -> None:
        """Stop one child more, unless all others are stopped already."""
        if len(self._at_large()) > 1 and (found := self._stop_at_work(lambda job: not self.scene.is_committed(job))):
            self._stopped.add(found[0])
            self.toll.stops += 1
            self._threads.append(threading.Thread(target=self._await_race, args=found))
            self._threads[-1].start()

    def _do_redis_kills(self, server: EmbeddedRedis, long_outage_s: float) -> None:
        os.kill(server.pid, signal.SIGKILL)
        time.sleep(self._random.uniform(0, 3) if self._had_outage else long_outage_s)
        self._had_outage = True
        server.keep_running()
        self.toll.redis_kills += 1

    def _do_flushes(self, server: EmbeddedRedis, _: float) -> None:
        with contextlib.suppress(redis.RedisError):
            connect(server.url).flushall()
            self.toll.flushes += 1

    def _do_submitters(self, *_: Any) -> None:
        self._submit_more()
        self.toll.submitters += 1

    # -------------------------------------------------------------------------------------------------------- stopping

    def _at_large(self) -> list[str]:
        return [worker for worker in self._workers if worker not in self._stopped]

    def _stop_at_work(self, is_wanted: Callable[[int], bool]) -> tuple[str, int, int] | None:
        """Stop a child that has a wanted job in hand: its worker, itself, and the job; None if for a while none has."""
        until = time.monotonic() + AT_WORK_S
        while time.monotonic() < until:
            worker = self._random.choice(self._at_large())
            child = analytic.child_of(self._running[worker])
            if child is not None and _stop(child):
                job = self._journal.in_hand(child)
                if job is not None and is_wanted(job):
                    return worker, child, job
                os.kill(child, signal.SIGCONT)
            time.sleep(self._random.uniform(0, 0.1))
        return None

    def _await_race(self, worker: str, child: int, job: int) -> None:
        """Let a stopped child go on once another one has committed its job, and see what it makes of that."""
        until = time.monotonic() + STOPPED_S
        while not (is_overtaken := self.scene.is_committed(job)) and time.monotonic() < until:
            time.sleep(0.05)
        os.kill(child, signal.SIGCONT)
        until = time.monotonic() + COMES_BACK_S
        while (in_hand := self._journal.in_hand(child)) == job and time.monotonic() < until:
            time.sleep(0.02)
        if is_overtaken and in_hand != job and ("finds", job) in self._journal.of(child):
            self.races.append(Race(job, worker, self.scene.marker(job)["figures"]["worker"]))
            self.toll.races = len(self.races)
        self._stopped.remove(worker)

    # -------------------------------------------------------------------------------------------------- what must hold

    def _check(self, watcher: Any) -> None:
        """What must hold at any time."""
        watcher.check()
        assert not (twice := self._journal.twice()), f"jobs that were committed more than once: {twice}"
        ended = {worker: process.poll() for worker, process in self._running.items() if process.poll() is not None}
        assert not ended, f"supervisors that have ended, with their exit codes: {ended}"
        self._check_orphans()

    def _check_orphans(self) -> None:
        """A child ends itself soon after its supervisor."""
        self._orphans = {child: since for child, since in self._orphans.items() if _state(child) not in "XZ"}
        for child, since in self._orphans.items():
            lived_s = time.monotonic() - since
            assert lived_s < ORPHAN_S, f"child {child} still runs {lived_s:.0f} s after its supervisor was killed"


def _stop(child: int) -> bool:
    """Stop a child, and return once it stands still; False if it has ended."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(child, signal.SIGSTOP)
        while (state := _state(child)) not in "TXZ":  # it may be in the disk's hands first
            time.sleep(0.001)
        return state == "T"
    return False


def _state(process: int) -> str:
    """A process' state as /proc tells it: T stopped, Z ended and not yet waited for, X gone."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return "X"
