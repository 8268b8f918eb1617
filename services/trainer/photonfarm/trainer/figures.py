"""What a run is reported by: errors of its networks on what is held out, and what its samples cost."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from photonfarm.shared.errors import IncompleteError, StoreError
from photonfarm.shared.records import F32
from photonfarm.shared.store import SceneStatus, Store, store_status
from photonfarm.trainer import checkpoint, metrics_log
from photonfarm.trainer.dataset import SampleSource
from photonfarm.trainer.evaluation import (
    HeldOut,
    batches,
    constant_predictor,
    mean_colour,
    measure,
    network_predictor,
)
from photonfarm.trainer.feed import Feed
from photonfarm.trainer.loop import CHECKPOINT, INITIAL, METRICS
from photonfarm.trainer.networks.network import Network
from photonfarm.trainer.settings import MOST_HELD_OUT, TrainSettings
from photonfarm.trainer.trained import TrainedRun
from photonfarm.trainer.waits import bottleneck, samples_per_used, waits

MOST_TRAINING = 1024  # samples to take the mean colour of
SHOWN = 6  # samples shown as pictures


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """A held-out sample beside its prediction; all (H, W, 3), linear radiance × exposure but albedo."""

    row: int
    target: F32  # mean of A and B, noisy
    prediction: F32
    albedo: F32
    error: float  # noise removed


@dataclass(frozen=True, slots=True, eq=False)
class RunFigures:
    """The networks of a run on the same held-out samples."""

    first: HeldOut  # the network before its first step
    last: HeldOut  # the network of the last checkpoint
    mean_colour: HeldOut  # the mean colour of the training samples everywhere
    shown: list[Shown]
    parameters: int


def run_figures(source: SampleSource, settings: TrainSettings, run: Path) -> RunFigures:
    """Evaluate a run on the first `MOST_HELD_OUT` held-out samples, on the CPU wherever it was trained.

    Raises IncompleteError if nothing is held out, StoreError without checkpoints.
    """
    torch.set_num_threads(settings.threads)
    with Feed(source, settings.model_copy(update={"device": "cpu"})) as feed:
        arrived, _ = feed.arrivals()
        held_out = [row for row, held in arrived if held][:MOST_HELD_OUT]
        training = [row for row, held in arrived if not held]
        training = training[:: -(-len(training) // MOST_TRAINING) or 1]
        if not held_out or not training:
            raise IncompleteError(
                f"{len(training)} training and {len(held_out)} held-out samples are complete; a report needs both"
            )
        base = feed.geometry, feed.cloud
        first, last = (TrainedRun.load(run, name).network(feed.spec, base) for name in (INITIAL, CHECKPOINT))
        colour = mean_colour(batches(feed, training, settings.batch))

        def error(network: Network) -> HeldOut:
            return measure(network_predictor(network), batches(feed, held_out, settings.batch))

        return RunFigures(
            first=error(first),
            last=(last_error := error(last)),
            mean_colour=measure(constant_predictor(colour), batches(feed, held_out, settings.batch)),
            shown=_shown(feed, last, held_out[:SHOWN], last_error, settings.batch),
            parameters=sum(p.numel() for p in last.parameters()),
        )


def _shown(feed: Feed, network: Network, rows: list[int], errors: HeldOut, size: int) -> list[Shown]:
    predict = network_predictor(network)
    found: list[Shown] = []
    for batch in batches(feed, rows, size):
        images, target = predict(batch), batch.target.mean(dim=1).numpy()
        for place, row in enumerate(batch.rows):
            albedo = batch.inputs.albedo[place].numpy().copy()
            found.append(Shown(row, target[place], images[place], albedo, float(errors.per_sample[len(found)])))
    return found


def production(store: str | Path, scene_id: str) -> SceneStatus:
    """What the store says of a scene: samples planned and complete, and the processor time they took."""
    for status in store_status(Store(store)):
        if status.scene_id == scene_id:
            return status
    raise StoreError(f"{store}: holds no scene {scene_id}")


def summary(settings: TrainSettings, run: Path, found: RunFigures, status: SceneStatus) -> dict[str, Any]:
    """The figures of report.json."""
    state = checkpoint.load(run / CHECKPOINT)
    following = state["following"]
    return {
        "scene": status.name,
        "scene_id": status.scene_id,
        "samples_planned": status.samples_planned,
        "samples_committed": status.samples_complete,
        "samples_held_out": len(found.last.per_sample),
        "configurations_held_out": found.last.error.count,
        "samples_per_core_second": status.samples_complete / status.core_s if status.core_s > 0 else None,
        "render_core_seconds": status.core_s,
        "renders_redrawn": status.redrawn,
        "train_steps": state["step"],
        "draws": (draws := state["step"] * settings.batch),
        "draws_per_sample": draws / max(len(following["sampler"]["rows"]), 1),
        "samples_per_used": samples_per_used(len(following["arrived"]), draws),
        "val_error_first": found.first.error.mean,
        "val_error_last": found.last.error.mean,
        "val_error_last_standard_error": found.last.error.standard_error,
        "val_error_mean_colour": found.mean_colour.error.mean,
        "noise_floor": found.last.floor,
        "parameters": found.parameters,
        "seeds": {"training": settings.seed},
        "seconds": state["seconds"],
        "waits": (shares := waits(state["seconds"])),
        "bottleneck": bottleneck(shares),
        "settings": settings.model_dump(mode="json"),
        "versions": checkpoint.versions(),
    }


def validations(run: Path) -> list[dict[str, Any]]:
    """The validation records of a run's log."""
    return [record for record in metrics_log.read(run / METRICS) if record["kind"] == "validation"]
