"""The worker: a supervisor, which starts its child again whenever it ends, until there is nothing left to do.

The child (`child`) renders in its own process, so that scenes and kernels stay loaded. It is always a fresh
interpreter, as Dr.Jit's threads do not survive a fork. It gets its settings through stdin, as the Redis URL may hold a
password. It ends when that pipe is closed, so that it cannot outlive its supervisor.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import redis

from photonfarm.core.errors import BackendError, IncompleteError, QueueError, StoreError
from photonfarm.core.formatting import format_count
from photonfarm.core.processes import Stop, process_space
from photonfarm.queue.connection import connect, redis_errors
from photonfarm.queue.failures import keep_failure
from photonfarm.queue.job import Share
from photonfarm.queue.rq_adapter import fail_of_worker
from photonfarm.queue.workers import WorkerReport, beat, bury, read_workers, release, serve, take_name
from photonfarm.renderer.jobs import render as jobs
from photonfarm.renderer.scene import backend
from photonfarm.renderer.worker.settings import (
    GRACE_S,
    JOB_ENDED,
    JOB_IN_HAND,
    LOG_FORMAT,
    RECYCLED,
    REFUSED,
    WorkerSettings,
)
from photonfarm.store import Store
from photonfarm.store.io.storage import is_vacant
from photonfarm.store.read.find import scene_named

CHILD = (sys.executable, "-m", "photonfarm.renderer.worker.child")

BACKOFF_S = (0.1, 1.0, 2.0, 4.0, 8.0, 16.0, 30.0)

POLL_S = 1.0
"""The seconds between checks for a missing store, and for signals that arrive while the child's output is read."""

HUNG_LINES = 8
"""The number of reported lines of the stack of a job that the deadline ended: the innermost calls, where it hung."""

log = logging.getLogger(__name__)


def run_worker(
    store: str | Path,
    redis_url: str | None = None,
    *,
    share: Share | str | None = None,
    name: str | None = None,
    child: Sequence[str] = CHILD,
    report: Callable[[str], None] = log.warning,
    **settings: Any,
) -> None:
    """Render queued jobs until asked to stop, or with `until_complete` until nothing is missing.

    With a `share`, such as "0/4", there is no queue: this worker renders that share of the jobs, and then what is left.
    It waits for a missing store, except with `until_complete`. If another worker has its name, this one appends a
    number. SIGTERM and SIGINT end it after the job in hand, but not later than after GRACE_S, and a second one at once.
    Further `settings` are those of WorkerSettings; `scene_id` may also be the beginning of an id, or a scene's name.
    Raises QueueError if there is no Redis at the start (later outages are waited out) or it serves another store,
    StoreError, BackendError (before it waits for anything, if the device that should render is not there), and
    IncompleteError if jobs have failed and nothing else is left to do.
    """
    backend.device()
    logging.basicConfig(format=LOG_FORMAT, stream=sys.stderr)
    part = Share.parse(share) if isinstance(share, str) else share
    settings |= {"redis_url": redis_url, "share": part, "name": name or _default_name()}
    Supervisor(WorkerSettings(store=str(store), **settings), child, report).run()


def render_job(
    store: str | Path, scene: str, job: int, *, load: jobs.SceneLoader = jobs.load_scene
) -> tuple[bool, float]:
    """Render and commit one job here, without a queue; returns whether it was not committed before, and the seconds.

    `scene` is its id, the beginning of its id, or its name. Errors of the job are raised unchanged; StoreError if the
    store has no such job.
    """
    opened = Store(store)
    scene_id = scene_named(opened, scene)
    planned = opened.scene(scene_id).jobs()
    if not 0 <= job < planned:
        raise StoreError(
            f"{store}: scene {scene_id} has {format_count(planned, 'job')}, numbered from 0; there is no job {job}"
        )
    began = time.monotonic()
    rendered = jobs.ShardRenderer(opened, worker=_default_name(), load=load).render(scene_id, job)
    return rendered, time.monotonic() - began


def _default_name() -> str:
    return f"{socket.gethostname()}-{os.getpid()}"


def check(redis_url: str) -> None:
    """Return if a worker of this host, or container, is alive; raises IncompleteError if none is.

    Raises QueueError without a Redis.
    """
    hosts = {report.host for report in read_workers(connect(redis_url)).values()}
    if process_space() not in hosts:
        raise IncompleteError(f"no worker of {socket.gethostname()} is alive")


