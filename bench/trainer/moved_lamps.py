"""How much of what moved lamps change in an image networks explain, beside the light of the guides.

    python -m bench.trainer.moved_lamps [--rooms NAME …] [--views 16] [--half-spp 64] [--work DIR] [--out DIR]

Takes experiments that have run (`make experiments-small`), renders a view of each of some held-out configurations as it
is, and again with the lamps as in another random configuration, and has every trained network predict both: nothing is
trained. Denoisers are left out, as they are given an image of that same view. PHOTONFARM_SCENES names the folder of the
rooms' scene files. Exit code 0, whatever comes out; 2 for a room that has not run, or without a lamp that moves.

Shape letters: G movable groups, H W image, N views, S seeds.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray

from bench.harness import results, room_study
from bench.harness.network_errors import F64, Errors
from bench.harness.scenes import in_passes
from bench.trainer.explained import Change, Explained
from bench.trainer.moved_lamps_page import KNOWN, ExplainedChange, LampStudy, document, page, stated
from photonfarm.core.errors import IncompleteError, PhotonfarmError, SpecError
from photonfarm.core.keys import Key, seed_of, view_key
from photonfarm.core.records import F32, BasePointCloud, Geometry, ViewBuffers
from photonfarm.data.torch_dataset import SampleTensors
from photonfarm.plan.hold_out import units_of
from photonfarm.renderer.jobs.path_buffers import frames_of
from photonfarm.renderer.jobs.render import SceneRenderer, load_scene, located
from photonfarm.scene.files import BUILTIN_EMITTING, SceneFile
from photonfarm.scene.modification import Modification, sample_modification
from photonfarm.scene.spec import Light, Movable, SceneSpec, shape_ids
from photonfarm.scene.spec_loading import find_scene, load_spec
from photonfarm.scene.view import View
from photonfarm.store import Sample, SceneReader, Store
from photonfarm.trainer.compare.evaluation_samples import HeldOutSamples
from photonfarm.trainer.data.batch import TrainingBatch
from photonfarm.trainer.metrics import metric_space
from photonfarm.trainer.networks import ARCHITECTURES
from photonfarm.trainer.networks.inputs import Needs, require
from photonfarm.trainer.predict.evaluation import Predictor
from photonfarm.trainer.predict.trained import TrainedRun
from photonfarm.trainer.runs import checkpoint
from photonfarm.trainer.runs.run_folder import CHECKPOINT

Base = tuple[Geometry, BasePointCloud]

NAME = "moved_lamps"
SEED = 1
"""The master seed of the lamps' other places. Experiments are planned with seed 0, so no sample shows these places."""

SAME_DEPTH = 1e-3  # relative difference up to which points with one normal lie on the same surface
SAME_ALBEDO = 1e-3  # difference up to which two albedos are the same


# -------------------------------------------------------------------------------------------------------------- lamps


def lamps(spec: SceneSpec) -> NDArray[np.bool_]:
    """The movable groups that shine, (G,): all lights, and objects that take a light along."""
    emitting = _emitting(spec)
    return np.array([_shines(group, emitting, spec) for group in spec.groups], np.bool_)


def _emitting(spec: SceneSpec) -> frozenset[str]:
    if spec.scene.builtin is not None:
        return BUILTIN_EMITTING[spec.scene.builtin]
    return SceneFile.read(find_scene(str(spec.scene.file), spec.name)).emitting


def _shines(group: Movable, emitting: frozenset[str], spec: SceneSpec) -> bool:
    if isinstance(group, Light):
        return True
    return any(spec.emitters.factor(shape) > 0 for shape in emitting.intersection(shape_ids(group)))


def relit(modification: Modification, other: Modification, shines: NDArray[np.bool_]) -> Modification:
    """The configuration with the lamps of the other; `shines` as `lamps` gives it."""
    return Modification.from_vector(np.where(shines[:, None], other.vector, modification.vector))


def stays(a: ViewBuffers, b: ViewBuffers) -> NDArray[np.bool_]:
    """The pixels that show the same surface in both views, (H, W), over their whole area: so albedo is compared too."""
    depth = np.abs(a.depth - b.depth) <= SAME_DEPTH * np.maximum(a.depth, b.depth)
    normal = np.abs(a.normal - b.normal).max(axis=-1) < SAME_DEPTH
    albedo = np.abs(a.albedo - b.albedo).max(axis=-1) < SAME_ALBEDO
    same: NDArray[np.bool_] = depth & normal & albedo & (a.depth > 0)
    return same


# -------------------------------------------------------------------------------------------------------------- views


@dataclass(frozen=True, slots=True, eq=False)
class PredictorGroup:
    """What predicts images: networks that differ in their seeds alone, or the light of the guides without a network."""

    name: str
    seeds: tuple[int, ...]  # none where nothing is learned
    predictors: tuple[Predictor, ...]  # of each seed
    needs: Needs
    points: int | None = None  # first points of the base cloud that it is given; None: all


