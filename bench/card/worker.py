"""One worker at work on a scene: samples per second, and the share of the time for which its device is busy."""

from __future__ import annotations

import ctypes
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bench.card.rooms import on_card
from bench.farm.pairs import ends_of_jobs
from bench.harness import results
from bench.harness.scenes import ready_spec, square
from photonfarm.core.processes import tie
from photonfarm.plan.request import Request
from photonfarm.store import SceneStore, Store

TITLE = "One worker"
VIEWS, ROWS, JOBS = 4, 16, 1000
LEAST_JOBS, LEAST_S, MOST_S = 3, 10.0, 60.0
"""It is watched for so many jobs and seconds beyond its first job, or for the most seconds in all."""


def measure(name: str, size: int, out: Path, _limit_s: float) -> dict[str, Any]:
    """What it does between the end of its first job and that of its last."""
    with tempfile.TemporaryDirectory(dir=out) as folder:
        scene = Store(Path(folder), create=True).add(square(ready_spec(name), size))
        scene.plan(Request(modifications=JOBS * ROWS // VIEWS, views_per_modification=VIEWS), shard_rows=ROWS)
        began = time.time()
        command = [sys.executable, "-m", "photonfarm.cli", "work", "--share", "0/1", "--scene", scene.scene_id]
        told = {**os.environ, "PHOTONFARM_STORE": folder}
        with subprocess.Popen(tie(command), env=told, stdin=subprocess.DEVNULL) as process:
            try:
                loads = watch(scene, process)
                failed = process.poll()
            finally:
                process.terminate()
        if failed:
            raise RuntimeError(f"the worker ended with exit code {failed}")
        ends = [end for worker in ends_of_jobs(scene) for end in worker]
    if len(ends) < 2:
        raise RuntimeError(f"it ended {len(ends)} jobs within {MOST_S:.0f} s; two are needed")
    wall_s, done = ends[-1].at - ends[0].at, ends[1:]
    core_s = sum(end.cpu_s for end in done)
    busy = [load for at, load in loads if ends[0].at <= at <= ends[-1].at]
    return {
        "size": size,
        "spp": scene.spec.transport.half_spp,
        "jobs": len(done),
        "until_first_s": ends[0].at - began,
        "samples_per_s": ROWS * len(done) / wall_s,
        "core_s": core_s / (ROWS * len(done)),
        "busy": statistics.fmean(busy) if busy else core_s / wall_s,
    }


def watch(scene: SceneStore, process: subprocess.Popen[bytes]) -> list[tuple[float, float]]:
    """The card's load, 0 to 1, at times, until enough jobs are done; none where a processor renders."""
    loads, until, first = [], time.time() + MOST_S, 0.0
    read = open_load() if on_card() else None
    while time.time() < until and process.poll() is None:
        jobs = len(scene.committed_jobs())
        first = first or (time.time() if jobs else 0.0)
        if jobs > LEAST_JOBS and time.time() > first + LEAST_S:
            break
        time.sleep(0.1)
        if read is not None:
            loads.append((time.time(), read()))
    return loads


def open_load() -> Any:
    """A function for the share of the last moments in which the card worked, by the driver's own library."""
    from photonfarm.renderer.scene import backend

    library, handle, both = ctypes.CDLL("libnvidia-ml.so.1"), ctypes.c_void_p(), (ctypes.c_uint * 2)()
    card = backend.device().card
    assert card is not None  # `on_card`
    if library.nvmlInit_v2() or library.nvmlDeviceGetHandleByIndex_v2(card.number, ctypes.byref(handle)):
        return None

    def read() -> float:
        library.nvmlDeviceGetUtilizationRates(handle, both)
        return both[0] / 100

    return read


def describe(found: Mapping[str, Mapping[str, Any]]) -> str:
    """The table."""
    header = ("", "samples a second", "busy", "core-seconds a sample", "until the first job, s", "jobs watched")
    rows = []
    for name, of in found.items():
        rate, busy, core_s = f"{of['samples_per_s']:.2f}", f"{of['busy']:.0%}", f"{of['core_s']:.2f}"
        label = f"{name} {of['size']}², 2 × {of['spp']} spp"
        rows.append([label, rate, busy, core_s, f"{of['until_first_s']:.0f}", of["jobs"]])
    return f"""`work --share 0/1`, jobs of {ROWS} samples, {VIEWS} views of a configuration, after its first job. Busy
is the card, as the driver says, or else the processor.

{results.table(header, rows)}"""
