"""What a store of so many samples costs those who open it: one process for each step, nothing rendered.

The plan, the queue and the readers are those of the product. Markers are written by `plans.Markers`, in their format
and without the syncs of a commit, and the shards that they name are not there. The last jobs are missing, and some
others.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from bench.farm.plans import Markers
from bench.farm.scale_operations import counted, forget_peak, peak_bytes, processor_s, resident_bytes
from photonfarm.store.io.local import LocalStorage

SPEC = "room"
SHARD_ROWS = 32
LAST = 0.05
"""The share of the jobs that are missing at the end: jobs are committed about in the order of their numbers."""

FAILED = 3
"""The jobs that are missing among the others, at even distances, as if they had failed."""

FURTHER = 1000
"""The samples of the submission that follows."""

Costs = dict[str, float]


def main() -> int:
    """Run one step, given as JSON; its costs go to stdout as JSON."""
    given = json.loads(sys.argv[1])
    print(json.dumps(STEPS[given["step"]](Path(given["folder"]), given["samples"], given["redis"])))
    return 0


def timed(action: Callable[[], Any]) -> Costs:
    """The processor time of an action, its operations on the store, and the memory that it takes.

    `held_bytes` is what stays, with the action's result; `peak_bytes` the most above what was there before.
    """
    with counted(LocalStorage) as operations:
        forget_peak()
        memory, began = resident_bytes(), processor_s()
        kept = action()
        core_s = processor_s() - began
        held, most = resident_bytes() - memory, peak_bytes() - memory
        del kept
    costs = {"core_s": core_s, "held_bytes": float(max(held, 0)), "peak_bytes": float(max(most, 0))}
    return {**costs, **{name: float(count) for name, count in operations.items()}}


def missing_of(jobs: int) -> list[int]:
    """The jobs that are left without a marker, in order."""
    last = jobs - max(int(jobs * LAST), 1)
    return [*range(last // (2 * FAILED), last, max(last // FAILED, 1)), *range(last, jobs)]


def _store(folder: Path) -> Any:
    from photonfarm.store import Store

    return Store(folder / "store")


# ---------------------------------------------------------------------------------------------------------------- steps


def plan(folder: Path, samples: int, redis: str) -> Costs:  # noqa: ARG001
    """An empty store's first submission, without the queue."""
    from photonfarm.plan.request import Request
    from photonfarm.scene.spec_loading import NamedSpec
    from photonfarm.store import Store

    spec, request = NamedSpec.load(SPEC).spec, Request(modifications=samples)
    store = Store(folder / "store", create=True)
    costs = timed(lambda: store.plan(spec, request, shard_rows=SHARD_ROWS))
    files = [path for path in (folder / "store").rglob("*") if path.is_file()]
    return {**costs, "files": len(files), "stored_bytes": sum(path.stat().st_size for path in files)}


def mark(folder: Path, samples: int, redis: str) -> Costs:  # noqa: ARG001
    """Markers of all jobs but some."""
    markers = Markers(folder / "store")
    for job in sorted({*range(markers.jobs)} - {*missing_of(markers.jobs)}):
        markers.place(job)
    (committed,) = folder.glob("store/scenes/*/committed")
    return {"markers": len(list(committed.iterdir())), "jobs": markers.jobs}


def plan_more(folder: Path, samples: int, redis: str) -> Costs:  # noqa: ARG001
    """A later submission of a few samples, with another seed."""
    from photonfarm.plan.request import Request

    store = _store(folder)
    spec = store.scenes()[0].spec
    return timed(lambda: store.plan(spec, Request(modifications=FURTHER, seed=1), dry_run=True))


def worker(folder: Path, samples: int, redis: str) -> Costs:  # noqa: ARG001
    """What a worker asks of the store before its first job: is it planned, missing, and of which inputs."""

    def begin() -> Any:
        store = _store(folder)
        scene = store.scenes()[0]
        job = scene.jobs() - 1
        return store, scene.is_committed(job), scene.job_rows(job)

    return timed(begin)


