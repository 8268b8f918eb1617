"""A room rendered by Mitsuba's `path` in the place of `bdpt`: the scene, what both cost, and a store of each kind.

Both stores are of one spec, and so of one scene id: configurations, views, point clouds, photons and what is held out
are the same bit by bit. Only the half-estimates differ; those of `path` have another number of samples per pixel than
the spec says, which is chosen so that a sample takes as long.
"""

from __future__ import annotations

import ctypes
import json
import multiprocessing
import signal
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

import room_study
from photonfarm.renderer import backend
from photonfarm.renderer.jobs import ShardRenderer
from photonfarm.renderer.scenes import LoadedScene
from photonfarm.shared.modification import sample_modification
from photonfarm.shared.plan import Request
from photonfarm.shared.records import F32
from photonfarm.shared.scene import SceneSpec
from photonfarm.shared.store import Store
from photonfarm.shared.top_up import TopUp
from photonfarm.shared.view import View, sample_view

SHARD_ROWS = 16  # small jobs: those of both kinds take turns, so that both are timed on the same machine
TIMED_SEED = 1 << 40  # of configurations that are only timed; no plan has it by chance
BDPT, FEW, MANY = 0, 8, 32  # samples per pixel that `path` is timed at; 0 stands for `bdpt`, with the spec's
WARM_UP = 3  # views: kernels are compiled and launches recorded


class PathScene(LoadedScene):
    """A scene whose half-estimates are those of Mitsuba's `path`, with the spec's path lengths.

    Seeds, sensor and box filter are as with `bdpt`, one render for each half. `spp` are its samples per pixel; the
    spec's `half_spp` is not looked at.
    """

    def __init__(self, spec: SceneSpec, scene: Any) -> None:
        import mitsuba as mi

        super().__init__(spec, scene)
        lengths = {"max_depth": spec.transport.max_depth, "rr_depth": spec.transport.rr_depth}
        self._path = mi.load_dict({"type": "path", **lengths})
        self.spp = spec.transport.half_spp

    def render_halves(self, view: View, seeds: Sequence[int]) -> F32:
        """Half-estimates of linear radiance for each seed, (K, H, W, 3)."""
        return np.stack([self.render(view, seed, self._path, self.spp) for seed in seeds])


def load_path(spec: SceneSpec, spp: int) -> PathScene:
    """The scene of a spec, to be rendered by `path` with so many samples per pixel in a half-estimate."""
    backend.load(threads=1)
    scene = PathScene.load(spec)
    scene.spp = spp
    return scene


# -------------------------------------------------------------------------------------------------------------- costs


@dataclass(frozen=True, slots=True)
class Costs:
    """Core-seconds of the two half-estimates of a sample, means over the same views."""

    bdpt_s: float  # with the spec's half_spp
    path_fixed_s: float  # of a pair of calls of `path`, whatever the samples
    path_spp_s: float  # of one sample per pixel more in both halves

    @property
    def path_spp(self) -> int:
        """Samples per pixel of a half by `path` that cost what a half by `bdpt` does, 1 at least."""
        return max(1, round((self.bdpt_s - self.path_fixed_s) / self.path_spp_s))


def measured_costs(spec: SceneSpec, views: int) -> Costs:
    """Time both integrators by turns on one view each of so many configurations."""
    scene = load_path(spec, FEW)
    spent = {BDPT: 0.0, FEW: 0.0, MANY: 0.0}
    for number in range(WARM_UP + views):
        modification = sample_modification(spec, TIMED_SEED, number)
        view = sample_view(spec, modification.key(spec.scene_id), TIMED_SEED, 0)
        scene.apply(modification)
        for spp in spent:
            scene.spp = spp
            render = LoadedScene.render_halves if spp == BDPT else PathScene.render_halves
            start = time.process_time()
            render(scene, view, (2 * number, 2 * number + 1))
            if number >= WARM_UP:
                spent[spp] += (time.process_time() - start) / views
    slope = (spent[MANY] - spent[FEW]) / (MANY - FEW)
    return Costs(spent[BDPT], spent[FEW] - FEW * slope, slope)


