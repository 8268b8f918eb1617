"""The worker: a supervisor and the child that it keeps alive.

The child (`child`) renders in its own process, so that scenes and kernels stay loaded. It is
always a fresh interpreter, as Dr.Jit's threads do not survive a fork. It gets its settings through stdin, as the Redis
URL may hold a password. It ends when that pipe is closed, so that it cannot outlive its supervisor.
"""

from __future__ import annotations

import logging
import os
import socket
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from photonfarm import queue
from photonfarm.core.errors import IncompleteError, StoreError
from photonfarm.core.processes import process_space
from photonfarm.queue import Share
from photonfarm.renderer.jobs import render as jobs
from photonfarm.renderer.scene import backend
from photonfarm.renderer.worker.settings import LOG_FORMAT, WorkerSettings
from photonfarm.renderer.worker.supervisor import Supervisor
from photonfarm.store import Store
from photonfarm.store.read.find import scene_named

CHILD = (sys.executable, "-m", "photonfarm.renderer.worker.child")

log = logging.getLogger(__name__)


def run_worker(
    store: str | Path,
    redis_url: str | None = None,
    *,
    share: Share | str | None = None,
    name: str | None = None,
    child: Sequence[str] = CHILD,
    report: Callable[[str], None] | None = None,
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
    worker = WorkerSettings(store=str(store), **settings)
    Supervisor(worker, tuple(child), report or log.warning).run()


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
        raise StoreError(f"{store}: scene {scene_id} has {planned} jobs, numbered from 0; there is no job {job}")
    began = time.monotonic()
    rendered = jobs.ShardRenderer(opened, worker=_default_name(), load=load).render(scene_id, job)
    return rendered, time.monotonic() - began


def _default_name() -> str:
    return f"{socket.gethostname()}-{os.getpid()}"


def check(redis_url: str) -> None:
    """Return if a worker of this host, or container, is alive; raises IncompleteError if none is.

    Raises QueueError without a Redis.
    """
    hosts = {report.host for report in queue.read_workers(queue.connect(redis_url)).values()}
    if process_space() not in hosts:
        raise IncompleteError(f"no worker of {socket.gethostname()} is alive")
