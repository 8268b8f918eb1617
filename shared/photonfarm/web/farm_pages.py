"""What the pages say of a farm: its progress, its trainings and its samples, as JSON documents and files."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from photonfarm.farm.status import NoQueue
from photonfarm.farm.training import VIEWS, RunFolder
from photonfarm.farm.watch import FarmView, FarmWatch
from photonfarm.store import Store
from photonfarm.store.model.plans import plan_of
from photonfarm.web.images import Cached
from photonfarm.web.samples import SceneSamples
from photonfarm.web.server import NotThereError

CURVE_POINTS = 300
"""The most points of a curve."""

STEP = re.compile(r"step-([0-9]{8})\.png")


class FarmPages:
    """A store, its queue and its trainings, for the pages."""

    def __init__(self, place: str | Path, watch: FarmWatch) -> None:
        """Take the store's place, and how the farm is looked at."""
        self._place, self._watch = place, watch
        self._store = Store(place)
        self._view: Cached[FarmView] = Cached(watch.look)
        self._samples: dict[str, SceneSamples] = {}
        self._walls: dict[str, Cached[list[int]]] = {}
        self._lock = threading.Lock()

    def view(self) -> FarmView:
        """The farm as it was looked at last, seconds ago."""
        return self._view.get()

    def state(self) -> dict[str, Any]:
        """How far the farm is."""
        view = self._view.get()
        queue = None if isinstance(view.queue, NoQueue) else view.queue.status
        return {
            "store": self._store.storage.where,
            "up": view.running is not None,
            "scenes": [asdict(scene) | {"missing": scene.missing} for scene in view.scenes],
            "queue": queue and {"queued": queue.queued, "running": queue.running, "workers": queue.workers},
            "workers": [{"name": name, **asdict(each)} for name, each in sorted(view.activities.items())],
            "waits": [str(wait) for wait in view.waits],
            "failed_before": [{"cause": cause.cause, "jobs": len(cause.jobs)} for cause in view.queue.kept],
            "trainings": [asdict(training) | {"figures": training.figures} for training in view.trainings],
        }

    # --------------------------------------------------------------------------------------------------------- samples

    def samples(self, scene_id: str) -> SceneSamples:
        """The samples of a scene; raises NotThereError for one that is not in the store."""
        with self._lock:
            if scene_id not in self._samples:
                if scene_id not in self._store.scene_ids():
                    raise NotThereError(f"the store has no scene {scene_id}")
                self._samples[scene_id] = samples = SceneSamples(self._place, scene_id)
                self._walls[scene_id] = Cached(samples.look)
            return self._samples[scene_id]

    def wall(self, scene_id: str) -> dict[str, Any]:
        """The samples that landed last, and the maps of noise and cost."""
        samples = self.samples(scene_id)
        rows = self._walls[scene_id].get()
        return {"rows": rows, "map": samples.map_noise(self._cost_of(scene_id))}

    def about(self, scene_id: str, row: int) -> dict[str, Any]:
        """One sample in figures."""
        return self.samples(scene_id).about(row) | {"core_s": self._cost_of(scene_id)(row)}

    def _cost_of(self, scene_id: str) -> Callable[[int], float | None]:
        """A function that gives the core-seconds of a sample in a row: its share of its job's."""
        self._view.get()
        costs, plans = self._watch.costs(scene_id), self._store.scene(scene_id).plans()

        def cost(row: int) -> float | None:
            job = row // plans[0].shard_rows
            return costs[job] / plan_of(plans, row).samples_in(job) if job in costs else None

        return cost

    # ------------------------------------------------------------------------------------------------------------ runs

    def curves(self) -> list[dict[str, Any]]:
        """The curves of all runs: held-out error and loss by step and by seconds."""
        self._view.get()
        return [_read_curves(run) for run in self._watch.runs]

    def prediction(self, run: int, step: int) -> bytes:
        """The picture of a run's predictions at a validation; raises NotThereError."""
        runs = self._watch.runs
        if run >= len(runs):
            raise NotThereError(f"there is no run {run}")
        try:
            return (runs[run].folder / VIEWS / f"step-{step:08d}.png").read_bytes()
        except OSError as error:
            raise NotThereError(f"run {run} has no picture of step {step}") from error


def _read_curves(run: RunFolder) -> dict[str, Any]:
    records, steps = list(run.records), _list_steps(run.folder)  # a copy, as another thread may add some
    validations = [
        [r["step"], _sum_seconds(r), r["error"], r["standard_error"], r["samples"], r["held_out"]]
        for r in records
        if r.get("kind") == "validation"
    ]
    trained = [r for r in records if r.get("kind") == "train" and isinstance(r.get("loss"), float)]
    losses = [[r["step"], _sum_seconds(r), r["loss"]] for r in trained]
    return {
        "run": run.folder.name,
        "validations": _thin_out(validations),
        "losses": _thin_out(losses),
        "steps": steps,
        **_read_shown(run.folder, steps),
    }


def _list_steps(folder: Path) -> list[int]:
    """The validations of a run that have pictures."""
    try:
        names = [file.name for file in (folder / VIEWS).iterdir()]
    except OSError:
        return []
    return sorted(int(match[1]) for name in names if (match := STEP.fullmatch(name)))


def _read_shown(folder: Path, steps: list[int]) -> dict[str, Any]:
    """The scene and the rows that a run's pictures show, as the last of them says."""
    from PIL import Image

    try:
        with Image.open(folder / VIEWS / f"step-{steps[-1]:08d}.png") as picture:
            text = picture.text
        return {"scene_id": str(text["scene"]), "rows": [int(row) for row in text["rows"].split()]}
    except (OSError, IndexError, AttributeError, KeyError, ValueError):
        return {"scene_id": None, "rows": []}


def _sum_seconds(record: dict[str, Any]) -> float:
    """How long a run had been at it when it wrote a record."""
    return float(sum(record.get("seconds", {}).values()))


def _thin_out(points: list[list[Any]]) -> list[list[Any]]:
    """Evenly spaced points, at most CURVE_POINTS, with the first and the last one."""
    if len(points) <= CURVE_POINTS:
        return points
    return [points[i * (len(points) - 1) // (CURVE_POINTS - 1)] for i in range(CURVE_POINTS)]
