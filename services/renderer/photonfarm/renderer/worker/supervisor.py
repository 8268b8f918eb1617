"""The supervisor: starts the worker's child again whenever it ends, until there is nothing left to do."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import FrameType

import redis

from photonfarm import queue
from photonfarm.core.errors import BackendError, IncompleteError, QueueError, StoreError
from photonfarm.core.processes import Stop
from photonfarm.queue.rq_adapter import fail_of_worker
from photonfarm.renderer.worker.outcomes import JobCounts
from photonfarm.renderer.worker.settings import GRACE_S, JOB_IN_HAND, JOBS_SO_FAR, RECYCLED, REFUSED, WorkerSettings
from photonfarm.store import Store
from photonfarm.store.io.storage import is_vacant
from photonfarm.store.read.find import scene_named


class Registration:
    """A worker as others know it: in Redis, or, with a share, nowhere."""

    def __init__(self, settings: WorkerSettings) -> None:
        """Connect; raises QueueError if the worker needs a Redis and there is none."""
        self._ttl_s = settings.heartbeat_ttl_s
        self._connection = None if settings.share is not None else queue.connect(settings.queue_url)

    def close(self) -> None:
        """Close the connection."""
        if self._connection is not None:
            self._connection.close()

    def serve(self, store: Store) -> None:
        """Register the store that the worker serves. Raises QueueError if another one is served."""
        if self._connection is not None:
            queue.serve(self._connection, store)

    @contextlib.contextmanager
    def hold_name(self, wanted: str) -> Iterator[str]:
        """Hold a name that no other live worker has, until the block ends. Raises QueueError."""
        if self._connection is None:
            yield wanted
            return
        with queue.redis_errors(f"told of worker {wanted}"):
            name = queue.take_name(self._connection, wanted, ttl_s=self._ttl_s)
            fail_of_worker(self._connection, name, "its worker was killed", counts=True)  # that of a predecessor
        try:
            yield name
        finally:
            with contextlib.suppress(redis.RedisError):
                queue.bury(self._connection, name)

    def beat(self, name: str) -> None:
        """Count as alive while there is no child, unless Redis fails."""
        if self._connection is not None:
            with contextlib.suppress(redis.RedisError), self._connection.pipeline() as pipeline:
                queue.beat(pipeline, name, queue.WorkerReport(), ttl_s=self._ttl_s)
                pipeline.execute()

    def release_work(self, store: Store, name: str, lost: str | None, how: str) -> None:
        """Free at once what a child had in hand when it ended; the job that is `lost` was tried, and is kept as failed.

        A job of a child that was to stop, or that has ended and could not tell Redis, counts as no try.
        """
        if lost is not None:
            with contextlib.suppress(OSError):
                queue.keep_failure(store, lost, how, worker=name)
        if self._connection is not None:
            with contextlib.suppress(redis.RedisError):
                fail_of_worker(self._connection, name, how, counts=lost is not None)
            self.beat(name)

    def release(self, store: Store) -> None:
        """End the registration of the store if this was its last worker, unless Redis fails."""
        if self._connection is not None:
            with contextlib.suppress(redis.RedisError):
                queue.release(self._connection, store)


BACKOFF_S = (0.1, 1.0, 2.0, 4.0, 8.0, 16.0, 30.0)

POLL_S = 1.0
"""The seconds between checks for a missing store, and for signals that arrive while the child's output is read."""

HUNG_LINES = 8
"""The number of reported lines of the stack of a job that the deadline ended: the innermost calls, where it hung."""


@dataclass(frozen=True, slots=True)
class ChildOutput:
    """What a child wrote before it ended."""

    last: str  # its last line, which may state why it ended; "" if there is none
    job: str | None  # the job that it began last
    in_hand: bool  # whether that job had not ended
    timed_out: bool  # whether the deadline ended it
    hung: str  # the last stack of the dump then; otherwise ""
    counts: JobCounts  # of the jobs that ended

    @classmethod
    def of(cls, text: str) -> ChildOutput:
        """Parse a child's output: its reports of jobs, other lines, and the dump of faulthandler, main thread last."""
        written, timeout, dump = f"\n{text}".partition("Timeout (")
        lines = written.splitlines()
        jobs = [line.removeprefix(JOB_IN_HAND) for line in lines if line.startswith(JOB_IN_HAND)]
        counted = [line for line in lines if line.startswith(JOBS_SO_FAR)]
        others = [line for line in lines if line.strip() and not line.startswith((JOB_IN_HAND, JOBS_SO_FAR))]
        stack = dump.rpartition("Thread 0x")[2].splitlines()[1:] if timeout else []
        counts = JobCounts.of(counted[-1]) if counted else JobCounts()
        in_hand = written.rfind(f"\n{JOB_IN_HAND}") > written.rfind(f"\n{JOBS_SO_FAR}")
        hung = "\n".join(stack[:HUNG_LINES])
        return cls(others[-1] if others else "", jobs[-1] if jobs else None, in_hand, bool(timeout), hung, counts)

    @property
    def overdue(self) -> str | None:
        """The job that the deadline ended; None if it ended none."""
        return self.job if self.timed_out else None


