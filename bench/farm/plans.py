"""A plan of a million samples: what submit, status, reconcile and the reader cost. Nothing is rendered.

    python -m bench.farm.plans [--spec room] [--samples 1000000] [--views 1] [--folder DIR] [--out DIR]

Plans, markers and queue are those of the product, but the markers come from a generator, without the syncs
that a commit waits for, and the shards that they name are not there. Every step is a process of its own. Exit code 0.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bench.harness import results

TARGETS = {  # seconds
    "submit": 60,
    "status": 5,
    "reconcile": 5,
    "start of a reader": 5,
    "refresh after one marker": 0.2,
    "refresh without news": 0.2,
}
ABOUT = {
    "submit": "`photonfarm submit`: expand, store the plan, queue 10 000 jobs",
    "reconcile": "an empty queue filled from the store with 10 000 jobs, no marker there",
    "reconcile, queue full": "nothing left to queue, no marker there",
    "status": "`store_status`, every marker there but one",
    "start of a reader": "`SceneReader` and its first `refresh`, every marker there but one",
    "refresh without news": "the second `refresh`",
    "refresh after one marker": "the third `refresh`, after the last marker",
    "top-up of every view": "one more pass for each, up to the rows (`--dry-run`)",
    "submit again": "the same request, all of it known (`--dry-run`)",
}


@dataclass(frozen=True, slots=True)
class StepCost:
    """One step."""

    step: str
    wall_s: float
    processor_s: float
    peak_memory_bytes: int  # of its process by then, with Python and its packages


# ---------------------------------------------------------------------------------------------------------------- steps


def run_steps(job: str, options: argparse.Namespace) -> None:
    """One process: its steps, each printed as a row."""
    steps = {"submit": submit, "reconcile": reconcile, "fill": fill, "status": status, "reader": read, "again": again}
    for name, step in steps[job](options):
        wall_s, processor_s = time.perf_counter(), time.process_time()
        step()
        wall_s, processor_s = time.perf_counter() - wall_s, time.process_time() - processor_s
        peak_bytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        print(json.dumps(asdict(StepCost(name, wall_s, processor_s, peak_bytes))), flush=True)


NamedSteps = Iterable[tuple[str, Callable[[], Any]]]


def submit(options: argparse.Namespace) -> NamedSteps:
    from photonfarm.farm import submission
    from photonfarm.plan.request import Request
    from photonfarm.scene.spec_loading import NamedSpec

    request = Request(modifications=options.samples // options.views, views_per_modification=options.views)
    store = options.folder / "store"
    yield "submit", lambda: submission.submit(NamedSpec.load(options.spec), store, options.redis, request)


def reconcile(options: argparse.Namespace) -> NamedSteps:
    from photonfarm import queue
    from photonfarm.store import Store

    connection = queue.connect(options.redis)
    connection.flushall()
    yield "reconcile", lambda: queue.reconcile(Store(options.folder / "store"), connection)
    yield "reconcile, queue full", lambda: queue.reconcile(Store(options.folder / "store"), connection)


def fill(options: argparse.Namespace) -> NamedSteps:
    generator = Markers(options.folder / "store")

    def place_all_but_one() -> None:
        for job in range(generator.jobs - 1):
            generator.place(job)

    yield "markers", place_all_but_one


def status(options: argparse.Namespace) -> NamedSteps:
    from photonfarm.store import Store, store_status

    yield "status", lambda: store_status(Store(options.folder / "store"))


def read(options: argparse.Namespace) -> NamedSteps:
    from photonfarm.store import SceneReader

    generator = Markers(options.folder / "store")
    reader = SceneReader(options.folder / "store", generator.scene.scene_id)
    yield "start of a reader", reader.refresh
    yield "refresh without news", reader.refresh
    generator.place(generator.jobs - 1)
    yield "refresh after one marker", reader.refresh
    if len(reader.rows) != reader.planned:
        raise RuntimeError(f"{len(reader.rows)} of {reader.planned} samples are complete, and all should be")


def again(options: argparse.Namespace) -> NamedSteps:
    from photonfarm.plan.top_up import TopUp
    from photonfarm.store import Store

    scene = Store(options.folder / "store").scenes()[0]
    (plan,) = scene.plans()
    yield "top-up of every view", lambda: scene.plan(TopUp.of("+1"), dry_run=True)
    yield "submit again", lambda: scene.plan(plan.request, dry_run=True)


class Markers:
    """Markers as commits would place them, of shards that are not there."""

    def __init__(self, root: Path) -> None:
        from photonfarm.store import Store
        from photonfarm.store.format import schema

        self.scene = Store(root).scenes()[0]
        (self.plan,) = self.scene.plans()
        self.jobs = self.plan.jobs
        self._arrays = {name: a for name, a in schema.output_arrays(self.scene.spec).items() if name != "radiance_wide"}

    def place(self, job: int) -> None:
        """Write one marker, not synced."""
        from photonfarm.store import Figures
        from photonfarm.store.format import markers

        files = {self.plan.shard(name, array, job): array for name, array in self._arrays.items()}
        described = {
            file.removeprefix(f"{self.scene.name}/"): {"size": 1_000_000, "crc32c": "00000000"} for file in files
        }
        versions = dict.fromkeys(("photonfarm", "mitsuba", "drjit", "numpy"), "1.0.0")
        figures = asdict(Figures(core_s=12.345678, wall_s=12.5, redrawn=0, worker="bench-1", versions=versions))
        path = self.scene.storage.local(markers.name_of(self.scene.name, job))
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps({"job": job, "files": described, "figures": figures}, indent=1))


# ---------------------------------------------------------------------------------------------------------------- table


def measure(options: argparse.Namespace, folder: Path) -> tuple[list[StepCost], dict[str, int]]:
    """Every step in its process, and what Redis holds."""
    from photonfarm import queue
    from photonfarm.farm.redis_server import EmbeddedRedis

    rows, sizes = [], {}
    with EmbeddedRedis(folder / "redis") as server:
        connection = queue.connect(server.url)
        sizes["redis_empty_bytes"] = connection.info("memory")["used_memory"]
        for job in ("submit", "reconcile", "fill", "status", "reader", "again"):
            rows += run(job, options, folder, server.url)
            if job == "submit":
                sizes["redis_bytes"] = connection.info("memory")["used_memory"]
                sizes["queued_jobs"] = queue.queue_status(connection).queued
                sizes["plan_bytes"] = sum(p.stat().st_size for p in (folder / "store").rglob("*") if p.is_file())
    return rows, sizes


def run(job: str, options: argparse.Namespace, folder: Path, redis_url: str) -> list[StepCost]:
    """One process's rows."""
    given = {"job": job, "folder": folder, "redis": redis_url}
    given |= {"spec": options.spec, "samples": options.samples, "views": options.views}
    told = [word for name, value in given.items() for word in (f"--{name}", str(value))]
    command = [sys.executable, "-m", "bench.farm.plans", *told]
    lines = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines()
    return [StepCost(**json.loads(line)) for line in lines]


