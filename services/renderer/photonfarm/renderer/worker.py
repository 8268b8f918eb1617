"""The worker: a supervisor and the child that it keeps alive.

The child is an RQ worker that renders in its own process, so that scenes and kernels stay warm. What RQ leaves out is
here: a heartbeat while a job runs, a deadline that also ends native code, recycling, and filling the queue when idle.
The child is always a fresh interpreter, as Dr.Jit's threads do not survive a fork; it gets its settings through stdin,
as the Redis URL may hold a password, and ends when that pipe does, so that it cannot outlive its supervisor.
"""

from __future__ import annotations

import contextlib
import faulthandler
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import redis
from pydantic import Field
from redis import Redis
from rq import SimpleWorker
from rq.exceptions import DequeueTimeout, InvalidJobOperation, NoSuchJobError
from rq.serializers import JSONSerializer
from rq.utils import as_text
from rq.worker.base import StopRequested

from photonfarm.renderer import jobs
from photonfarm.shared import queue
from photonfarm.shared.errors import (
    BackendError,
    CorruptError,
    IncompleteError,
    PhotonfarmError,
    QueueError,
    StoreError,
)
from photonfarm.shared.queue import STARTS, RenderJob
from photonfarm.shared.scene import Frozen
from photonfarm.shared.store import Store

CHILD = (sys.executable, "-m", "photonfarm.renderer.worker")
RECYCLED = 75
"""Exit code of a child that wants a successor."""

STARTS_ALLOWED = 5
"""Starts of one job without an end, after which it counts as failed: it kills its workers."""

STARTS_TTL_S = 6 * 3600

GRACE_S = 5.0
"""What a job in hand gets to end in once its worker is to stop: one that is nearly done is kept, and the worker is gone
within the 10 s that Docker gives. A longer job is killed, and as it has no marker it is rendered again."""

_QUEUE_TROUBLE = (QueueError, redis.RedisError, InvalidJobOperation, NoSuchJobError)
"""Faults of the queue, not of the job: a Redis that lost its memory no longer knows the job in hand."""

RQ_WORKER_TTL_S = 120
"""After this, and a minute, RQ forgets a worker that was killed while idle; our own heartbeat is what counts."""

BACKOFF_S = (0.1, 1.0, 2.0, 4.0, 8.0, 16.0, 30.0)
STEADY_S = 30.0
"""A child that lived this long was well: its successor starts at once again."""

log = logging.getLogger(__name__)

Positive = Annotated[float, Field(gt=0)]


class WorkerSettings(Frozen):
    """What a worker is told; each default with its reason."""

    store: str
    redis_url: str
    name: Annotated[str, Field(min_length=1, max_length=128)]
    until_complete: bool = False
    scene_id: str | None = None  # fill the queue with, and wait for, this scene alone; None: all of the store
    max_jobs: Annotated[int, Field(ge=1)] = 500  # then a fresh child: bounds what leaks, at < 1 % of the time
    max_rss_bytes: Annotated[int, Field(ge=1)] = 8 << 30  # a CPU worker needs about 1 GB; GPU contexts some more
    deadline_s: Positive = 1800.0  # jobs are meant to take 5 to 30 s; a hundred times that is a hang
    heartbeat_ttl_s: Positive = 90.0  # longer than native code holds Python's lock
    idle_s: Annotated[int, Field(ge=1)] = 2  # between looks at the store, while the queue is empty


# --------------------------------------------------------------------------------------------------------- supervisor


def run_worker(
    store: str | Path,
    redis_url: str,
    *,
    name: str | None = None,
    child: Sequence[str] = CHILD,
    say: Callable[[str], None] | None = None,
    **settings: Any,
) -> None:
    """Render what is queued until told to stop, or with `until_complete` until nothing is missing.

    SIGTERM and SIGINT end it after the job in hand, but not later than after GRACE_S, and a second one at once. Further
    `settings` are those of WorkerSettings. Raises QueueError if there is no Redis at the start (later outages are
    waited out), StoreError, BackendError, and IncompleteError if jobs have failed and nothing else is left to do.
    """
    Store(store, create=True)
    queue.connect(redis_url).close()
    told = WorkerSettings(store=str(store), redis_url=redis_url, name=name or _default_name(), **settings)
    _Supervisor(told, tuple(child), say or log.warning).run()


