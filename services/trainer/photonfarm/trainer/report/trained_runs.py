"""What each training run of a report did: settings, curve, waits, cost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from photonfarm.trainer import checkpoint, metrics_log
from photonfarm.trainer.loop import CHECKPOINT, METRICS
from photonfarm.trainer.trained import TrainedRun
from photonfarm.trainer.waits import bottleneck, samples_per_used, waits


@dataclass(frozen=True, slots=True)
class Point:
    """A validation on the way."""

    step: int
    draws: int  # samples drawn by then
    samples: int  # that had arrived
    train_s: float  # wall seconds of steps
    error: float  # on held-out samples, noise removed

    def core_s(self, per_sample: float) -> float:
        """Of rendering the samples that had been used by then, where each took `per_sample`."""
        return min(self.draws, self.samples) * per_sample


@dataclass(frozen=True, slots=True, eq=False)
class RunStory:
    """One run as its checkpoint and its log tell it."""

    name: str
    run: TrainedRun
    state: dict[str, Any]  # of the checkpoint: step, following and seconds
    curve: tuple[Point, ...]

    @classmethod
    def of(cls, name: str, run: TrainedRun) -> RunStory:
        """Of a run; raises StoreError for a log that cannot be read."""
        records = metrics_log.read(run.folder / METRICS)
        points = (
            Point(r["step"], r["draws"], r["samples"], r["seconds"]["train"], r["error"])
            for r in records
            if r["kind"] == "validation"
        )
        state = checkpoint.load(run.folder / CHECKPOINT)
        return cls(name, run, {key: state[key] for key in ("step", "following", "seconds")}, tuple(points))

    def document(self) -> dict[str, Any]:
        """What report.json says of it."""
        state, settings = self.state, self.run.settings
        arrived = len(state["following"]["arrived"])
        draws = state["step"] * settings.batch
        shares = waits(state["seconds"])
        return {
            "name": self.name,
            "folder": str(self.run.folder),
            "architecture": settings.network.architecture,
            "parameters": sum(weight.numel() for weight in self.run.weights.values()),
            "steps": state["step"],
            "draws": draws,
            "draws_per_sample": draws / max(len(state["following"]["sampler"]["rows"]), 1),
            "samples_per_used": samples_per_used(arrived, draws),
            "seconds": state["seconds"],
            "waits": shares,
            "bottleneck": bottleneck(shares),
            "curve": [
                {"step": p.step, "draws": p.draws, "samples": p.samples, "train_s": p.train_s, "error": p.error}
                for p in self.curve
            ],
            "settings": settings.model_dump(mode="json"),
            "versions": checkpoint.versions(),
        }


def short_names(runs: list[TrainedRun]) -> list[str]:
    """What each is called in a report: by its architecture, or its folder where that says more."""
    for names in ([run.settings.network.architecture for run in runs], [run.folder.name for run in runs]):
        if len(set(names)) == len(runs):
            return [*names]
    return [str(run.folder) for run in runs]
