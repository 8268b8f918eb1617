"""The worker: what starts it, and the child that its supervisor keeps alive.

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
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import redis
from redis import Redis
from rq import SimpleWorker
from rq.exceptions import DequeueTimeout, InvalidJobOperation, NoSuchJobError
from rq.serializers import JSONSerializer
from rq.worker.base import StopRequested, WorkerStatus

from photonfarm.renderer import jobs
from photonfarm.renderer.supervisor import Supervisor
from photonfarm.renderer.worker_settings import GRACE_S, RECYCLED, WorkerSettings
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
from photonfarm.shared.store import Store

CHILD = (sys.executable, "-m", "photonfarm.renderer.worker")

STARTS_ALLOWED = 5
"""Starts of one job without an end, after which it counts as failed: it kills its workers."""

STARTS_TTL_S = 6 * 3600

_QUEUE_TROUBLE = (QueueError, redis.RedisError, InvalidJobOperation, NoSuchJobError)
"""Faults of the queue, not of the job: a Redis that lost its memory no longer knows the job in hand."""

RQ_WORKER_TTL_S = 120
"""After this, and a minute, RQ forgets a worker that was killed while idle; our own heartbeat is what counts."""

log = logging.getLogger(__name__)

# ------------------------------------------------------------------------------------------------------------ starting


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
    Supervisor(told, tuple(child), say or log.warning).run()


def _default_name() -> str:
    return f"{socket.gethostname()}-{os.getpid()}"


def check(redis_url: str) -> None:
    """Return if a worker of this machine is alive; raises IncompleteError if none is, QueueError without a Redis."""
    if socket.gethostname() not in queue.hosts(queue.connect(redis_url)):
        raise IncompleteError(f"no worker of {socket.gethostname()} is alive")


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
        self.set_state(WorkerStatus.BUSY)  # told to stop from here on, RQ ends the job first
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