@dataclass(frozen=True, eq=False)
class Views:
    """N views of a room, each rendered as it is and with its lamps moved."""

    spec: SceneSpec
    base: Base
    pairs: tuple[tuple[Sample, Sample], ...]
    units: tuple[Key, ...]  # the configuration of each

    @cached_property
    def change(self) -> Change:
        """What the lamps change."""
        radiance = np.array([[look.radiance for look in pair] for pair in self.pairs])  # (N, 2, 2, H, W, 3)
        shown = _shown(np.float32(self.spec.exposure) * radiance)
        same = [stays(first.buffers, second.buffers) for first, second in self.pairs]
        return Change(shown[:, 1] - shown[:, 0], np.stack(same), self.units)

    def predicted(self, predict: Predictor, candidate: PredictorGroup) -> F64:
        """What a predictor says that the lamps change, (N, H, W, 3) in the metric space."""
        tensors = SampleTensors(self.spec, candidate.needs.fields, exposure=self.spec.exposure, points=candidate.points)
        memory = tensors.empty(1)

        def filled(look: Sample) -> TrainingBatch:
            tensors.fill(memory, 0, look)
            return TrainingBatch.of((0,), (b"",), memory)

        made = [[predict(filled(look))[0].copy() for look in pair] for pair in self.pairs]
        shown = _shown(np.array(made, np.float32))
        return shown[:, 1] - shown[:, 0]

    def row(self, candidate: PredictorGroup) -> ExplainedChange:
        """How much of the change a candidate explains."""
        left = np.stack([self.change.left(self.predicted(each, candidate)) for each in candidate.predictors], axis=1)
        there = self.change.there()
        parts = (Explained(Errors(of, self.units), all_) for of, all_ in zip(left, there, strict=True))
        return ExplainedChange(candidate.name, candidate.seeds, *parts)


def _shown(exposed: F32) -> F64:
    """Images (…, H, W, 3) of exposed radiance in the metric space."""
    shape = exposed.shape
    images: F64 = metric_space(exposed.reshape(-1, *shape[-3:])).double().numpy().reshape(shape)
    return images


# ---------------------------------------------------------------------------------------------------------- measuring


def known_light(batch: TrainingBatch) -> F32:
    """Emission, direct light and gloss of a batch's guides: an image of which nothing is learned."""
    guides = require(batch.inputs.guides)
    light: F32 = (guides.emission + guides.direct + guides.gloss).numpy()
    return light


def rooms_that_ran(work: Path) -> list[str]:
    """The experiments in a folder that have lamps that move and have run, in the order of their names."""
    ran = {file.parents[2] for file in work.glob(f"*/runs/*/{CHECKPOINT}")}
    return sorted(folder.name for folder in ran if lamps(load_spec(folder / "spec.json")).any())


def trained_runs(folder: Path) -> list[list[TrainedRun]]:
    """The networks of an experiment, those together that differ in their seeds alone.

    Without denoisers and without what is not trained to its end. Raises IncompleteError where there are none, and
    SpecError where they are of several scenes.
    """
    alike: dict[Any, list[TrainedRun]] = {}
    for file in sorted((folder / "runs").glob(f"*/{CHECKPOINT}")):
        run = TrainedRun.load(file.parent)
        if run.needs.kept:
            continue
        if checkpoint.load(file)["step"] < run.settings.max_steps:
            room_study.tell(f"{run.folder}: is not trained to its end, and left out")
            continue
        alike.setdefault(run.settings.model_copy(update={"seed": 0}), []).append(run)
    if not alike:
        raise IncompleteError(f"{folder}: holds no trained network; `python experiments/run.py` trains them")
    if len(scenes := {run.scene_id for runs in alike.values() for run in runs}) > 1:
        raise SpecError(f"{folder}/runs: are of the scenes {', '.join(sorted(scenes))}; one is needed")
    order = list(ARCHITECTURES)
    groups = [sorted(runs, key=lambda run: run.settings.seed) for runs in alike.values()]
    return sorted(groups, key=lambda runs: (order.index(runs[0].settings.network.architecture), runs[0].folder.name))


