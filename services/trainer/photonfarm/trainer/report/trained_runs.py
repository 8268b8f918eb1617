"""The training runs of a report: settings, curve, waits, cost.

Baselines for their errors are the mean colour, and the network before its first step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from photonfarm.core.errors import IncompleteError
from photonfarm.store import SceneReader
from photonfarm.trainer.data.feed import Feed
from photonfarm.trainer.predictors.evaluation import (
    HeldOutErrors,
    average_colours,
    make_constant_predictor,
    make_network_predictor,
    measure,
    read_batches,
)
from photonfarm.trainer.predictors.trained import TrainedRun
from photonfarm.trainer.runs import checkpoint, run_folder
from photonfarm.trainer.runs.devices import AUTO, usable_device
from photonfarm.trainer.runs.progress import divide_by_used, find_bottleneck, share_waits
from photonfarm.trainer.runs.run_folder import CHECKPOINT, INITIAL, METRICS


@dataclass(frozen=True, slots=True)
class CurvePoint:
    """A validation of a run."""

    step: int
    draws: int  # samples drawn by then, repeats counted
    samples: int  # that had arrived, held-out ones among them
    used: int  # samples drawn at least once
    train_s: float  # wall seconds of steps
    error: float  # on held-out samples, noise removed
    held_out: int  # the number of these samples


@dataclass(frozen=True, slots=True, eq=False)
class RunStory:
    """One run, described by its checkpoint and its log."""

    name: str
    run: TrainedRun
    state: dict[str, Any]  # of the checkpoint, without weights
    curve: tuple[CurvePoint, ...]

    @classmethod
    def of(cls, name: str, run: TrainedRun) -> RunStory:
        """Read the story of a run; raises StoreError for a log that cannot be read."""
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
        return cls(name, run, kept, tuple(points))

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


@dataclass(frozen=True, slots=True, eq=False)
class Baselines:
    """Errors to compare with, in linear radiance × exposure, the targets' noise removed."""

    mean_colour: HeldOutErrors  # of the training samples, everywhere
    mean_shown_colour: HeldOutErrors  # the same of these samples with light above white cut, for `shown` alone
    untrained: HeldOutErrors  # the first run's network before its first step

    @classmethod
    def of(cls, source: SceneReader, run: TrainedRun, rows: Sequence[int]) -> Baselines:
        """Measure them on some held-out samples of a run; raises IncompleteError without samples for the colour."""
        settings = run.settings.model_copy(update={"device": "cpu"})
        with Feed(source, settings, needs=run.needs) as feed:
            arrived, _ = feed.arrivals()
            training = [row for row, held in arrived if not held]
            if not training:
                raise IncompleteError("no training sample is complete, and a report compares with their mean colour")
            some = training[:: -(-len(training) // MOST_TRAINING)]
            colour, shown_colour = average_colours(read_batches(feed, some, settings.batch))
            network = TrainedRun.load(run.folder, INITIAL).network(feed.spec, feed.base)
            return cls(
                measure(make_constant_predictor(colour), read_batches(feed, rows, settings.batch)),
                measure(make_constant_predictor(shown_colour), read_batches(feed, rows, settings.batch)),
                measure(make_network_predictor(network), read_batches(feed, rows, settings.batch)),
            )