def _default_name() -> str:
    return f"{socket.gethostname()}-{os.getpid()}"


def check(redis_url: str) -> None:
    """Return if a worker of this machine is alive; raises IncompleteError if none is, QueueError without a Redis."""
    if socket.gethostname() not in queue.hosts(queue.connect(redis_url)):
        raise IncompleteError(f"no worker of {socket.gethostname()} is alive")


class _Supervisor:
    """Starts the child again until it has nothing left to do."""

    def __init__(self, settings: WorkerSettings, command: tuple[str, ...], say: Callable[[str], None]) -> None:
        self._settings = settings
        self._command = command
        self._say = say
        self._stop = threading.Event()
        self._child: subprocess.Popen[bytes] | None = None

    def run(self) -> None:
        """Supervise; raises what the child cannot go on with."""
        with self._signals():
            failures = 0
            while not self._stop.is_set():
                started = time.monotonic()
                code, message = self._run_child()
                if code < 0 and self._stop.is_set():
                    _free_job(self._settings)
                if code == 0 or self._stop.is_set():
                    return
                _raise_final(code, message)
                if code == RECYCLED:
                    failures = 0
                    continue
                failures = 0 if time.monotonic() - started > STEADY_S else failures
                pause = BACKOFF_S[min(failures, len(BACKOFF_S) - 1)]
                failures += 1
                self._say(f"worker {self._settings.name}: {_ending(code, message)}; starting again in {pause:g} s")
                self._stop.wait(pause)

    def _run_child(self) -> tuple[int, str]:
        """Exit code of one child, and its last words."""
        with subprocess.Popen(
            self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
        ) as self._child:
            if self._child.stdin is None or self._child.stdout is None:
                raise BackendError("the worker's child was started without pipes")
            if self._stop.is_set():  # asked to while it was being started
                self._child.terminate()
            with contextlib.suppress(BrokenPipeError):
                self._child.stdin.write(self._settings.model_dump_json().encode() + b"\n")
                self._child.stdin.flush()  # and left open: its end tells the child that we are gone
            words = self._child.stdout.read().decode(errors="replace").strip()
            return self._child.wait(), words.splitlines()[-1] if words else ""

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
        if self._child is not None:
            self._child.send_signal(signal.SIGKILL if again else signal.SIGTERM)
        if not again:
            threading.Thread(target=self._see_off, daemon=True).start()

    def _see_off(self) -> None:
        """End the child after the grace: its own handler waits for native code to return, which may take minutes."""
        self._say(
            f"worker {self._settings.name}: stopping; a job in hand that takes longer than {GRACE_S:g} s "
            "will be rendered again"
        )
        time.sleep(GRACE_S)
        if self._child is not None:
            self._child.kill()


def _free_job(settings: WorkerSettings) -> None:
    """Let others have the job that a child was killed with at once, and do not count this start of it."""
    with contextlib.suppress(QueueError, redis.RedisError), queue.connect(settings.redis_url) as connection:
        told = connection.get(queue.WORKER + settings.name)
        queue.bury(connection, settings.name)
        if told is not None:
            connection.delete(STARTS + as_text(told).split()[-1])


def _raise_final(code: int, message: str) -> None:
    """Raise what starting again does not help against."""
    for kind in (StoreError, BackendError, IncompleteError):
        if code == kind.exit_code:
            raise kind(message)


def _ending(code: int, message: str) -> str:
    if code < 0:
        return f"its child was ended by {signal.Signals(-code).name}"
    return message or f"its child ended with exit code {code}"


