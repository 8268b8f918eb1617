#!/usr/bin/env python3
"""Whether networks come in the paper's order on `room`, whose lights move: trained alike, on the same held-out views.

    python bench/order.py [--configurations 2048] [--steps 7000] [--seeds 0 1] [--plan-seed 1] [--out docs/results]

Renders the samples, trains cnn, feature_projection, light_transport and light_transport_photons with the preset `small`
from each seed, and shows their images of some views side by side. What is rendered and trained stays in build/order,
and the next call goes on with it. Exit code 0, whatever the order.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import results
import room_study
from mosaic import mosaic
from network_errors import Errors, each_seed, of_intervals, stated
from photonfarm.shared.plan import Request
from photonfarm.shared.records import F32
from photonfarm.shared.scene import SceneSpec, load_spec
from photonfarm.shared.store import Store
from photonfarm.shared.top_up import TopUp
from photonfarm.trainer.metrics import flip, metric_space, mssim
from photonfarm.trainer.settings import preset
from photonfarm.trainer.store_source import StoreSource
from room_study import HELD_OUT, References, Run, settings_of

ARCHITECTURES = ("cnn", "feature_projection", "light_transport", "light_transport_photons")
PUBLISHED = (0.0100, 0.0098, 0.0029, 0.0014)
"""Their MSE with movable lights [supplement Table 2], in another scene, of wider networks trained for longer."""

BLOCK = 8  # px
METRICS = {"MSE": "shown", f"MSE of {BLOCK} × {BLOCK} means": "coarse", "1 − MSSIM": "dissimilarity", "FLIP": "flip"}
CLOSE = 0.1  # ≈: a gap of less than this share of the first's error
SHOWN = (0.3, 0.6, 0.8, 0.95)  # quantiles of the first architecture's error: these views are shown
PICTURE = "order.png"


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """One architecture, trained from each seed; N views."""

    architecture: str
    parameters: int
    train_s: float  # of one run's steps, wall time
    shown: Errors  # squared, in the metric space
    coarse: Errors  # the same of means of blocks of pixels
    linear: Errors  # squared, in exposed linear radiance
    dissimilarity: Errors  # 1 − MSSIM
    flip: Errors
    images: F32  # (N, H, W, 3) from the first seed


def render(spec: SceneSpec, store: Store, told: argparse.Namespace) -> None:
    """One view of each configuration, and further passes of those that are held out."""
    samples = Request(modifications=told.configurations, seed=told.plan_seed)
    further = TopUp.of(str(told.reference_spp), [f"held-out={HELD_OUT}"])
    room_study.render(spec, store, [samples, further], told.processes)


def runs(architecture: str, where: tuple[Path, SceneSpec], told: Any) -> list[Run]:
    """Of one architecture, one from each seed; `where` is the folder and the scene."""
    folder, spec = where
    source = partial(StoreSource, folder / "store", spec.scene_id)
    return [Run(source, settings_of(architecture, seed, told), folder, architecture) for seed in told.seeds]


def measure(architecture: str, where: tuple[Path, SceneSpec], references: References, told: Any) -> Measured:
    """Look at the held-out views with networks that are trained, one from each seed."""
    ours = runs(architecture, where, told)
    made = [room_study.images(run.trained(), run.source(), references.rows) for run in ours]
    wanted = metric_space(references.mean)

    def each(error: Callable[[F32], NDArray[np.float64]]) -> Errors:
        return Errors(np.stack([error(images) for images in made]), references.units)

    shown = each(references.shown_errors)
    room_study.tell(f"{architecture}: {each_seed(shown)}")
    return Measured(
        architecture,
        parameters=sum(weight.numel() for weight in ours[0].trained().weights.values()),
        train_s=sum(run.seconds() for run in ours) / len(ours),
        shown=shown,
        coarse=each(partial(references.shown_errors, block=BLOCK)),
        linear=each(references.linear_errors),
        dissimilarity=each(lambda images: 1 - mssim(metric_space(images), wanted)),
        flip=each(lambda images: flip(metric_space(images), wanted)),
        images=made[0],
    )


def photon_map(where: tuple[Path, SceneSpec], references: References, told: Any) -> tuple[Errors, Errors]:
    """Squared errors in the metric space, and of means of blocks, of what the last architecture adds its output to."""
    run = runs(ARCHITECTURES[-1], where, told)[0]
    unlearned = room_study.photon_maps(run.trained(), run.source(), references.rows)
    errors = references.shown_errors(unlearned), references.shown_errors(unlearned, BLOCK)
    return Errors(errors[0][None], references.units), Errors(errors[1][None], references.units)


# --------------------------------------------------------------------------------------------------------------- page


def errors_table(measured: list[Measured]) -> str:
    header = (
        "architecture", "parameters", "MSE (95 %)", "of each seed", f"of {BLOCK} × {BLOCK} means", "linear MSE (95 %)",
        "MSSIM", "FLIP", "training, minutes", "published MSE",
    )  # fmt: skip
    lines = [
        [
            f"`{m.architecture}`", f"{m.parameters:,}", stated(m.shown), each_seed(m.shown), stated(m.coarse),
            stated(m.linear, 3), f"{1 - m.dissimilarity.estimate().mean:.3f}", f"{m.flip.estimate().mean:.3f}",
            f"{m.train_s / 60:.1f}", f"{published:.4f}",
        ]
        for m, published in zip(measured, PUBLISHED, strict=True)
    ]  # fmt: skip
    return results.table(header, lines)


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Two architectures by one metric, on the same views."""

    first: Errors
    second: Errors

    @property
    def gap(self) -> Errors:
        """The first's errors less the second's."""
        return self.first.less(self.second)

    @property
    def share(self) -> float:
        """The gap as a share of the first's error."""
        return self.gap.estimate().mean / self.first.estimate().mean

    @property
    def sign(self) -> str:
        """≈ where the gap is small, whatever its significance."""
        return "≈" if abs(self.share) < CLOSE else ">" if self.share > 0 else "<"

    @property
    def word(self) -> str:
        """What the gap's interval says of the first."""
        low, high = self.gap.interval()
        return "is worse than" if low > 0 else "is better than" if high < 0 else "is not told apart from"

    def agrees(self, other: Pair) -> bool:
        """Whether another metric says the same, of significance and of ≈."""
        return (self.word, self.sign) == (other.word, other.sign)