def candidate_of(runs: Sequence[TrainedRun], spec: SceneSpec, base: Base) -> PredictorGroup:
    """Networks that differ in their seeds alone; named as the first's folder, without its seed."""
    first, seeds = runs[0], tuple(run.settings.seed for run in runs)
    predictors = tuple(run.predictor(spec, base, "cpu") for run in runs)
    name = first.folder.name.removesuffix(f"-{first.settings.seed}")
    return PredictorGroup(name, seeds, predictors, first.needs, first.settings.network.points)


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """A room that can be rendered, with what does not change from view to view."""

    spec: SceneSpec
    base: Base
    scene: SceneRenderer  # with as many samples per pixel in a half as a reference has

    @classmethod
    def of(cls, store: Store, scene_id: str, half_spp: int) -> Self:
        """A scene of a store."""
        stored = store.scene(scene_id)
        spec = located(stored.spec)
        return cls(spec, stored.base(), load_scene(in_passes(spec, half_spp)))

    def look(self, modification: Modification, view: View) -> Sample:
        """Render a view as a sample with the reference's halves, and with what `photonfarm infer` gives a network.

        The seeds of the halves are of this benchmark alone, so that no guide and no sample has their noise.
        """
        frames = frames_of(self.spec, modification, [view], self.base[1], lambda _: self.scene)
        key = view_key(modification.key(self.spec.radiance_id), view.vector)
        halves = self.scene.render_halves(view, [seed_of(key, f"{NAME}, half {half}") for half in "AB"])
        known = frames.buffers(0), frames.visibility(0), frames.guides_of(0)
        shared = (lambda: self.base[1]), (lambda: require(frames.photons))
        return Sample(0, b"", modification, view, 0, halves, *known, 1.0, *shared)

    def views(self, source: SceneReader, rows: Sequence[int]) -> Views:
        """The views of some samples, rendered anew."""
        shines, pairs = lamps(self.spec), []
        for index, row in enumerate(rows):
            sample = source.read(row)
            moved = relit(sample.modification, sample_modification(self.spec, SEED, index), shines)
            pairs.append((self.look(sample.modification, sample.view), self.look(moved, sample.view)))
        return Views(self.spec, self.base, tuple(pairs), tuple(units_of(source, rows)))


def held_out(source: SceneReader, share: float, views: int) -> list[int]:
    """The first sample of each of so many held-out configurations; IncompleteError where they are fewer than two."""
    rows = HeldOutSamples.of(source, share, sys.maxsize).rows
    first = dict(zip(reversed(units_of(source, rows)), reversed(rows), strict=True))
    if len(found := sorted(first.values())[:views]) < 2:
        raise IncompleteError(f"{len(found)} held-out configuration: an interval needs two; plan more, or look at more")
    return found


def measured(name: str, arguments: argparse.Namespace) -> LampStudy:
    """An experiment's networks on views whose lamps move. Raises PhotonfarmError where that cannot be."""
    folder = arguments.work / name
    runs = trained_runs(folder)
    store, scene_id = Store(folder / "store"), runs[0][0].scene_id
    source = SceneReader(store.root, scene_id)
    share = min(run.settings.hold_out for group in runs for run in group)  # shares are nested: no run has seen these
    rows = held_out(source, share, arguments.views)
    stage = Stage.of(store, scene_id, arguments.half_spp)
    if not lamps(stage.spec).any():
        raise SpecError(f"{name}: none of its movable groups shines, and this is about lamps that move")
    candidates = [candidate_of(group, stage.spec, stage.base) for group in runs]
    if stage.spec.guides.light_samples:
        candidates.insert(0, PredictorGroup(KNOWN, (), (known_light,), Needs(points=False, guides=True)))
    views = stage.views(source, rows)
    found = tuple(views.row(candidate) for candidate in candidates)
    for row in found:
        room_study.tell(f"{name}: {row.name} {stated(row.whole)}, on surfaces that stay {stated(row.stays)}")
    named = (group.name for group, shines in zip(stage.spec.groups, lamps(stage.spec), strict=True) if shines)
    return LampStudy(name, tuple(named), views.change, found)


def options() -> argparse.ArgumentParser:
    """The options of the command line."""
    parser = results.parser(__doc__)
    parser.add_argument("--rooms", nargs="+", help="experiments that have run (all whose lamps move)")
    parser.add_argument("--views", type=int, default=16, help="held-out configurations, at most (%(default)s)")
    parser.add_argument("--half-spp", type=int, default=64, help="samples per pixel of a half (%(default)s)")
    where = results.ROOT / "build/experiments/small"
    parser.add_argument("--work", type=Path, default=where, help="where they have run (build/experiments/small)")
    return parser


def main() -> int:
    """Run the benchmark; returns the exit code."""
    parser = options()
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    try:
        names = arguments.rooms or rooms_that_ran(arguments.work)
        for name in names:
            trained_runs(arguments.work / name)  # what is wrong should be said before hours go by
        rooms = [measured(name, arguments) for name in names]
    except PhotonfarmError as error:
        parser.error(str(error))
    if not rooms:
        parser.error(f"{arguments.work}: no experiment whose lamps move has run; `python experiments/run.py` runs them")
    figures = {"views": arguments.views, "half_spp": arguments.half_spp, "rooms": document(rooms)}
    results.write(NAME, page(rooms, arguments.half_spp), figures, arguments.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