def reconcile(folder: Path, samples: int, redis: str) -> Costs:  # noqa: ARG001
    """An empty queue, filled with what is missing."""
    from photonfarm import queue

    connection = queue.connect(redis)
    connection.flushall()
    before = _commands(connection)
    costs = timed(lambda: queue.reconcile(_store(folder), connection))
    queued = queue.queue_status(connection).queued
    memory = connection.info("memory")["used_memory"]
    again = _commands(connection)
    more = timed(lambda: queue.reconcile(_store(folder), connection))
    return {
        **costs, "queued": queued, "commands": again - before, "redis_bytes": memory,
        "again_core_s": more["core_s"], "again_commands": _commands(connection) - again,
    }  # fmt: skip


def _commands(connection: Any) -> int:
    return sum(about["calls"] for about in connection.info("commandstats").values())


def status(folder: Path, samples: int, redis: str) -> Costs:  # noqa: ARG001
    """`photonfarm status`, which sums up every marker."""
    from photonfarm.store import store_status

    return timed(lambda: store_status(_store(folder)))


def reader(folder: Path, samples: int, redis: str) -> Costs:  # noqa: ARG001
    """A trainer's reader: its start, a look without news, and one after a new marker."""
    from photonfarm.store import SceneReader

    markers = Markers(folder / "store")
    scene_id, last = markers.scene.scene_id, markers.jobs - 1
    followed = SceneReader(folder / "store", scene_id)
    path = markers.scene.storage.local(f"{markers.scene.name}/committed/{last:012d}.json")
    del markers.plan, markers.scene
    start = timed(followed.refresh)
    idle = timed(followed.refresh)
    Markers(folder / "store").place(last)
    news = timed(followed.refresh)
    path.unlink()
    found = {f"start_{name}": value for name, value in start.items()}
    found |= {f"idle_{name}": value for name, value in idle.items()}
    return {**found, **{f"news_{name}": value for name, value in news.items()}}


def ahead(folder: Path, samples: int, redis: str) -> Costs:  # noqa: ARG001
    """What --ahead costs a worker: a count of what is committed, and another one later."""
    from photonfarm import queue
    from photonfarm.renderer.worker.backpressure import TrainerPace

    connection, store = queue.connect(redis), _store(folder)
    first = timed(TrainerPace(store, connection, 1.5).ahead)
    return {**first, "again_core_s": timed(TrainerPace(store, connection, 1.5).ahead)["core_s"]}


def find(folder: Path, samples: int, redis: str) -> Costs:  # noqa: ARG001
    """`store find` of one sample by its key."""
    from photonfarm.store.read.find import Query, find_samples

    store = _store(folder)
    scene = store.scenes()[0]
    key = scene.job_rows(0).samples[0].key
    fresh = _store(folder)
    return timed(lambda: find_samples(fresh, [scene.scene_id], Query(sample=key)))


STEPS: dict[str, Callable[[Path, int, str], Costs]] = {
    "plan": plan, "mark": mark, "plan_more": plan_more, "worker": worker, "reconcile": reconcile, "status": status,
    "reader": reader, "find": find, "ahead": ahead,
}  # fmt: skip


# ------------------------------------------------------------------------------------------------------ their processes


def in_processes(folder: Path, samples: int, redis: str) -> Iterator[tuple[str, Costs]]:
    """Every step in a process of its own."""
    for step in STEPS:
        given = json.dumps({"step": step, "folder": str(folder), "samples": samples, "redis": redis})
        told = subprocess.run(
            [sys.executable, "-m", "bench.farm.scale_store", given], check=True, stdout=subprocess.PIPE, text=True
        ).stdout
        yield step, json.loads(told.splitlines()[-1])


if __name__ == "__main__":
    sys.exit(main())