def pairs(measured: list[Measured], metric: str) -> list[tuple[Measured, Measured, Pair]]:
    """Neighbours in the paper's order."""
    field = METRICS[metric]
    return [(a, b, Pair(getattr(a, field), getattr(b, field))) for a, b in pairwise(measured)]


def pairs_table(measured: list[Measured], metric: str) -> str:
    header = (
        "pair", f"{metric} of the first less that of the second (95 %)", "of each seed", "share of the first's",
        "the first", "of views",
    )  # fmt: skip
    lines = [
        [
            f"`{first.architecture}` {pair.sign} `{second.architecture}`", stated(pair.gap),
            each_seed(pair.gap, "+.5f"), f"{pair.share:+.0%}", f"{pair.word} the second",
            f"smaller of the second in {(pair.gap.of_views() > 0).mean():.0%}",
        ]
        for first, second, pair in pairs(measured, metric)
    ]  # fmt: skip
    return results.table(header, lines)


def verdict(measured: list[Measured]) -> str:
    """What the gaps and their intervals say of each pair, in words; metrics that say another thing than MSE are named.

    Of networks from one seed it is said of these networks.
    """
    by_metric = {metric: pairs(measured, metric) for metric in METRICS}
    sentences: list[str] = []
    others: list[str] = []
    for place, (first, second, by_mse) in enumerate(by_metric["MSE"]):
        said = {
            metric: f"`{first.architecture}` {pair.word} `{second.architecture}` (gap {pair.share:+.0%}, {pair.sign})"
            for metric, (_, _, pair) in ((metric, found[place]) for metric, found in by_metric.items())
        }
        sentences.append(said["MSE"])
        others += [f"by {m} {said[m]}" for m, found in by_metric.items() if not found[place][2].agrees(by_mse)]
    of_whom = "Of these networks, one of each kind, by MSE: " if len(measured[0].shown.values) == 1 else "By MSE: "
    disagreement = f"Other metrics disagree: {'; '.join(others)}." if others else "All other metrics say the same."
    return f"{of_whom}{'; '.join(sentences)}. {disagreement}"


