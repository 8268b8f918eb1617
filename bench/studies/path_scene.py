"""A room rendered by Mitsuba's `path` in the place of `bdpt`: the scene, what both cost, and a store of each kind.

Both stores are of one spec, and so of one scene id: configurations, views, point clouds, photons and what is held out
are the same bit by bit. Only the half-estimates differ; those of `path` have another number of samples per pixel than
the spec says, which is chosen so that a sample takes about as long.

`path` is called as it is. Recorded and replayed as `bdpt` is, it gives the same images and takes 1.1 to 1.6 times as
long (Mitsuba 3.9, in two rooms): its launches are put together in C++, not in Python.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from bench.harness.room_study import in_processes, planned, render_job
from photonfarm.core.files import write_whole
from photonfarm.core.records import F32
from photonfarm.plan.request import Request
from photonfarm.plan.top_up import TopUp
from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.scene.modification import sample_modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import View, sample_view
from photonfarm.store import Store

SHARD_ROWS = 16  # small jobs: those of both kinds take turns, so that both are timed on the same machine
TIMED_SEED = 1 << 40  # of configurations that are only timed; no plan has it by chance
BDPT, FEW, MANY = 0, 9, 36  # samples per pixel that `path` is timed at; 0 stands for `bdpt`, with the spec's
WARM_UP = 3  # views: kernels are compiled and launches recorded


class PathScene(LoadedScene):
    """A scene whose half-estimates are those of Mitsuba's `path`, with the spec's path lengths.

    Seeds, camera and box filter are as with `bdpt`, one render for each half. Samples are Mitsuba's `multijitter`, as
    `bdpt` has stratified ones too; `spp` are those of a pixel, and fill a grid. The spec's `half_spp` is not looked at.
    """

    def __init__(self, spec: SceneSpec, scene: Any) -> None:
        import mitsuba as mi

        super().__init__(spec, scene)
        self._sensor = _stratified(spec)
        lengths = {"max_depth": spec.transport.max_depth, "rr_depth": spec.transport.rr_depth}
        self._path = mi.load_dict({"type": "path", **lengths})
        self.spp = spec.transport.half_spp

    def render_halves(self, view: View, seeds: Sequence[int], half_spp: int | None = None) -> F32:
        """Half-estimates of linear radiance for each seed, (K, H, W, 3); of `spp` unless another number is given."""
        return np.stack([self.render(view, seed, self._path, half_spp or self.spp) for seed in seeds])


def _stratified(spec: SceneSpec) -> Any:
    """The spec's sensor with a stratified sampler: `bdpt`, which has points of its own, does not ask it."""
    import mitsuba as mi

    from photonfarm.renderer.scene.loading import AimedSensor, describe

    class Stratified(AimedSensor):
        def __init__(self) -> None:
            self._spec = spec
            self.sensor = mi.load_dict(describe(spec) | {"sampler": {"type": "multijitter"}})
            self._parameters = mi.traverse(self.sensor)

    return Stratified()


def filling_a_grid(spp: float) -> int:
    """The nearest number of samples per pixel, 3 at least, that `multijitter` takes as it is and is unbiased with.

    It rounds up numbers that fill no grid. Powers of two are left out: with 16, 320 images of a view of Veach's room
    were darker by 0.7 % (5 standard errors) than those of independent samples and of `bdpt`; with 20 and 36 they were
    as bright within 0.2 %.
    """
    grids = (count for count in range(3, 2 * math.ceil(max(spp, 3))) if count % math.isqrt(count) == 0)
    return min((count for count in grids if count & (count - 1)), key=lambda count: abs(count - spp))


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
        """Samples per pixel of a half by `path` that cost about what a half by `bdpt` does."""
        return filling_a_grid((self.bdpt_s - self.path_fixed_s) / self.path_spp_s)


def integrator_costs(spec: SceneSpec, views: int) -> Costs:
    """Time both integrators by turns on one view each of so many configurations."""
    scene = load_path(spec, FEW)
    spent = {BDPT: 0.0, FEW: 0.0, MANY: 0.0}
    for number in range(WARM_UP + views):
        modification = sample_modification(spec, TIMED_SEED, number)
        view = sample_view(spec, modification.key(spec.radiance_id), TIMED_SEED, 0)
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
        (costs,) = in_processes(integrator_costs, [(spec, views)], 1, "timed both integrators")
        write_whole(file, json.dumps(asdict(costs)) + "\n")
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
        missing = planned(spec, opened, asked[kind], SHARD_ROWS).missing_jobs()
        told = str(opened.root), spec.scene_id, BDPT if kind == "bdpt" else costs.path_spp
        jobs += [(place / len(missing), (*told, job)) for place, job in enumerate(missing)]
    in_processes(render_any, [job for _, job in sorted(jobs)], processes, "rendered")
    return {kind: rendered(opened, spec, half_spp[kind]) for kind, opened in stores.items()}


def render_any(root: str, scene_id: str, path_spp: int, job: int) -> None:
    """One job, by `path` with so many samples per pixel in a half, or by `bdpt`."""
    if path_spp == BDPT:
        render_job(root, scene_id, job)
    else:
        _path_renderer(root, path_spp).render(scene_id, job)


@cache
def _path_renderer(root: str, path_spp: int) -> ShardRenderer:
    return ShardRenderer(Store(root), worker=f"bench, path {path_spp} spp", load=partial(load_path, spp=path_spp))


def rendered(store: Store, spec: SceneSpec, half_spp: int) -> Rendered:
    """What the markers of a store say; the median leaves out jobs in which kernels were compiled."""
    scene = store.scene(spec.scene_id)
    plans = [plan for plan in scene.plans() if isinstance(plan.request, Request)]
    jobs = [job for plan in plans for job in range(plan.first_job, plan.end_job)]
    figures = [scene.marker(job)["figures"] for job in jobs]
    each = [found["core_s"] / len(scene.job_rows(job).samples) for job, found in zip(jobs, figures, strict=True)]
    return Rendered(Path(store.root), half_spp, median(each), sum(found["redrawn"] for found in figures))
