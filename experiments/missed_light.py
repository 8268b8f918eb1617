"""Where a network's error is, by what pixels show; and networks that were to miss less light, and were not kept.

    python -m experiments.missed_light STORE --run RUN [--run RUN …] [--seeds 8] [--light-samples 3 6 12]
    photonfarm train SPEC --architecture experiments.missed_light:AddedLobes …

Runs are of one scene, whose held-out views have at least eight passes; errors are mean squares in the metric space, the
references' noise taken out, and ratios are to the first run, in pairs of views. With `--seeds` the views' direct light
is rendered anew so many times: what the error loses by the mean of these is the share of its noise. Exit code 0.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from bench.harness import results
from experiments.one_half import read_views
from photonfarm.core.keys import make_key, view_key
from photonfarm.core.records import F32
from photonfarm.core.statistics import Estimate
from photonfarm.data.torch_dataset import SceneDataset
from photonfarm.store import SceneReader
from photonfarm.trainer.data.feed import read_batch
from photonfarm.trainer.metrics.image_metrics import metric_space
from photonfarm.trainer.networks.guided import Guided
from photonfarm.trainer.networks.inputs import GLOSSY, GuideInputs, Inputs, Needs, SceneFrame, reflectance, require
from photonfarm.trainer.networks.light_filter import smooth
from photonfarm.trainer.networks.lit_points import (
    DIFFUSE,
    LEAST_LOGARITHM,
    SHARPEST,
    TOGETHER,
    LitPoints,
    _list_glossy,
    _measure_along,
)
from photonfarm.trainer.predictors.trained import TrainedRun
from photonfarm.trainer.runs.settings import NetworkSettings

Mask = NDArray[np.bool_]
LEAST = 8  # passes of a reference


# -------------------------------------------------------------------------------------------------------- what it shows


def classify(inputs: Inputs) -> dict[str, Mask]:
    """The pixels (H, W) of each class; every pixel is in the first one that fits it."""
    guides = require(inputs.guides)
    images = {name: image[0].numpy() for name, image in vars_of(guides).items()}
    lamp, through = images["emission"].max(-1) > 0, images["throughput"].max(-1) > 0.02
    lobes = np.maximum(images["specular"] - images["throughput"], 0).mean(-1)
    left, black = lamp | True, reflectance(inputs.albedo, guides)[0].mean(-1).numpy() < 0.02
    shines = (images["roughness"] < 0.9) & (images["mean_depth"] > 0)
    classes = {}
    for name, mask in {
        "rims of lamps": _grow(lamp) & _grow(~lamp),
        "lamps": lamp,
        "mirrors and glass": through,
        "black glass: the guides say that it reflects nothing": black & shines,
        "other lobes above .2": lobes > 0.2,
        "of .05 to .2": lobes > 0.05,
        "of .02 to .05": lobes > 0.02,
        "diffuse, at edges": _find_edges(images["mean_depth"], images["mean_normal"]),
        "diffuse": left,
    }.items():
        classes[name] = mask & left
        left = left & ~mask
    return classes


def vars_of(guides: GuideInputs) -> dict[str, Tensor]:
    """The images of guides by name."""
    return {name: getattr(guides, name) for name in GuideInputs.__dataclass_fields__ if name != "glossy_count"}


def _grow(mask: Mask) -> Mask:
    return np.asarray(functional.max_pool2d(torch.from_numpy(mask[None].astype(np.float32)), 3, 1, 1)[0] > 0)


def _find_edges(depth: F32, normal: F32) -> Mask:
    around = [np.roll(depth, shift, axis) for shift in (-1, 1) for axis in (0, 1)]
    apart = np.max(around, axis=0) - np.min(around, axis=0)
    return np.asarray((np.linalg.norm(normal, axis=-1) < 0.9) | (apart > 0.15 * depth))


# ------------------------------------------------------------------------------------------------------------- measured


@dataclass(frozen=True, slots=True)
class View:
    """A held-out view: its inputs, the network's image, and two references, (H, W, 3) each."""

    row: int
    inputs: Inputs
    image: F32
    reference: tuple[F32, F32]

    def error(self, image: F32) -> F32:
        """The squared error of an image of the view, (H, W)."""
        shown, *wanted = (metric_space(torch.from_numpy(each[None])).numpy()[0] for each in (image, *self.reference))
        return np.asarray(((shown - wanted[0]) * (shown - wanted[1])).mean(-1))


def list_views(source: SceneReader, run: TrainedRun) -> Iterator[View]:
    """The held-out views of which there are passes enough."""
    dataset = SceneDataset(source, run.needs.fields, exposure=source.spec.exposure, points=run.settings.network.points)
    predict = run.predictor(source.spec, source.base(), "cpu").images
    for held in read_views(source, run.settings.hold_out, 0, LEAST):
        inputs = read_batch(source, dataset, [held.row], run.needs).inputs
        yield View(held.row, inputs, predict(inputs)[0].numpy(), held.reference)