def costs_of(spec: SceneSpec, folder: Path, views: int = 24) -> Costs:
    """What was measured when the folder was first worked in: later calls go on with the same samples per pixel."""
    file = folder / "costs.json"
    if not file.is_file():
        (costs,) = in_processes(measured_costs, [(spec, views)], 1, "timed both integrators")
        file.write_text(json.dumps(asdict(costs)) + "\n", encoding="utf-8")
    return Costs(**json.loads(file.read_text(encoding="utf-8")))


# ------------------------------------------------------------------------------------------------------------- stores


@dataclass(frozen=True, slots=True)
class Rendered:
    """The samples of one kind: where they lie and what they cost."""

    root: Path
    half_spp: int
    core_s: float  # of a sample with all that goes with it; median over the jobs of new configurations
    redrawn: int  # renders that were not finite


def render(
    spec: SceneSpec, where: tuple[Path, Store], asked: dict[str, list[Request | TopUp]], costs: Costs, processes: int
) -> dict[str, Rendered]:
    """Plan what is asked for of `bdpt` and of `path`, and render all that is missing; `where` is folder and store."""
    folder, store = where
    stores = {"bdpt": store, "path": Store(folder / f"path-{costs.path_spp}-spp", create=True)}
    half_spp = {"bdpt": spec.transport.half_spp, "path": costs.path_spp}
    jobs: list[tuple[float, tuple[str, str, int, int]]] = []
    for kind, opened in stores.items():
        scene = opened.add(spec)
        for request in asked[kind]:
            scene.plan(request, shard_rows=SHARD_ROWS)
        missing = scene.missing_jobs()
        told = str(opened.root), spec.scene_id, BDPT if kind == "bdpt" else costs.path_spp
        jobs += [(place / len(missing), (*told, job)) for place, job in enumerate(missing)]
    in_processes(render_job, [job for _, job in sorted(jobs)], processes, "rendered")
    return {kind: rendered(opened, spec, half_spp[kind]) for kind, opened in stores.items()}


def render_job(root: str, scene_id: str, path_spp: int, job: int) -> None:
    """One job, by `path` with so many samples per pixel in a half, or by `bdpt`."""
    _renderer(root, path_spp).render(scene_id, job)


@cache
def _renderer(root: str, path_spp: int) -> ShardRenderer:
    if path_spp == BDPT:
        return ShardRenderer(Store(root), worker="bench")
    return ShardRenderer(Store(root), worker=f"bench, path {path_spp} spp", load=partial(load_path, spp=path_spp))


def rendered(store: Store, spec: SceneSpec, half_spp: int) -> Rendered:
    """What the markers of a store say; the median leaves out jobs in which kernels were compiled."""
    scene = store.scene(spec.scene_id)
    plans = [plan for plan in scene.plans() if isinstance(plan.request, Request)]
    jobs = [job for plan in plans for job in range(plan.first_job, plan.end_job)]
    figures = [scene.marker(job)["figures"] for job in jobs]
    each = [found["core_s"] / len(scene.job_rows(job).samples) for job, found in zip(jobs, figures, strict=True)]
    return Rendered(Path(store.root), half_spp, median(each), sum(found["redrawn"] for found in figures))


# ---------------------------------------------------------------------------------------------------------- processes


def in_processes(task: Callable[..., Any], items: Sequence[tuple[Any, ...]], processes: int, what: str) -> list[Any]:
    """The task's result for each item, from so many processes at a time, which end with this one; tells how far."""
    if not items:
        return []
    context = multiprocessing.get_context("spawn")  # Dr.Jit does not outlive a fork
    with ProcessPoolExecutor(processes, mp_context=context, initializer=_end_with_parent) as pool:
        started = [pool.submit(task, *item) for item in items]
        try:
            for count, done in enumerate(as_completed(started), 1):
                done.result()
                room_study.tell(f"{what} {count} of {len(started)}")
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        return [done.result() for done in started]


def _end_with_parent() -> None:
    if sys.platform == "linux":  # an executor's processes wait for ever for one that was killed
        ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG
