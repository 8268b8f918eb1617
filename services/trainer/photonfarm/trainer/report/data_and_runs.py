"""What a report is on: the data, with their cost and how to make them again, and the training runs.

A run is told by its settings, curve, waits and cost. Baselines for its errors are what its network is given, shown as
it is, the mean colour, and the network before its first step.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from photonfarm.core.errors import IncompleteError
from photonfarm.core.records import F32
from photonfarm.plan.hold_out import sides_of
from photonfarm.plan.request import UNUSED
from photonfarm.scene.spec import SceneSpec
from photonfarm.store import SceneReader, SceneStatus, Store
from photonfarm.store.model.store import scene_status
from photonfarm.trainer.networks.guided import show_known_light
from photonfarm.trainer.networks.inputs import require
from photonfarm.trainer.predictors.evaluation import (
    DevicePredictor,
    HeldOutErrors,
    Predictor,
    average_colours,
    make_constant_predictor,
)
from photonfarm.trainer.predictors.half_filter import HalfFilter, uses_denoiser
from photonfarm.trainer.predictors.trained import TrainedRun
from photonfarm.trainer.runs import checkpoint, run_folder
from photonfarm.trainer.runs.advice import Advice, advise
from photonfarm.trainer.runs.devices import AUTO, usable_device
from photonfarm.trainer.runs.progress import divide_by_used, find_bottleneck, share_waits
from photonfarm.trainer.runs.run_folder import CHECKPOINT, INITIAL, METRICS

SAMPLES = "samples"
"""The kind of plans whose rows are of new views; others add passes to these, which need no photons and no buffers."""


@dataclass(frozen=True, slots=True)
class PlanTotals:
    """The totals of the plans of one kind of request."""

    planned: int  # rows
    rows: int  # of committed jobs
    core_seconds: float  # processor time of these jobs


@dataclass(frozen=True, slots=True, eq=False)
class DatasetCard:
    """A scene of a store, described by its plans and markers."""

    spec: SceneSpec
    status: SceneStatus
    requests: tuple[dict[str, Any], ...]  # of each plan: all rows follow from them
    versions: dict[str, list[str]]  # of the packages that rendered, each with all versions
    workers: int  # the number of workers
    spent: dict[str, PlanTotals]  # by the kind of the plans' requests; without kinds that have no committed job

    @classmethod
    def of(cls, store: str | Path, scene_id: str, exposure: float) -> DatasetCard:
        """The card of one scene, exposed as its runs are; raises StoreError for one that the store does not hold."""
        scene = Store(store).scene(scene_id)
        status, plans, committed = scene_status(scene), scene.plans(), set(scene.committed_jobs())
        versions: dict[str, set[str]] = defaultdict(set)
        workers: set[str] = set()
        spent: dict[str, PlanTotals] = defaultdict(lambda: PlanTotals(0, 0, 0.0))
        for plan in plans:
            used = (plan.rows.sample_modification != UNUSED).reshape(plan.jobs, plan.shard_rows).sum(axis=1)
            totals = spent[plan.request.kind]
            planned, rows, core_seconds = totals.planned + plan.samples, totals.rows, totals.core_seconds
            for job in sorted(committed.intersection(range(plan.first_job, plan.end_job))):
                figures = scene.marker(job)["figures"]
                rows += int(used[job - plan.first_job])
                core_seconds += figures["core_s"]
                workers.add(figures["worker"])
                for package, version in figures["versions"].items():
                    versions[package].add(version)
            spent[plan.request.kind] = PlanTotals(planned, rows, core_seconds)
        return cls(
            scene.spec.model_copy(update={"exposure": exposure}),
            status,
            tuple(plan.request.model_dump(mode="json") for plan in plans),
            {package: sorted(numbers) for package, numbers in sorted(versions.items())},
            len(workers),
            {kind: totals for kind, totals in spent.items() if totals.rows},
        )

    @property
    def samples(self) -> PlanTotals:
        """The rows of new views: the samples that networks are trained on, except held-out ones."""
        return self.spent.get(SAMPLES, PlanTotals(0, 0, 0.0))

    @property
    def further_passes(self) -> PlanTotals:
        """The rows that add passes to views, such as for references."""
        others = [spent for kind, spent in self.spent.items() if kind != SAMPLES]
        return PlanTotals(*(sum(getattr(spent, name) for spent in others) for name in PlanTotals.__slots__))

    @property
    def core_s_per_sample(self) -> float:
        """The processor time of a sample of a new view, with buffers, guides and photons; 0 without one."""
        return self.samples.core_seconds / self.samples.rows if self.samples.rows else 0.0

    @property
    def source(self) -> str:
        """Where the scene's description is from."""
        return self.spec.scene.file or f"built-in {self.spec.scene.builtin}"

    @property
    def kind(self) -> str:
        """The variable parts of the scene, in words."""
        counts = {"objects": len(self.spec.objects), "lights": len(self.spec.lights)}
        movable = " and ".join(f"{count} {name}" for name, count in counts.items() if count)
        return f"dynamic: {movable} move" if movable else "static: views alone differ"

    def document(self) -> dict[str, Any]:
        """Its part of report.json."""
        spec, status = self.spec, self.status
        return {
            "scene": spec.name,
            "scene_id": spec.scene_id,
            "credits": None if spec.credits is None else spec.credits.model_dump(),
            "source": self.source,
            "kind": self.kind,
            "width": spec.film.width,
            "height": spec.film.height,
            "exposure": spec.exposure,
            "free_space": spec.view.free_space is not None,
            "points": spec.points,
            "transport": spec.transport.model_dump(),
            "photons": spec.photons.model_dump(),
            "guides": spec.guides.model_dump(),
            "spp_per_sample": 2 * spec.transport.half_spp,
            "samples_planned": status.samples_planned,
            "samples_complete": status.samples_complete,
            "requests": list(self.requests),
            "bytes": status.size_bytes,
            "core_seconds": status.core_s,
            "spent": {kind: asdict(spent) for kind, spent in self.spent.items()},
            "core_seconds_per_sample": self.core_s_per_sample,
            "redrawn": status.redrawn,
            "workers": self.workers,
            "versions": self.versions,
        }


@dataclass(frozen=True, slots=True)
class CurvePoint:
    """A validation of a run."""

    step: int
    draws: int  # samples drawn by then, repeats counted
    samples: int  # that had arrived, held-out ones among them
    used: int  # samples drawn at least once
    train_s: float  # wall seconds of steps
    error: float  # on held-out samples, noise removed
    held_out: int  # the number of their views, of which each is measured by one


@dataclass(frozen=True, slots=True, eq=False)
class RunStory:
    """One run, described by its checkpoint and its log."""

    name: str
    run: TrainedRun
    state: dict[str, Any]  # of the checkpoint, without weights
    curve: tuple[CurvePoint, ...]
    advice: Advice | None  # what is worth its seconds next

    @classmethod
    def of(cls, name: str, run: TrainedRun, images_s: float | None = None) -> RunStory:
        """Read the story of a run, whose samples took `images_s` core-seconds; StoreError for an unreadable log."""
        records = run_folder.read_log(run.folder / METRICS)
        state = checkpoint.load(run.folder / CHECKPOINT)
        arrived, held_out = (state["following"][rows].numpy() for rows in ("arrived", "held_out"))
        training = np.concatenate([[0], np.cumsum(~np.isin(arrived, held_out))])  # of the first n that arrived
        points = (
            CurvePoint(
                r["step"],
                r["draws"],
                r["samples"],
                min(r["draws"], int(training[min(r["samples"], len(arrived))])),
                r["seconds"]["train"],
                r["error"],
                r["held_out"],
            )
            for r in records
            if r["kind"] == "validation"
        )
        kept = {key: state[key] for key in ("step", "following", "seconds", "versions")}
        return cls(name, run, kept, tuple(points), advise(records, images_s))

    @property
    def trained_on(self) -> int:
        """The number of samples to draw from: those that have arrived and are not held out."""
        return len(self.state["following"]["sampler"]["rows"])

    @property
    def on_gpu(self) -> bool:
        """Whether its steps ran on a GPU: by its settings and, if these are "auto", by this machine."""
        device = self.run.settings.device
        return (str(usable_device(device)) if device == AUTO else device).startswith("cuda")

    def step_core_s(self, point: CurvePoint) -> float:
        """The core-seconds of the steps up to a point; on a GPU their wall seconds."""
        return point.train_s * (1 if self.on_gpu else self.run.settings.threads)

    def document(self) -> dict[str, Any]:
        """Its part of report.json."""
        state, settings = self.state, self.run.settings
        draws = state["step"] * settings.batch
        shares = share_waits(state["seconds"], {})
        return {
            "name": self.name,
            "folder": str(self.run.folder),
            "architecture": settings.network.architecture,
            "parameters": sum(weight.numel() for weight in self.run.weights.values()),
            "steps": state["step"],
            "draws": draws,
            "trained_on": self.trained_on,
            "draws_per_sample": draws / max(self.trained_on, 1),
            "samples_per_used": divide_by_used(self.trained_on, draws),
            "seconds": state["seconds"],
            "waits": shares,
            "bottleneck": find_bottleneck(shares),
            "advice": self.advice and asdict(self.advice),
            "curve": [asdict(point) for point in self.curve],
            "on_gpu": self.on_gpu,
            "settings": settings.model_dump(mode="json"),
            "versions": state["versions"],
        }


def shorten_names(runs: list[TrainedRun]) -> list[str]:
    """The name of each run in a report: its architecture, or its folder if that adds something."""
    for names in ([run.settings.network.architecture for run in runs], [run.folder.name for run in runs]):
        if len(set(names)) == len(runs):
            return [*names]
    return [str(run.folder) for run in runs]


MOST_TRAINING = 1024  # samples to take the mean colour of

COLOUR = "the mean colour of the training samples"

NOTHING = "the mean colour"
LIGHT = "the lamps and direct light that it is given"
HALF = "the denoised half that it is given"
"""What a network is given that is an image, beside which its error stands; of nothing one colour is the best."""


@dataclass(frozen=True, slots=True, eq=False)
class Baselines:
    """Errors to compare with, in linear radiance × exposure, the targets' noise removed."""

    than: str  # what `given` is of: NOTHING, LIGHT or HALF
    mean_colour: HeldOutErrors  # of the training samples, everywhere
    mean_shown_colour: HeldOutErrors  # the same of these samples with light above white cut, for `shown` alone
    untrained: HeldOutErrors  # the first run's network before its first step
    given: HeldOutErrors  # what that is given, shown as it is: training's own share is what is below this


def name_given(run: TrainedRun) -> str:
    """What a run's network is given that is an image: HALF, LIGHT or NOTHING."""
    return HALF if uses_denoiser(run.settings) else LIGHT if run.needs.guides else NOTHING


def show_given(run: TrainedRun, device: str) -> DevicePredictor | None:
    """A predictor that shows what a run's network is given as it is; None for NOTHING."""
    place, given = usable_device(device), name_given(run)
    if given == HALF:
        filtered = HalfFilter(run.settings, place)
        return DevicePredictor(lambda inputs: require(require(filtered(inputs).noisy).filtered), place)
    return DevicePredictor(show_known_light, place) if given == LIGHT else None


def make_baselines(
    source: SceneReader, run: TrainedRun, device: str, tell: Callable[[str, int, int], object] = lambda *_: None
) -> list[Predictor]:
    """The predictors of the errors of `Baselines`, in its order, from what is complete of a run's scene.

    Of the samples the radiance alone is read. Raises IncompleteError without training samples for the colour.
    """
    complete = source.rows.tolist()
    sides = sides_of(source, complete, run.settings.hold_out)
    training = [row for row, side in zip(complete, sides, strict=True) if side == "train"]
    if not training:
        raise IncompleteError("no training sample is complete, and a report compares with their mean colour")
    some = training[:: -(-len(training) // MOST_TRAINING)]

    def read() -> Iterator[F32]:
        for done, row in enumerate(some, start=1):
            yield source.read_radiance(row) * np.float32(source.spec.exposure)
            tell(COLOUR, done, len(some))

    colours = average_colours(read())
    untrained = TrainedRun.load(run.folder, INITIAL).predictor(source.spec, source.base(), device)
    mean, shown_mean = map(make_constant_predictor, colours)
    return [mean, shown_mean, untrained, show_given(run, device) or mean]