def page(
    told: argparse.Namespace,
    spec: SceneSpec,
    references: References,
    measured: list[Measured],
    unlearned: tuple[Errors, Errors],
) -> str:
    """The tables as Markdown; `unlearned` are errors of the photon map."""
    settings, paper = settings_of(ARCHITECTURES[0], told.seeds[0], told), preset("paper-dynamic")
    units = len(set(references.units))
    trained_on, drawn = told.configurations - units, told.steps * settings.batch
    tables = "\n\n".join(f"By {metric}:\n\n{pairs_table(measured, metric)}" for metric in METRICS)
    return f"""# The paper's order on `room` with movable lights

{verdict(measured)}

Gaps are shares of the first's error. **≈** stands for one of less than {CLOSE:.0%}, whether or not it is significant;
"worse" and "better" for one whose 95 % interval leaves out 0, however small it is.

Trained on {trained_on} samples of {2 * spec.transport.half_spp} spp, one view of one configuration each, at
{spec.film.width}²; measured on {room_study.counted(len(references.rows), "view")} of {units} further configurations;
plan seed {told.plan_seed}. Nine pieces of furniture and two ceiling lights are placed anew in each. Preset `small`:
width {settings.network.width}, {settings.network.points} points; for each architecture alike {told.steps} steps of
{settings.batch} samples, so that each sample is seen {drawn / trained_on:.1f} times;
{room_study.described(settings)}. {room_study.counted(len(told.seeds), "seed")}, of weights and of the order of samples.

**MSE** is in the metric space, clip(I, 0, 1)^(1/2.2), against references of {references.spp} spp whose noise is taken
out by their halves, but for what that curve makes of it; **of {BLOCK} × {BLOCK} means**, the same of blocks of pixels,
which tells of light rather than of texture and edges.
**Linear MSE** is in exposed radiance, noise taken out in the same way. **MSSIM** and **FLIP** are
in the metric space against the mean of both halves, with its noise: a standard deviation of
{references.noise(references.spp):.3f} in exposed radiance, root mean square over pixels.
{of_intervals(len(told.seeds))}

{errors_table(measured)}

What `{ARCHITECTURES[-1]}` adds its output to, the photon map of {spec.photons.paths} light paths, has an MSE of
{stated(unlearned[0])}, {stated(unlearned[1])} of {BLOCK} × {BLOCK} means: nothing in it is learned.

The published figures are of another scene, at 256², with {paper.network.width / settings.network.width:g} times the
width, and {paper.max_steps * paper.batch / drawn:.0f} times as many samples were drawn for them.

## In pairs, on the same views

{tables}

## Pictures

From left to right: the reference, then the architectures in the table's order, from seed {told.seeds[0]}, with their
MSE. From top to bottom: the views at the quantiles {", ".join(f"{q:g}" for q in SHOWN)} of the error of
`{ARCHITECTURES[0]}`.

![the reference and four predictions of {len(SHOWN)} held-out views]({PICTURE})

{results.footer("order")}"""


def shown_views(measured: list[Measured]) -> list[int]:
    """The views that are shown."""
    ranked = np.argsort(measured[0].shown.values[0])
    return [int(ranked[round(q * (len(ranked) - 1))]) for q in SHOWN]


def picture(references: References, measured: list[Measured]) -> Any:
    """One image (PIL): a line per view, the reference and each architecture's image with its error below."""
    views = shown_views(measured)
    columns = [(m.architecture, m.images[views], m.shown.values[0][views]) for m in measured]
    return mosaic([("reference", references.mean[views], None), *columns])


def document(
    told: argparse.Namespace, references: References, measured: list[Measured], unlearned: tuple[Errors, Errors]
) -> dict[str, Any]:
    """The figures of order.json; of each view, its errors from each seed."""
    rows = [
        {"architecture": m.architecture, "parameters": m.parameters, "train_s": m.train_s}
        | {name: np.round(getattr(m, name).values, 6).tolist() for name in ("linear", *METRICS.values())}
        for m in measured
    ]
    of_map = dict(zip(("shown", "coarse"), (np.round(errors.values, 6).tolist() for errors in unlearned), strict=True))
    study = room_study.document(settings_of(ARCHITECTURES[0], told.seeds[0], told), told, references)
    return study | {"rows": rows, "photon_map": of_map}


def options() -> argparse.ArgumentParser:
    """What can be told."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--configurations", type=int, default=2048, help="rendered, held-out ones included (2048)")
    room_study.add_options(parser, "order")
    parser.set_defaults(steps=7000, decay=0.96, loss="paired", demodulation=0.2)
    results.add_options(parser)
    return parser


def main() -> int:
    """Run the benchmark; returns the exit code."""
    told = options().parse_args()
    torch.set_num_threads(1)
    spec = load_spec("room")
    folder, store = room_study.opened(told, str(told.configurations))
    render(spec, store, told)
    references = References.of(store, spec, told.reference_spp)
    room_study.train_all([run for name in ARCHITECTURES for run in runs(name, (folder, spec), told)], told.processes)
    measured = [measure(name, (folder, spec), references, told) for name in ARCHITECTURES]
    unlearned = photon_map((folder, spec), references, told)
    told.out.mkdir(parents=True, exist_ok=True)
    picture(references, measured).save(told.out / PICTURE)
    values = document(told, references, measured, unlearned)
    results.write("order", page(told, spec, references, measured, unlearned), values, told.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
