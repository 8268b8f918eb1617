"""Errors of runs, of OIDN and of the samples' mean as a half of a view gets more samples, against what none has seen.

    python -m experiments.one_half STORE --run RUN [--run RUN …] [--passes 1 4 16 64]

Of each held-out view with enough passes, the half is the mean of half A of its first passes, and references are those
of the passes after the last that any half has; as these have two independent halves, their noise is taken out. OIDN is
given reflectance, in which lamps are white. Errors are mean squares in the metric space, with intervals over views;
ratios are to OIDN's best quality in pairs of views; light is the mean of an image over that of the references.
Exit code 0.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bench.harness import results
from photonfarm.core.records import F32
from photonfarm.core.statistics import Estimate
from photonfarm.data.torch_dataset import SceneDataset
from photonfarm.plan.hold_out import rows_held_out
from photonfarm.store import SceneReader
from photonfarm.trainer.data.feed import read_batch
from photonfarm.trainer.metrics.image_metrics import metric_space
from photonfarm.trainer.networks.inputs import Inputs, NoisyColour, require
from photonfarm.trainer.predictors.half_filter import HalfFilter
from photonfarm.trainer.predictors.trained import TrainedRun

MEAN, BEST = "the samples' mean", "oidn"


@dataclass(frozen=True, slots=True)
class HeldOutView:
    """A view that no run has seen, with the halves A that are given, and references of further passes."""

    row: int
    given: Tensor  # (n, H, W, 3) exposed
    reference: tuple[F32, F32]  # two independent means, (H, W, 3)

    def half(self, passes: int) -> NoisyColour:
        """The mean of the first passes, and the variance of that."""
        given = self.given[:passes]
        image, kept = given.mean(dim=0)[None], torch.ones(1, *given.shape[1:3], dtype=torch.bool)
        variance = given.mean(dim=-1).var(dim=0, correction=min(passes - 1, 1))[None] / passes
        return NoisyColour(image, kept, torch.tensor([float(passes)]), variance)


def read_views(source: SceneReader, hold_out: float, most: int, least: int) -> Iterator[HeldOutView]:
    """The held-out views of which there are at least so many passes beyond the `most` that a half is made of."""
    first = {source.view_row(row): row for row in reversed(source.rows.tolist())}
    rows = sorted(first.values())
    for row, held in zip(rows, rows_held_out(source, rows, hold_out), strict=True):
        passes = source.rows_of_view(source.view_row(row))
        if held and len(passes) >= most + least:
            halves = np.stack([source.read_radiance(int(each)) for each in passes]) * np.float32(source.spec.exposure)
            a, b = halves[most:].mean(axis=0, dtype=np.float64).astype(np.float32)
            yield HeldOutView(row, torch.from_numpy(halves[:most, 0].copy()), (a, b))


def list_predictors(
    source: SceneReader, runs: Sequence[TrainedRun]
) -> dict[str, tuple[TrainedRun, Callable[[Inputs], Tensor]]]:
    """What makes images of inputs, by name: the samples' mean, OIDN in two qualities, and the runs."""
    guided = next(run for run in runs if run.needs.guides)
    made: dict[str, tuple[TrainedRun, Callable[[Inputs], Tensor]]] = {
        MEAN: (guided, lambda inputs: require(inputs.noisy).colour)
    }
    for name in (BEST, "oidn-fast"):
        network = guided.settings.network.model_copy(update={"filter": name})
        made[name] = guided, partial(_filter, HalfFilter(guided.settings.model_copy(update={"network": network})))
    for run in runs:
        made[run.folder.name] = run, run.predictor(source.spec, source.base(), "cpu").images
    return made


def _filter(denoise: HalfFilter, inputs: Inputs) -> Tensor:
    return require(require(denoise(inputs).noisy).filtered)


@torch.no_grad()
def measure(store: Path, runs: Sequence[TrainedRun], passes: Sequence[int], least: int) -> list[tuple[str, ...]]:
    """A row of the table for each number of passes and predictor."""
    source = runs[0].source(store)
    source.refresh()
    views = list(read_views(source, runs[0].settings.hold_out, max(passes), least))
    predictors, rows = list_predictors(source, runs), []
    for count in passes:
        errors: dict[str, list[float]] = {name: [] for name in predictors}
        light: dict[str, list[float]] = {name: [] for name in predictors}
        for view in views:
            wanted = [metric_space(image[None]).numpy() for image in view.reference]
            for name, (run, predict) in predictors.items():
                points = run.settings.network.points
                dataset = SceneDataset(source, run.needs.fields, exposure=source.spec.exposure, points=points)
                inputs = replace(read_batch(source, dataset, [view.row], run.needs).inputs, noisy=view.half(count))
                image = predict(inputs)
                shown = metric_space(image).numpy()
                errors[name].append(float(np.mean((shown - wanted[0]) * (shown - wanted[1]))))
                light[name].append(float(image.mean()) / float(np.mean(view.reference)))
        best = np.array(errors[BEST])
        for name in predictors:
            own = np.array(errors[name])
            difference = Estimate.of(own - best)
            interval = 1.96 * (difference.standard_error or np.nan) / best.mean()
            rows.append(
                (
                    str(source.spec.transport.half_spp * count),
                    name,
                    f"{own.mean():.5f} ± {1.96 * own.std(ddof=1) / len(own) ** 0.5:.5f}",
                    f"{own.mean() / best.mean():.2f} ± {interval:.2f}",
                    f"{np.mean(own < best):.0%}",
                    f"{np.mean(light[name]):.3f}",
                )
            )
    return [(*row, str(len(views))) for row in rows]


def main() -> None:
    """Measure, and print a table in Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store", type=Path)
    parser.add_argument("--run", type=Path, action="append", required=True, help="one with guides among them")
    parser.add_argument("--passes", type=int, nargs="+", default=[1, 4, 16, 64])
    parser.add_argument("--least", type=int, default=16, help="passes of a reference")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    runs = [TrainedRun.load(folder) for folder in asked.run]
    rows = measure(asked.store, runs, asked.passes, asked.least)
    print(results.table(("spp", "", "MSE (95 %)", "over OIDN", "better views", "light", "views"), rows))


if __name__ == "__main__":
    main()