def page(rows: list[StepCost], sizes: dict[str, int], options: argparse.Namespace) -> str:
    from photonfarm import queue

    lines = [
        [
            row.step,
            ABOUT[row.step],
            f"{row.wall_s:.2f}",
            f"{row.processor_s:.2f}",
            f"< {TARGETS[row.step]:g}" if row.step in TARGETS else "",
            f"{row.peak_memory_bytes / 1e6:.0f}",
        ]
        for row in rows
        if row.step in ABOUT
    ]
    header = ["step", "what", "time, s", "processor time, s", "wanted, s", "peak memory of its process, MB"]
    limit = ", which is the limit" if sizes["queued_jobs"] == queue.QUEUE_LIMIT else ""
    redis_mb = (sizes["redis_bytes"] - sizes["redis_empty_bytes"]) / 1e6
    return f"""# A plan of {options.samples:,} samples

Scene `{options.spec}`, {options.samples // options.views:,} configurations of {options.views} view each, jobs of 32
samples. Nothing is rendered: markers come from a generator. Every step is a process of its own (the reader's three are
one), on a warm cache.

{results.table(header, lines)}

With {sizes["queued_jobs"]:,} jobs queued{limit}, Redis holds {redis_mb:.1f} MB more than empty (wanted: < 50). The
stored plan takes {sizes["plan_bytes"] / 1e6:.0f} MB."""


def main() -> int:
    parser = results.parser(__doc__)
    parser.add_argument("--spec", default="room", help="a ready spec")
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--views", type=int, default=1, help="per configuration; 1 is the most expensive")
    parser.add_argument("--folder", type=Path, help="for the store, which is removed (a temporary one)")
    parser.add_argument("--job", help=argparse.SUPPRESS)
    parser.add_argument("--redis", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.job:
        run_steps(options.job, options)
        return 0
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        rows, sizes = measure(options, Path(folder))
    values = {"samples": options.samples, "rows": [asdict(row) for row in rows], **sizes}
    results.write("plans", page(rows, sizes, options), values, options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