def render_direct(source: SceneReader, views: list[View], seeds: int) -> dict[int, F32]:
    """The direct light of views by all lobes, as the mean over further seeds, (H, W, 3) exposed, by row."""
    from photonfarm.renderer.jobs.render import lit_points, load_scene, locate

    scene, cloud, means = load_scene(locate(source.spec)), source.base()[1], {}
    for row in (view.row for view in views):
        sample = source.read(row)
        scene.apply(sample.modification)
        keys = [make_key("further", seed, sample.view.vector) for seed in range(seeds)]
        made = scene.inputs([sample.view] * seeds, keys, source.spec.guides, lit_points(cloud, sample.modification))
        means[row] = np.mean([guides.direct + guides.gloss for _, guides in made], axis=0) * source.spec.exposure
    return means


def try_light_samples(source: SceneReader, run: TrainedRun, views: list[View], numbers: list[int]) -> None:
    """Print the error of a run, and the CPU time of buffers and guides, with so many shadow rays for each ray."""
    from photonfarm.renderer.jobs.render import lit_points, load_scene, locate

    scene, cloud = load_scene(locate(source.spec)), source.base()[1]
    predict = run.predictor(source.spec, source.base(), "cpu").images
    errors: dict[int, list[float]] = {number: [] for number in numbers}
    seconds: dict[int, list[float]] = {number: [] for number in numbers}
    for view in views:
        sample = source.read(view.row)
        scene.apply(sample.modification)
        lit = lit_points(cloud, sample.modification)
        keys = [view_key(sample.modification.key(source.spec.radiance_id), sample.view.vector)]
        for number in numbers:
            wanted = source.spec.guides.model_copy(update={"light_samples": number})
            if not seconds[number]:
                scene.inputs([sample.view], keys, wanted, lit)  # compiles
            began = time.process_time()
            ((_, made),) = scene.inputs([sample.view], keys, wanted, lit)
            seconds[number].append(time.process_time() - began)
            lights = (torch.from_numpy(light * np.float32(source.spec.exposure)) for light in (made.direct, made.gloss))
            direct, gloss = (light[None] for light in lights)
            guides = replace(require(view.inputs.guides), direct=direct, gloss=gloss)
            image = predict(replace(view.inputs, guides=guides))[0].numpy()
            errors[number].append(float(view.error(image).mean()))
    for number in numbers:
        ms = 1e3 * float(np.median(seconds[number]))
        print(f"with {number} light samples: {np.mean(errors[number]):.6f}, {ms:.1f} ms")


@torch.no_grad()
def main() -> None:
    """Print a table of classes for each run, and its ratio to the first."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store", type=Path)
    parser.add_argument("--run", type=Path, action="append", required=True)
    parser.add_argument("--seeds", type=int, default=0, help="further seeds of direct light")
    parser.add_argument("--light-samples", type=int, nargs="*", default=[], help="other numbers of shadow rays to try")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    first: F32 | None = None
    for folder in asked.run:
        run = TrainedRun.load(folder)
        source = run.source(asked.store)
        source.refresh()
        views = list(list_views(source, run))
        errors = np.stack([view.error(view.image) for view in views])
        masks = [classify(view.inputs) for view in views]
        rows = []
        for name in masks[0]:
            mask = np.stack([each[name] for each in masks])
            rows.append((name, f"{errors[mask].sum() / errors.sum():.1%}", f"{mask.mean():.1%}"))
        print(results.table((f"{folder.name}: {errors.mean():.6f}, {len(views)} views", "error", "pixels"), rows))
        if asked.seeds:
            lights = render_direct(source, views, asked.seeds)
            stored = {v.row: require(v.inputs.guides) for v in views}
            given = {row: (each.direct + each.gloss)[0].numpy() for row, each in stored.items()}
            quiet = [v.error(v.image + lights[v.row].astype(np.float32) - given[v.row]).mean() for v in views]
            print(f"with the mean of {asked.seeds} seeds of direct light: {np.mean(quiet):.6f}")
        try_light_samples(source, run, views, asked.light_samples)
        means = errors.mean(axis=(1, 2))
        first = means if first is None else first
        gap = Estimate.of(means - first)
        spread = 1.96 * (gap.standard_error or 0) / first.mean()
        print(f"over the first: {means.mean() / first.mean():.2f} ± {spread:.2f}\n")


# -------------------------------------------------------------------------------------------------- tried, and not kept


@dataclass(frozen=True, slots=True, eq=False)
class MoreGlossy(GuideInputs):
    """Guides in which pixels whose other lobes reflect more than the diffuse one, and above .02, count as glossy."""

    albedo: Tensor | None = None  # (B, H, W, 3)

    def find_glossy(self) -> Tensor:
        """Those, and all above `inputs.GLOSSY`."""
        lobes = (self.specular - self.throughput).mean(-1)
        return (lobes > GLOSSY) | ((lobes > 0.02) & (lobes > require(self.albedo).mean(-1)))


def widen(inputs: Inputs) -> Inputs:
    """The inputs with more glossy pixels."""
    guides = MoreGlossy(**vars_of(require(inputs.guides)), albedo=inputs.albedo)
    return replace(inputs, guides=guides)


class AddedLobes(Guided):
    """The light of lit points by lobes, of more pixels, is added to the known light, too."""

    needs = Needs(guides=True)

    def __init__(self, settings: NetworkSettings, frame: SceneFrame) -> None:
        super().__init__(settings, frame, transport=LitPoints)

    def forward(self, inputs: Inputs) -> Tensor:
        """The image."""
        return super().forward(widen(self.raise_specular(inputs)))

    def known(self, inputs: Inputs, further: list[Tensor]) -> Tensor:
        """The known light with that of lobes."""
        guides = require(inputs.guides)
        lobes = (guides.specular - guides.throughput).clamp(min=0) * torch.expm1(further[DIFFUSE + 1])
        return super().known(inputs, further) + lobes


class SeenPoints(LitPoints):
    """Lit points whose light by lobes has the learned visibility, as their diffuse light has; without gradients."""

    @torch.no_grad()
    def _gloss(self, inputs: Inputs, surfaces: tuple[Tensor, Tensor, Tensor], source: Tensor, sent: Tensor) -> Tensor:
        guides = require(inputs.guides)
        pixel, slot, sample = _list_glossy(guides)
        places = pixel.new_zeros(len(sample) * TOGETHER).index_copy_(0, slot, pixel)
        images = (image.flatten(0, 2).index_select(0, places) for image in (*surfaces, guides.roughness[..., None]))
        rays, at, normal, roughness = (image.view(-1, TOGETHER, image.shape[-1]) for image in images)
        senders = self.visibility.surfaces(source, self.normal.expand_as(source)).index_select(0, sample)
        seen = self.visibility(self.visibility.surfaces(at, normal), senders)
        light = self._seen_lobes(seen, at, normal, rays, roughness, source[sample], sent[sample])
        gloss = torch.zeros_like(guides.specular)
        gloss.flatten(0, 2).index_copy_(0, pixel, light.flatten(0, 1).index_select(0, slot))
        return gloss

    def _seen_lobes(self, seen: Tensor, at: Tensor, normal: Tensor, rays: Tensor, *others: Tensor) -> Tensor:
        roughness, source, sent = others
        mirrored = rays - 2 * (rays * normal).sum(-1, keepdim=True) * normal
        sharpness = 0.5 / roughness.clamp(min=SHARPEST) ** 2
        leaves, squared = self._between(at, source)
        nearness = squared.rsqrt_()
        weight = _measure_along(sharpness * mirrored, at, source).mul_(nearness).sub_(sharpness)
        weight.clamp_(min=LEAST_LOGARITHM).exp_().mul_(leaves).mul_(nearness.pow_(3))
        return (weight * seen) @ sent / weight.sum(-1, keepdim=True).clamp(min=1e-12)


class SeenLobes(Guided):
    """Lobes of more pixels, with visibility, as an input alone."""

    needs = Needs(guides=True)

    def __init__(self, settings: NetworkSettings, frame: SceneFrame) -> None:
        super().__init__(settings, frame, transport=SeenPoints)

    def forward(self, inputs: Inputs) -> Tensor:
        """The image."""
        return super().forward(widen(self.raise_specular(inputs)))


class SmoothedDirect(Guided):
    """Direct light, of which a learned share in each pixel is the mean over 3² or 7² pixels, over diffuse albedo."""

    needs = Needs(guides=True)

    def __init__(self, settings: NetworkSettings, frame: SceneFrame) -> None:
        super().__init__(settings, frame, transport=LitPoints, further=6, outputs=5)

    def forward(self, inputs: Inputs) -> Tensor:
        """The image."""
        further, guides = self.further(inputs), require(inputs.guides)
        reflects = inputs.albedo + guides.throughput * guides.beyond_albedo + 1e-3
        wide = [smooth(guides.direct, reflects, size) for size in (3, 7)]
        known = self.known(inputs, further)
        made = self.synthesise(self.channels(inputs, [*further, *map(torch.log1p, wide)]))
        for place, light in enumerate(wide, 3):
            known = known + torch.sigmoid(made[..., place : place + 1] - 2) * (reflects * light - guides.direct)
        return known + self.factor(inputs) * made[..., :3]


if __name__ == "__main__":
    main()
