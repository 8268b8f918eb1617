#!/usr/bin/env python3
"""Many noisy samples or few clean ones: held-out errors at equal samples per pixel in all, and equal steps.

    python bench/noise_budget.py [--budget 2048] [--steps 1500] [--seeds 0 1] [--plan-seed 1] [--out docs/results]

`room` is rendered with 1 spp in a half-estimate. A sample of s spp is the mean of halves of its view: of one half for
1 spp, of s/2 passes for 4, 16 and 64. Each network is trained on `budget`/s configurations, one view of each, and for
each seed on others where s ≥ 4. What is rendered and trained stays in build/noise_budget, and the next call goes on
with it. Exit code 0, whatever comes out.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import results
import room_study
from photonfarm.shared.plan import Request
from photonfarm.shared.records import ViewBuffers, arrays_of
from photonfarm.shared.scene import SceneSpec
from photonfarm.shared.store.reader import SceneReader
from photonfarm.shared.top_up import TopUp
from photonfarm.trainer.dataset import rows_held_out
from photonfarm.trainer.store_source import StoredSample, StoreSource
from room_study import HELD_OUT, Errors, References, each_seed, settings_of, stated

SPP = (1, 4, 16, 64)  # of a sample
HALF_SPP = 1  # of what is rendered
HELD_OUT_VIEWS = 64
ARCHITECTURE = "light_transport"
MOST_SEEDS = SPP[1] - 1  # with so many slices the second arm needs fewer configurations than the first has


class Arm(StoreSource):
    """Samples of `spp`, one view each of so many configurations that they make up a budget.

    A sample's halves are means of the halves of its view's first passes. A sample of one spp is a half A, as both of
    its halves, so that the loss sees no other. An arm of a slice holds every `slices`-th configuration, and one of
    cleaner samples some of those that noisier ones of its slice hold.
    """

    def __init__(self, root: Path, scene_id: str, spp: int, budget: int, slice_: tuple[int, int] = (0, 1)) -> None:
        """Of a slice, its number and how many there are; raises ValueError where the store has too few samples."""
        super().__init__(root, scene_id)
        reader = SceneReader(root, scene_id)
        self._spp, self._wanted = spp, -(-spp // (2 * HALF_SPP))
        complete = super().refresh().tolist()
        reader.refresh()
        first = {reader.view_row(row): row for row in reversed(complete)}
        passes = {row: reader.rows_of_view(view).tolist() for view, row in sorted(first.items())}
        self._passes = {row: of[: self._wanted] for row, of in passes.items()}
        held_out = dict(zip(self._passes, rows_held_out(self, list(self._passes), HELD_OUT), strict=True))
        number, slices = slice_
        enough = [row for row, held in held_out.items() if not held and len(self._passes[row]) == self._wanted]
        self.rows = enough[number::slices][: budget // spp]
        self._new = [*self.rows, *[row for row, held in held_out.items() if held][:1]]  # a trainer wants one to look at
        if len(self.rows) < budget // spp:
            raise ValueError(
                f"slice {number} of {slices}: {len(self.rows)} views have {self._wanted} passes, and {budget // spp} "
                "are needed"
            )

    def refresh(self) -> NDArray[np.int64]:
        """The chosen samples, at the first call."""
        new, self._new = self._new, []
        return np.array(new, np.int64)

    def taken_back(self) -> NDArray[np.int64]:
        """None is."""
        return np.empty(0, np.int64)

    def read_batch(self, rows: Sequence[int]) -> list[StoredSample]:
        """The chosen samples of these rows."""
        return [self._mean(row) for row in rows]

    def _mean(self, row: int) -> StoredSample:
        read = super().read_batch(self._passes[row])
        halves = np.mean([sample.radiance.astype(np.float32) * sample.scale for sample in read], axis=0)
        halves = halves[[0, 0]] if self._spp < 2 * HALF_SPP else halves
        buffers: dict[str, Any] = {name: values.copy() for name, values in arrays_of(read[0].buffers).items()}
        return replace(read[0], radiance=halves, scale=1.0, buffers=ViewBuffers(**buffers))

    def planned(self) -> int:
        """As many as were chosen."""
        return len(self.rows) + 1


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """Networks of one kind of samples, one from each seed."""

    spp: int  # of a sample
    samples: int
    shown: Errors  # squared, in the metric space
    linear: Errors  # squared, in exposed linear radiance
    noise: float  # standard deviation of a target's pixel, exposed linear radiance, root mean square


def slices_of(spp: int, seeds: int) -> int:
    """Over how many slices of the configurations an arm's seeds are spread: one each, but for 1 spp one for all.

    The configurations of 1 spp are all that the budget has.
    """
    return seeds if spp > 1 else 1


def requests(told: argparse.Namespace) -> list[Request | TopUp]:
    """Passes for all samples, an eighth of configurations more than are trained on; then for the held-out views."""
    asked: list[Request | TopUp] = []
    for spp in reversed(SPP):
        samples = slices_of(spp, len(told.seeds)) * (told.budget // spp)
        passes = -(-spp // (2 * HALF_SPP))
        asked.append(Request(modifications=samples + samples // 8 + 8, passes=passes, seed=told.plan_seed))
    held_out = [f"held-out={HELD_OUT}", f"views=first:{HELD_OUT_VIEWS}"]
    return [*asked, TopUp.of(str(told.reference_spp), held_out)]


def measure(spp: int, where: tuple[Path, SceneSpec], references: References, told: argparse.Namespace) -> Measured:
    """Train on samples of one kind from each seed, and look at the held-out views."""
    folder, spec = where
    slices, made = slices_of(spp, len(told.seeds)), []
    for place, seed in enumerate(told.seeds):
        number = place % slices
        arm = partial(Arm, folder / "store", spec.scene_id, spp, told.budget, (number, slices))
        name = f"{spp}-spp-{number}-of-{slices}"
        run, _ = room_study.trained(arm, settings_of(ARCHITECTURE, seed, told), folder, name)
        made.append(room_study.images(run, StoreSource(folder / "store", spec.scene_id), references.rows))
    shown = Errors(np.stack([references.shown_errors(images) for images in made]), references.units)
    linear = Errors(np.stack([references.linear_errors(images) for images in made]), references.units)
    room_study.tell(f"{spp} spp: {each_seed(shown)}")
    return Measured(spp, told.budget // spp, shown, linear, references.noise(spp))


# --------------------------------------------------------------------------------------------------------------- page


def table(measured: list[Measured]) -> str:
    header = ("spp of a sample", "samples", "noise of a target", "MSE (95 %)", "of each seed", "linear MSE (95 %)")
    lines = [
        [m.spp, m.samples, f"{m.noise:.3f}", stated(m.shown), each_seed(m.shown), stated(m.linear, 3)] for m in measured
    ]
    return results.table(header, lines)


def pairs_table(measured: list[Measured]) -> str:
    header = ("samples of", "less than with samples of", "MSE (95 %)", "of each seed", "of views")
    lines = []
    for noisy, clean in pairwise(measured):
        less = clean.shown.less(noisy.shown)
        share = f"{(less.of_views() > 0).mean():.0%}"
        lines.append([f"{noisy.spp} spp", f"{clean.spp} spp", stated(less), each_seed(less, "+.5f"), share])
    return results.table(header, lines)


def of_slices(seeds: int) -> str:
    """What the page says of the configurations that seeds are trained on."""
    nested = "The few configurations of clean samples are among the many of noisy ones"
    if seeds == 1:
        return f"{nested}; they are one choice: others may do better or worse."
    return (
        f"{nested}, from each seed; each seed takes others, so that var(seeds) is of this choice too, but for those of "
        "1 spp, which are all there are, and the same for every seed."
    )


def page(
    told: argparse.Namespace, spec: SceneSpec, references: References, measured: list[Measured], ms: Sequence[float]
) -> str:
    """The tables as Markdown."""
    settings, units = settings_of(ARCHITECTURE, told.seeds[0], told), len(set(references.units))
    return f"""# Noisy and clean targets at equal samples per pixel in all