# -------------------------------------------------------------------------------------------------------------- child


def child(load: jobs.SceneLoader = jobs.load_scene) -> int:
    """The child's main function: settings from stdin, work, and the exit code; its last words go to stdout."""
    words = os.dup(1)
    os.dup2(2, 1)  # whatever else is printed, by Mitsuba say, is talk
    logging.basicConfig(level=logging.WARNING, stream=sys.stderr, format="%(asctime)s %(name)s: %(message)s")
    settings = WorkerSettings.model_validate_json(sys.stdin.buffer.readline())
    threading.Thread(target=_end_with_supervisor, daemon=True).start()
    try:
        store = Store(settings.store)
        jobs.serve(jobs.ShardRenderer(store, worker=settings.name, load=load))
        return RenderWorker(settings, store, queue.connect(settings.redis_url)).run()
    except PhotonfarmError as error:
        _leave_word(words, str(error))
        return error.exit_code
    except redis.RedisError as error:
        _leave_word(words, f"lost Redis: {error}")
        return QueueError.exit_code


def _leave_word(words: int, message: str) -> None:
    """Tell the supervisor, if it is still there."""
    with contextlib.suppress(BrokenPipeError):
        os.write(words, f"{message}\n".encode())


def _end_with_supervisor() -> None:
    """Stop once the supervisor is gone: after the job in hand, or in the middle of it after GRACE_S."""
    while os.read(0, 1):  # not through sys.stdin, whose lock would be held at the interpreter's end
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(GRACE_S)
    os.kill(os.getpid(), signal.SIGKILL)


class RenderWorker(SimpleWorker):
    """RQ's in-process worker, with our jobs only, a heartbeat, a deadline, and a loop that fills the queue."""

    def __init__(self, settings: WorkerSettings, store: Store, connection: Redis) -> None:
        """Register nothing yet."""
        super().__init__(
            [queue.open_queue(connection)],
            name=f"{settings.name}-{os.getpid()}-{time.time_ns():x}",
            connection=connection,
            job_class=RenderJob,
            serializer=JSONSerializer,
            exception_handlers=[self._on_failure],
            log_job_description=False,
            worker_ttl=RQ_WORKER_TTL_S,
        )
        self._settings = settings
        self._store = store
        self._fatal: PhotonfarmError | None = None
        self._tainted = False  # something unforeseen happened, perhaps in the middle of an edit
        self._heart = _Heart(settings)

    def run(self) -> int:
        """Work until stopped, complete or due for a successor; the exit code, 0 only if all is complete."""
        self._heart.start()
        self.bootstrap(logging_level="WARNING")
        self._install_signal_handlers()
        done = 0
        try:
            while not self._stop_requested:
                taken = self._take()
                if taken is None:
                    if self._fill_or_finish():
                        return 0
                    continue
                self.execute_job(*taken)
                done += 1
                if self._fatal:
                    raise self._fatal
                worn = done >= self._settings.max_jobs or _resident_bytes() > self._settings.max_rss_bytes
                if worn or self._tainted:
                    return RECYCLED
        except StopRequested:
            pass
        finally:
            with contextlib.suppress(redis.RedisError):
                self._heart.end()
                self.teardown()
        return RECYCLED  # for a supervisor that has not been told to stop itself

    def _take(self) -> tuple[RenderJob, Any] | None:
        self.heartbeat()
        try:
            return self.queue_class.dequeue_any(
                self.queues, self._settings.idle_s, self.connection, job_class=RenderJob, serializer=self.serializer
            )
        except DequeueTimeout:
            return None

    def _fill_or_finish(self) -> bool:
        """Look at the store, as there is no coordinator; True if there is nothing left to wait for."""
        if queue.reconcile(self._store, self.connection, scene_id=self._settings.scene_id, wait_s=0):
            return False
        self._store.sweep()
        if not self._settings.until_complete:
            return False
        missing = {
            queue.job_name(scene.scene_id, job)
            for scene in self._store.scenes(self._settings.scene_id)
            for job in scene.missing_jobs()
        }
        failed = queue.queue_status(self.connection).failed
        if missing and missing <= failed.keys():
            first = sorted(missing)[0]
            raise IncompleteError(f"{len(missing)} jobs have failed; {first}: {failed[first]}")
        return not missing

    # ------------------------------------------------------------------------------------------------------------- jobs

    def execute_job(self, job: RenderJob, queue: Any) -> None:
        """Run one job under a heartbeat and a deadline."""
        with self._heart.working(job.id):
            starts = int(self.connection.incr(STARTS + job.id))
            self.connection.expire(STARTS + job.id, STARTS_TTL_S)
            if starts > STARTS_ALLOWED:
                job.refuse(f"it was started {starts - 1} times, and each time its worker died or lost Redis")
            super().execute_job(job, queue)
            self.connection.delete(STARTS + job.id)

    def _on_failure(self, job: RenderJob, kind: type[BaseException], error: BaseException, trace: Any) -> bool:  # noqa: ARG002
        """Decide what a failed job means: for the job, for this worker, or nothing."""
        log.warning("job %s failed: %s", job.id, error)
        ours = self._settings.scene_id in (None, job.id.rpartition("-")[0])
        if ours and isinstance(error, StoreError | BackendError) and not isinstance(error, CorruptError):
            self._fatal = error  # the next job would fail as well
        elif isinstance(error, Exception) and not isinstance(error, _QUEUE_TROUBLE):
            self._tainted = not isinstance(error, PhotonfarmError)
            with contextlib.suppress(redis.RedisError):
                queue.record_failure(self.connection, job.id, f"{type(error).__name__}: {error}")
        return False

    def get_heartbeat_ttl(self, job: RenderJob) -> int:  # noqa: ARG002
        """How long RQ's own records of a running job last, in seconds."""
        return int(self._settings.deadline_s) + 60

    def run_maintenance_tasks(self) -> None:
        """Nothing: `reconcile` does what is needed, without loading strangers' jobs."""