@dataclass(frozen=True, slots=True)
class ChildOutput:
    """What a child wrote before it ended."""

    last: str  # its last line, which may state why it ended; "" if there is none
    in_hand: str | None  # the job that it had not ended
    timed_out: bool  # whether the deadline ended it
    hung: str  # the last stack of the dump then; otherwise ""
    endings: Counter[str]  # how its jobs ended, as `JOB_ENDED` says

    @classmethod
    def of(cls, text: str) -> ChildOutput:
        """Parse a child's output: its reports of jobs, other lines, and the dump of faulthandler, main thread last."""
        written, timeout, dump = f"\n{text}".partition("\nTimeout (")
        last, in_hand, endings = "", None, Counter[str]()
        for line in written.splitlines():
            if line.startswith(JOB_IN_HAND):
                in_hand = line.removeprefix(JOB_IN_HAND)
            elif line.startswith(JOB_ENDED):
                in_hand = None
                endings[line.removeprefix(JOB_ENDED)] += 1
            elif line.strip():
                last = line
        stack = dump.rpartition("Thread 0x")[2].splitlines()[1:]
        return cls(last, in_hand, bool(timeout), "\n".join(stack[:HUNG_LINES]), endings)


class Supervisor:
    """Keeps a child running until nothing is left to do."""

    def __init__(self, settings: WorkerSettings, command: Sequence[str], report: Callable[[str], None]) -> None:
        """Take the child's command line, and the function that logs events."""
        self._settings = settings
        self._command = command
        self._report = report
        self._stop = Stop()
        self._child: subprocess.Popen[bytes] | None = None
        self._endings = Counter[str]()  # of the jobs of all children
        self._connection: redis.Redis | None = None  # None with a share, which nobody else knows of

    def run(self) -> None:
        """Run children one after the other; raises the errors that a new child would meet again."""
        vacant = is_vacant(self._settings.store)
        if vacant and self._settings.until_complete:
            raise StoreError(f"{self._settings.store}: there is no store; `photonfarm submit` makes one")
        store = None if vacant else Store(self._settings.store)
        shares = self._settings.share is not None
        with (
            self._signals(),
            contextlib.nullcontext() if shares else connect(self._settings.queue_url) as self._connection,
        ):
            self._take_name()
            try:
                if store := store or self._wait_for_store():
                    if self._connection is not None:
                        serve(self._connection, store)
                    self._supervise(store)
            finally:
                done, failed = self._endings["done"], self._endings["failed"]
                if (done or failed) and not self._settings.quiet:
                    self._tell(f"ended: {format_count(done, 'job')} done{f', {failed} failed' if failed else ''}")
                if self._connection is not None:
                    with contextlib.suppress(redis.RedisError):
                        bury(self._connection, self._settings.name)
                        if store is not None:
                            release(self._connection, store)

    def _tell(self, what: str) -> None:
        self._report(f"worker {self._settings.name}: {what}")

    def _take_name(self) -> None:
        """Take a name that no other live worker has, until the worker ends; raises QueueError if Redis fails."""
        if self._connection is None:
            return
        wanted = self._settings.name
        with redis_errors(f"told of worker {wanted}"):
            name = take_name(self._connection, wanted, ttl_s=self._settings.heartbeat_ttl_s)
            fail_of_worker(self._connection, name, "its worker was killed", counts=True)  # that of a predecessor
        if name != wanted:
            self._tell(f"another one of this name is alive, so this one goes by {name}")
        self._settings = self._settings.model_copy(update={"name": name})

    def _beat(self) -> None:
        """Count as alive while there is no child, unless Redis fails."""
        if self._connection is not None:
            with contextlib.suppress(redis.RedisError), self._connection.pipeline() as pipeline:
                beat(pipeline, self._settings.name, WorkerReport(), ttl_s=self._settings.heartbeat_ttl_s)
                pipeline.execute()

    def _wait_for_store(self) -> Store | None:
        """Wait for the store; None if asked to stop before. The worker counts as alive meanwhile."""
        self._tell(f"waiting for a store at {self._settings.store}")
        while is_vacant(self._settings.store):
            self._beat()
            if self._stop.wait(POLL_S):
                return None
        return Store(self._settings.store)

    def _supervise(self, store: Store) -> None:
        """Run children until one has found everything complete, or a stop is asked for."""
        if self._settings.scene_id is not None:
            scene_id = scene_named(store, self._settings.scene_id)
            self._settings = self._settings.model_copy(update={"scene_id": scene_id})
        failures = 0
        while not self._stop.is_set():
            started = time.monotonic()
            code, output = self._run_child()
            how = ending(code, output, self._settings.deadline_s)
            self._free_work(store, None if self._stop.is_set() else output.in_hand, how)
            if code == 0 or self._stop.is_set():
                return
            if code == REFUSED:
                raise QueueError(output.last)
            for kind in (StoreError, BackendError, IncompleteError):  # a new child would meet them again
                if code == kind.exit_code:
                    raise kind(output.last)
            if code == RECYCLED or time.monotonic() - started > self._settings.steady_s:
                failures = 0
            if code != RECYCLED:
                pause = BACKOFF_S[min(failures, len(BACKOFF_S) - 1)]
                failures += 1
                self._tell(f"{how}; starting again in {pause:g} s")
                self._stop.wait(pause)

    def _free_work(self, store: Store, lost: str | None, how: str) -> None:
        """Free at once what a child had in hand when it ended; the job that is `lost` was tried, and is kept as failed.

        A job of a child that was to stop, or that has ended and could not tell Redis, counts as no try.
        """
        if lost is not None:
            with contextlib.suppress(OSError):
                keep_failure(store, lost, how, worker=self._settings.name)
        if self._connection is not None:
            with contextlib.suppress(redis.RedisError):
                fail_of_worker(self._connection, self._settings.name, how, counts=lost is not None)
            self._beat()

    def _run_child(self) -> tuple[int, ChildOutput]:
        """Run one child; returns its exit code and its output."""
        with subprocess.Popen(
            self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
        ) as self._child:
            if self._child.stdin is None or self._child.stdout is None:
                raise BackendError("the worker's child was started without pipes")
            if self._stop.is_set():  # a stop was requested while it was being started
                self._child.terminate()
            with contextlib.suppress(BrokenPipeError):
                self._child.stdin.write(self._settings.model_dump_json().encode() + b"\n")
                self._child.stdin.flush()  # it stays open: its end shows the child that the supervisor is gone
            output = ChildOutput.of(_read_all(self._child.stdout.fileno()).decode(errors="replace"))
            self._endings += output.endings
            return self._child.wait(), output

    # ---------------------------------------------------------------------------------------------------------- signals

    @contextlib.contextmanager
    def _signals(self) -> Iterator[None]:
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.signal(number, self._on_signal) for number in (signal.SIGTERM, signal.SIGINT)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002
        again = self._stop.is_set()
        self._stop.set()
        if self._child is None:
            return
        self._child.send_signal(signal.SIGKILL if again else signal.SIGTERM)
        if not again:
            threading.Thread(target=self._see_off, daemon=True).start()

    def _see_off(self) -> None:
        """End the child after the grace period: its own handler waits for native code, which may take minutes."""
        self._tell(f"stopping; a job in hand that takes longer than {GRACE_S:g} s will be rendered again")
        time.sleep(GRACE_S)
        if self._child is not None:
            self._child.kill()


def _read_all(pipe: int) -> bytes:
    """Read a child's output until it ends.

    A read of everything at once would not notice a signal between two parts, until the child writes again: Python
    handles signals only between its own instructions, or when one interrupts a system call.
    """
    content = bytearray()
    poller = select.poll()  # select() takes no descriptor above 1023
    poller.register(pipe, select.POLLIN)
    while True:
        if poller.poll(POLL_S * 1000):
            part = os.read(pipe, 1 << 16)
            if not part:
                return bytes(content)
            content += part


def ending(code: int, output: ChildOutput, deadline_s: float) -> str:
    """The sentence that states how a child ended.

    faulthandler reads stacks while other threads run on, and sometimes crashes over it (Python 3.11: SIGSEGV). Then the
    deadline ended the child all the same, but the main thread's stack, which comes last, is lacking.
    """
    if output.timed_out:
        where = f", while in\n{output.hung}\n" if code > 0 else ""
        return f"job {output.in_hand} took longer than --deadline {deadline_s:g} s and was ended{where}"
    if code < 0:
        return f"its child was ended by {signal.Signals(-code).name}"
    return output.last or f"its child ended with exit code {code}, for the reason above"