`room` at {spec.film.width}², movable furniture and lights. Every line is trained on {told.budget} spp in all, spread
over views of as many configurations as there are samples: many noisy ones, or few clean ones. `{ARCHITECTURE}`, preset
`small`, {told.steps} steps of {settings.batch} samples for each line alike; {room_study.described(settings)}.
{room_study.counted(len(told.seeds), "seed")}, of weights and of the order of samples; plan seed {told.plan_seed}.
Measured on {room_study.counted(len(references.rows), "view")} of {units} further configurations, all lines after the
last step: none was stopped where it was best.

**A sample of s spp** is an image with s samples per pixel: the mean of both its halves, which the loss compares the
prediction with one by one, to the same gradient. All is rendered with {HALF_SPP} spp in a half; samples of 4, 16 and 64
spp are means over 2, 8 and 32 passes of their view, and one of 1 spp is half A alone; its half B is thrown away.
{of_slices(len(told.seeds))}

**MSE** is in the metric space, clip(I, 0, 1)^(1/2.2), against references of {references.spp} spp whose noise is taken
out by their halves. **Linear MSE** is in exposed radiance, in the same way. Noise of a target: its standard deviation
in exposed radiance, root mean square over pixels. {room_study.of_intervals(len(told.seeds))}

{table(measured)}

## In pairs, on the same views

{pairs_table(measured)}

Equal samples per pixel are not equal time: here a view of a new configuration takes {ms[0]:.0f} CPU milliseconds
with its buffers and photons and {2 * HALF_SPP} spp, and {2 * HALF_SPP} spp more of the same view {ms[1]:.0f}.

{results.footer("noise_budget")}"""


def main() -> int:
    """Run the benchmark; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--budget", type=int, default=2048, help="samples per pixel in all, of each line (2048)")
    room_study.add_options(parser, "noise_budget")
    results.add_options(parser)
    told = parser.parse_args()
    if len(told.seeds) > MOST_SEEDS:
        parser.error(f"--seeds: {len(told.seeds)} are told; each takes other configurations, enough for {MOST_SEEDS}")
    torch.set_num_threads(1)
    folder, store = room_study.opened(told, f"{told.budget}-{len(told.seeds)}")
    room_study.render(spec := room_study.room(HALF_SPP), store, requests(told))
    references = References.of(store, spec, told.reference_spp)
    measured = [measure(spp, (folder, spec), references, told) for spp in SPP]
    rows = [
        {"spp": m.spp, "samples": m.samples, "noise": m.noise}
        | {"mse": np.round(m.shown.values, 6).tolist(), "linear_mse": np.round(m.linear.values, 6).tolist()}
        for m in measured
    ]
    values = room_study.document(settings_of(ARCHITECTURE, told.seeds[0], told), told, references) | {"rows": rows}
    ms = room_study.ms_of_plans(store, spec)[len(SPP) - 1 :]  # of 1 spp, and of references
    text = page(told, spec, references, measured, ms)
    results.write("noise_budget", text, values, told.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