class _Heart:
    """Tells Redis that the worker and its job are alive, from a thread with a connection of its own."""

    def __init__(self, settings: WorkerSettings) -> None:
        self._settings = settings
        self._connection = queue.connect(settings.redis_url)
        self._job: str | None = None
        self._ended = threading.Event()

    def start(self) -> None:
        """Take over from a child that died, and beat for as long as the process lives."""
        queue.bury(self._connection, self._settings.name)
        self._beat()
        threading.Thread(target=self._keep_beating, daemon=True).start()

    def end(self) -> None:
        """Say that the worker is gone."""
        self._ended.set()
        queue.bury(self._connection, self._settings.name)

    @contextlib.contextmanager
    def working(self, name: str) -> Iterator[None]:
        """Beat for a job too while the block runs; past the deadline the process ends, and says where it hung."""
        self._job = name
        self._beat()
        # its watchdog is a thread without Python's lock, so that native code that never returns is ended as well
        faulthandler.dump_traceback_later(self._settings.deadline_s, exit=True)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()
            self._job = None
            with contextlib.suppress(redis.RedisError):
                self._connection.delete(queue.ALIVE + name)

    def _keep_beating(self) -> None:
        while not self._ended.wait(self._settings.heartbeat_ttl_s / 5):
            with contextlib.suppress(redis.RedisError):  # an outage is noticed where the job ends
                self._beat()

    def _beat(self) -> None:
        queue.beat(
            self._connection,
            self._settings.name,
            socket.gethostname(),
            self._job,
            ttl_s=self._settings.heartbeat_ttl_s,
        )


def _resident_bytes() -> int:
    """Memory of this process now; its peak where the system does not tell."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # bytes on macOS


if __name__ == "__main__":
    sys.exit(child())