class Supervisor:
    """Keeps a child running until nothing is left to do."""

    def __init__(self, settings: WorkerSettings, command: tuple[str, ...], report: Callable[[str], None]) -> None:
        """Take the child's command line, and the function that logs events."""
        self._settings = settings
        self._command = command
        self._report = report
        self._stop = Stop()
        self._child: subprocess.Popen[bytes] | None = None
        self._counts = JobCounts()

    def run(self) -> None:
        """Run children one after the other; raises the errors that a new child would meet again."""
        vacant = is_vacant(self._settings.store)
        if vacant and self._settings.until_complete:
            raise StoreError(f"{self._settings.store}: there is no store; `photonfarm submit` makes one")
        store = None if vacant else Store(self._settings.store)
        with self._signals(), contextlib.closing(Registration(self._settings)) as known:
            if store is not None:
                known.serve(store)
            try:
                with self._hold_name(known):
                    store = store or self._wait_for_store(known)
                    if store is not None:
                        known.serve(store)
                        self._supervise(store, known)
            finally:
                if (self._counts.jobs or self._counts.failed) and not self._settings.quiet:
                    self._report(f"worker {self._settings.name}: ended: {self._counts}")
                if store is not None:
                    known.release(store)

    @contextlib.contextmanager
    def _hold_name(self, known: Registration) -> Iterator[None]:
        """Hold a name that no other live worker has, until the block ends; raises QueueError if Redis fails."""
        wanted = self._settings.name
        with known.hold_name(wanted) as name:
            if name != wanted:
                self._report(f"worker {wanted}: another one of this name is alive, so this one goes by {name}")
            self._settings = self._settings.model_copy(update={"name": name})
            yield

    def _wait_for_store(self, known: Registration) -> Store | None:
        """Wait for the store; None if asked to stop before. The worker counts as alive meanwhile."""
        settings = self._settings
        self._report(f"worker {settings.name}: waiting for a store at {settings.store}")
        while is_vacant(settings.store):
            known.beat(settings.name)
            if self._stop.wait(POLL_S):
                return None
        return Store(settings.store)

    def _supervise(self, store: Store, known: Registration) -> None:
        if self._settings.scene_id is not None:
            scene_id = scene_named(store, self._settings.scene_id)
            self._settings = self._settings.model_copy(update={"scene_id": scene_id})
        failures = 0
        while not self._stop.is_set():
            started = time.monotonic()
            code, output = self._run_child()
            how = ending(code, output, self._settings.deadline_s)
            lost = output.job if output.in_hand and not self._stop.is_set() else None
            known.release_work(store, self._settings.name, lost, how)
            if code == 0 or self._stop.is_set():
                return
            _raise_final(code, output.last)
            if code == RECYCLED:
                failures = 0
                continue
            failures = 0 if time.monotonic() - started > self._settings.steady_s else failures
            pause = BACKOFF_S[min(failures, len(BACKOFF_S) - 1)]
            failures += 1
            self._report(f"worker {self._settings.name}: {how}; starting again in {pause:g} s")
            self._stop.wait(pause)

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
            self._counts += output.counts
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
        self._report(
            f"worker {self._settings.name}: stopping; a job in hand that takes longer than {GRACE_S:g} s "
            "will be rendered again"
        )
        time.sleep(GRACE_S)
        if self._child is not None:
            self._child.kill()


def _read_all(pipe: int) -> bytes:
    """Read a child's output until it ends.

    A read of everything at once would not notice a signal between two parts, until the child writes again: Python
    handles signals only between its own instructions, or when one interrupts a system call.
    """
    content = bytearray()
    while True:
        if select.select([pipe], [], [], POLL_S)[0]:
            part = os.read(pipe, 1 << 16)
            if not part:
                return bytes(content)
            content += part


def ending(code: int, output: ChildOutput, deadline_s: float) -> str:
    """The sentence that states how a child ended.

    faulthandler reads stacks while other threads run on, and sometimes crashes over it (Python 3.11: SIGSEGV). Then the
    deadline ended the child all the same, but the main thread's stack, which comes last, is lacking.
    """
    if output.overdue:
        where = f", while in\n{output.hung}\n" if code > 0 else ""
        return f"job {output.overdue} took longer than --deadline {deadline_s:g} s and was ended{where}"
    if code < 0:
        return f"its child was ended by {signal.Signals(-code).name}"
    return output.last or f"its child ended with exit code {code}, for the reason above"


def _raise_final(code: int, message: str) -> None:
    """Raise the errors that a new child would meet again."""
    if code == REFUSED:
        raise QueueError(message)
    for kind in (StoreError, BackendError, IncompleteError):
        if code == kind.exit_code:
            raise kind(message)
