"""Many workers at one Redis and one store, which commit real jobs of a scene that is rendered by formulas.

A process plays many workers, a thread each: the product's `RenderWorker` with its heartbeat, queue, commits and
markers. Each half of a sample takes as long as it is told to, asleep. What differs from a worker of its own process:
signals are left alone, and there is no supervisor.
"""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from bench.farm.plans import Markers
from bench.farm.scale_operations import counted
from bench.harness import results
from photonfarm.queue.job import QUEUE_KEY, STARTED_KEY

PROCESSES = 4
SHARD_ROWS = 2
JOB_S = 16.0
JOBS_EACH = 2
IDLE_S = 16.0
"""How long workers without work are watched, in seconds."""

COMMITTED = 4000
"""Jobs that are committed beforehand, by markers alone."""

Costs = dict[str, float]


def main() -> int:
    """Play some workers until stdin ends; each line is answered with what they have done so far, as JSON."""
    play(**json.loads(sys.argv[1]))
    return 0


# ------------------------------------------------------------------------------------------------- one of the processes


def play(store: str, redis: str, first: int, count: int) -> None:
    """Play the workers `first` … `first` + `count` − 1."""
    from photonfarm.store.io.local import LocalStorage

    _analytic().AnalyticScene.pause_s = JOB_S / SHARD_ROWS / 2
    looks: Counter[str] = Counter()
    ready = threading.Semaphore(0)
    with counted(LocalStorage) as operations:
        for number in range(first, first + count):
            threading.Thread(target=_work, args=(store, redis, number, looks, ready), daemon=True).start()
        for _ in range(count):
            ready.acquire()
        print("ready", flush=True)
        for _ in sys.stdin:
            print(json.dumps({**operations, **looks, "core_s": time.process_time()}), flush=True)


def _analytic() -> Any:
    for folder in ("tests/faults", "tests/shared"):
        sys.path.insert(0, str(results.ROOT / folder))
    return importlib.import_module("analytic_scene")


def _work(root: str, redis: str, number: int, looks: Counter[str], ready: threading.Semaphore) -> None:
    """Be one worker, for as long as the process lives."""
    from photonfarm.renderer.worker.child import RenderWorker
    from photonfarm.renderer.worker.settings import WorkerSettings
    from photonfarm.store import Store

    class Played(RenderWorker):
        def _is_complete(self, paused: str | None) -> bool:
            looks["looks"] += 1
            return super()._is_complete(paused)

    settings = WorkerSettings(
        store=root, redis_url=redis, name=f"played-{number}", until_complete=True, quiet=True, reserve_bytes=0
    )
    worker = Played(settings, Store(root), _analytic().AnalyticScene.load)
    ready.release()
    worker.run()


# ---------------------------------------------------------------------------------------------------------- all of them


def measured(folder: Path, workers: int) -> Costs:
    """What so many workers ask of Redis and of the store: while they work, and while they wait for one last job."""
    from photonfarm import queue
    from photonfarm.farm.redis_server import EmbeddedRedis
    from photonfarm.plan.request import Request
    from photonfarm.store import Store

    store = Store(folder / "store", create=True)
    jobs = COMMITTED + workers * JOBS_EACH + 1
    spec = _analytic().small_spec()
    store.plan(spec, Request(modifications=jobs * SHARD_ROWS), shard_rows=SHARD_ROWS)
    markers = Markers(folder / "store")
    for job in range(COMMITTED):
        markers.place(job)
    scene = store.scene(spec.scene_id)
    scene.write_base(*_analytic().AnalyticScene(spec).base())
    held = queue.job_name(spec.scene_id, jobs - 1)
    with EmbeddedRedis(folder / "redis") as server:
        connection = queue.connect(server.url)
        empty = connection.info("memory")["used_memory"]
        queue.reconcile(store, connection)
        connection.lrem(QUEUE_KEY, 1, held)
        connection.zadd(STARTED_KEY, {f"{held}:held": 0})  # a job that somebody else renders all the while
        connection.set(f"rq:execution:{held}:held", 1, ex=3000)
        with _played(str(folder / "store"), server.url, workers) as done:
            _wait(lambda: connection.llen(QUEUE_KEY) <= workers * (JOBS_EACH - 1))
            busy = [_seen(connection, done(), scene)]
            _wait(lambda: _markers(scene) == jobs - 1)  # without a question to Redis, which would count
            busy.append(_seen(connection, done(), scene))
            time.sleep(IDLE_S / 2)  # every worker has seen the empty queue
            idle = [_seen(connection, done(), scene)]
            time.sleep(IDLE_S)
            idle.append(_seen(connection, done(), scene))
    found = {f"busy_{name}": value for name, value in _rates(*busy).items()}
    found |= {f"idle_{name}": value for name, value in _rates(*idle).items()}
    found["idle_listings"] = found["idle_names_listed"] / (jobs - 1)
    return {**found, "memory_bytes": busy[0]["memory"] - empty, "workers": float(workers)}


def _markers(scene: Any) -> int:
    """The number of committed jobs."""
    return sum(1 for _ in scene.storage.local(f"{scene.name}/committed").iterdir())


def _rates(begin: Costs, end: Costs) -> Costs:
    """What happened between two looks, by the second."""
    took_s = end["at"] - begin["at"]
    rates = {
        name: (end[name] - begin.get(name, 0.0)) / took_s for name in end if name not in ("at", "memory", "clients")
    }
    return {**rates, "seconds": took_s, "clients": end["clients"]}


def _seen(connection: Any, played: Costs, scene: Any) -> Costs:
    info = connection.info("everything")
    calls = sum(about["calls"] for name, about in info.items() if name.startswith("cmdstat_"))
    return {
        **played, "at": time.monotonic(), "commands": calls, "clients": info["connected_clients"],
        "redis_core_s": info["used_cpu_user"] + info["used_cpu_sys"], "memory": info["used_memory"],
        "jobs": _markers(scene),
    }  # fmt: skip


@contextmanager
def _played(store: str, redis: str, workers: int) -> Iterator[Callable[[], Costs]]:
    """Processes that play the workers; yields a function that gives what they have done so far."""
    count = min(PROCESSES, workers)
    shares = [workers // count + (i < workers % count) for i in range(count)]
    with ExitStack() as stack:
        processes = []
        for i, share in enumerate(shares):
            given = json.dumps({"store": store, "redis": redis, "first": sum(shares[:i]), "count": share})
            command = [sys.executable, "-m", "bench.farm.scale_workers", given]
            process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            stack.enter_context(process)
            stack.callback(process.kill)
            processes.append(process)
        for process in processes:
            _line(process)

        def done() -> Costs:
            for process in processes:
                assert process.stdin is not None
                process.stdin.write("\n")
                process.stdin.flush()
            total: Counter[str] = Counter()
            for process in processes:
                total.update(json.loads(_line(process)))
            return dict(total)

        yield done


def _line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        raise RuntimeError("a process that plays workers has ended")
    return line


def _wait(condition: Callable[[], bool], timeout_s: float = 200.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            raise RuntimeError("the workers are not done")
        time.sleep(0.25)


if __name__ == "__main__":
    sys.exit(main())
