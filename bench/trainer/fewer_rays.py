"""Fewer rays a pixel, and fewer lit points, for the inputs of a frame: a network's error against a frame's time.

    photonfarm up SPEC --architecture guided_transport --reference-views 32 --store STORE --run RUN --out OUT
    python -m bench.trainer.fewer_rays STORE RUN OUT/references [--rounds 15] [--train 8 4]

Each number of rays is measured with the run's network, and with `--train` with one that was trained as long on such
inputs, for which the store gets a scene more. Errors are those of the metric space; frames are `open_run(…).predict` of
the views with references, in turns, in CPU seconds, without editing. Exit code 0.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import torch

from bench.harness import results
from photonfarm.core.statistics import Estimate, group_means
from photonfarm.plan.hold_out import units_of
from photonfarm.predict.opened_run import OpenRun
from photonfarm.renderer.jobs.render import ShardRenderer, locate
from photonfarm.renderer.scene import backend
from photonfarm.scene import spec as specs
from photonfarm.store import SceneReader, Store
from photonfarm.trainer.compare.evaluation_samples import HeldOutSamples, read_references
from photonfarm.trainer.metrics.image_metrics import confidence_interval, metric_space, mse
from photonfarm.trainer.predictors.trained import TrainedRun
from photonfarm.trainer.runs.settings import MOST_HELD_OUT
from photonfarm.trainer.training.loop import train

backend.load(threads=1)
from photonfarm.renderer.bdpt.recording import loop_once  # noqa: E402
from photonfarm.renderer.scene import gbuffer, view_rays  # noqa: E402
from photonfarm.renderer.scene.guides import direct, images  # noqa: E402

PLACES = {8: (5, 0, 8), 4: (2, 1, 5)}
"""a, b, m by rays: ray i is at u = (i + ½) / rays, v = ((a·i + b) mod m + ½) / rays, once in each row and column."""

CANDIDATES = [(rays, points) for rays in (16, 8, 4) for points in (512, 256)]


@contextmanager
def through_a_pixel(rays: int, *, stored: bool = False) -> Iterator[None]:
    """So many rays a pixel within the block, and 16 if they are not in `PLACES`; in ids of scenes too, if `stored`."""
    modules: list[Any] = [view_rays, gbuffer, images, direct, *([specs] if stored else [])]
    before = vars(images)["sum_over_grid"]
    for module in modules:
        module.RAYS_PER_PIXEL = rays
    if rays in PLACES:
        for module in modules[1:3]:
            module.sum_over_grid = _sum_over_places
    yield
    for module in modules:
        module.RAYS_PER_PIXEL = 16
    for module in modules[1:3]:
        module.sum_over_grid = before


def _sum_over_places(cameras: Any, channels: Any, columns_of: Any) -> Any:
    """As `view_rays.sum_over_grid`."""
    import mitsuba as mi

    rays = vars(direct)["RAYS_PER_PIXEL"]
    a, b, m = PLACES[rays]
    pixels, kinds = cameras.pixels(), {name: mi.Color3f if n == 3 else mi.Float for name, n in channels.items()}

    def add(index: Any, sums: Any) -> Any:
        u, v = ((mi.Float(place) + 0.5) / rays for place in (index, (a * index + b) % m))
        columns = columns_of(pixels.ray(u, v), index)
        return index + 1, {name: total + kinds[name](columns[name]) for name, total in sums.items()}

    start = {name: dr.zeros(kind, cameras.lanes) for name, kind in kinds.items()}
    return loop_once(
        state=(dr.zeros(mi.UInt32, cameras.lanes), start),
        cond=lambda index, _: index < rays,
        body=add,
        labels=("index", "sums"),
        label="rays of a pixel",
    )[1]


@dataclass
class Candidate:
    """A network and its scene, for so many rays and lit points."""

    trained_with: int
    rays: int
    points: int
    opened: OpenRun

    @classmethod
    def load(cls, store: str, run: TrainedRun, trained_with: int, rays: int, points: int) -> Candidate:
        """Load the scene anew, for kernels of its own."""
        network = run.settings.network.model_copy(update={"lit_points": points})
        run = replace(run, settings=run.settings.model_copy(update={"network": network}))
        with through_a_pixel(trained_with, stored=True):
            opened = OpenRun(run, store, "cpu")
        return cls(trained_with, rays, points, opened)

    def predict(self, modification: Any, view: Any) -> torch.Tensor:
        """The exposed image (H, W, 3)."""
        with through_a_pixel(self.rays), torch.no_grad():
            if modification is not self.opened._modification:
                self.opened._apply(modification)
            position, normal = self.opened._lit
            self.opened._lit = position[: self.points], normal[: self.points]
            return self.opened.predict(modification, view) * self.opened.spec.exposure


def trained_with(store: str, run: TrainedRun, rays: int) -> TrainedRun:
    """A run of the same settings on the same samples, whose inputs have so many rays."""
    stored = Store(store).scene(run.scene_id)
    with through_a_pixel(rays, stored=True):
        spec = specs.SceneSpec.model_validate(stored.spec.model_dump(mode="json"))
        opened = Store(store)
        scene = opened.scene(opened.plan(locate(spec), stored.plans()[0].request).scene_id)
        renderer = ShardRenderer(opened, worker="bench")
        for job in range(scene.jobs()):
            renderer.render(scene.scene_id, job)
        folder = run.folder.with_name(f"{run.folder.name}-{rays}")
        train(SceneReader(store, scene.scene_id), run.settings, folder)
        return TrainedRun.load(folder)


def main() -> int:
    """Run the benchmark; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store")
    parser.add_argument("run", type=Path)
    parser.add_argument("references", type=Path)
    parser.add_argument("--rounds", type=int, default=15, help="(15)")
    parser.add_argument("--train", type=int, nargs="*", default=[], help="rays of inputs that a network is trained on")
    options = parser.parse_args()
    run = TrainedRun.load(options.run)
    torch.set_num_threads(1)
    samples = HeldOutSamples.of(run.source(options.store), run.settings.hold_out, MOST_HELD_OUT)
    source, references = samples.source, read_references(options.references, samples)
    rows = list(references)
    looks = [source.inputs(row)[:2] for row in rows]
    candidates = [Candidate.load(options.store, run, 16, *both) for both in CANDIDATES]
    for rays in options.train:
        again = trained_with(options.store, run, rays)
        candidates += [Candidate.load(options.store, again, rays, rays, points) for points in (512,)]
    halves = [np.stack([getattr(references[row], half) for row in rows]) for half in ("half_a", "half_b")]
    shown = [metric_space(half) for half in halves]
    errors = []
    times: list[list[float]] = [[] for _ in candidates]
    for candidate in candidates:
        made = np.stack([candidate.predict(*look).numpy() for look in looks])
        errors.append(group_means(mse(metric_space(made), *shown), units_of(source, rows)))
    for number in range(options.rounds + 2):
        modification, view = looks[0][0], looks[number % len(looks)][1]
        for place, candidate in enumerate(candidates):
            if not number:
                candidate.predict(modification, view)
            began = time.process_time()
            candidate.predict(modification, view)
            times[place].append(1e3 * (time.process_time() - began))
    table = []
    for candidate, error, took in zip(candidates, errors, times, strict=True):
        more = Estimate.of((error - errors[0]) / errors[0].mean())
        low, high = confidence_interval(more) or (0, 0)
        ratio = statistics.median(a / b for a, b in zip(took[2:], times[0][2:], strict=True))
        table.append(
            [
                *(candidate.trained_with, candidate.rays, candidate.points, f"{statistics.median(took[2:]):.1f}"),
                *(f"{ratio:.2f}", f"{error.mean():.6f}", f"{more.mean:+.1%} ({low:+.1%} … {high:+.1%})"),
                f"{ratio * (1 + more.mean):.2f}",
            ]
        )
    head = ["trained with", "rays", "lit points", "frame, ms", "ratio", "MSE", "more than the first", "ratio × MSE"]
    print(f"{source.spec.name}: {len(rows)} views")
    print(results.table(head, table))
    return 0


if __name__ == "__main__":
    sys.exit(main())
