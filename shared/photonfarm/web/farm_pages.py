"""What the pages say of a farm: its progress, its trainings and its samples, as JSON documents and files."""

from __future__ import annotations

import re
import shlex
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from photonfarm.core import pictures
from photonfarm.core.errors import IncompleteError
from photonfarm.core.records import F32
from photonfarm.farm.progress import FarmProgress, describe_failed
from photonfarm.farm.training import VIEWS, RunFolder
from photonfarm.farm.watch import FarmWatch
from photonfarm.plan.sample_costs import relative_variance
from photonfarm.store import Sample, SceneReader, Store
from photonfarm.store.model.plans import plan_of
from photonfarm.web import images
from photonfarm.web.images import Cached
from photonfarm.web.server import NotThereError

WALL = 24
"""The samples on the wall of those that landed last."""

AT_ONCE = 8
"""The most samples that a look adds to the wall: a fast farm makes more than anybody can see."""

MAPPED = 400
"""The most samples on the maps of noise and cost."""

OPENED = 4
"""The opened samples that are kept in memory."""

MOST_PASSES = 64
"""The most passes that a reference is merged from here."""


class SceneSamples:
    """The complete samples of one scene. Its methods may be called from several threads."""

    def __init__(self, place: str | Path, scene_id: str) -> None:
        """Take the store's place; nothing is read yet."""
        self._place, self._scene_id = place, scene_id
        self._lock = threading.RLock()
        self._reader = SceneReader(place, scene_id)
        self._wall: deque[int] = deque(maxlen=WALL)
        self._noise: dict[int, float] = {}  # by row, of those whose pictures were made
        self._opened = lru_cache(OPENED)(lambda row: self._reader.read(row, guides=True))

    def look(self) -> list[int]:
        """Look for new samples; returns the rows on the wall, the latest first."""
        with self._lock:
            try:
                new = self._reader.refresh()
            except IncompleteError:  # the scene was forgotten, and is another one now
                self._reader, new = SceneReader(self._place, self._scene_id), np.zeros(0, np.int64)
                self._noise.clear()
                self._opened.cache_clear()
            kept = [row for row in self._wall if self._is_complete(row)]
            at_once = AT_ONCE if kept else WALL
            if len(new) > at_once:
                new = new[np.linspace(0, len(new) - 1, at_once).astype(np.int64)]
            self._wall = deque([*kept, *new.tolist()], maxlen=WALL)
            rows = self._reader.rows
            spread = rows[np.linspace(0, len(rows) - 1, min(len(rows), MAPPED)).astype(np.int64)]
            for row in [row for row in spread.tolist() if row not in self._noise][:AT_ONCE]:
                self._measure_noise(self._reader.read(row))  # a few more each time, until the maps are full
            return list(reversed(self._wall))

    def thumbnail(self, row: int) -> bytes:
        """The mean of A and B as a JPEG, at the spec's exposure; its noise is noted for the map."""
        self._check(row)
        sample = self._reader.read(row)
        self._measure_noise(sample)
        return images.encode(pictures.display(sample.radiance.mean(axis=0), self._reader.spec.exposure), "JPEG")

    def picture(self, row: int, name: str) -> bytes:
        """A picture of a sample as a PNG: a, b, mean, noise, reference, or a buffer or guide by its name."""
        exposure = self._reader.spec.exposure
        if name == "reference":  # one pass at a time in memory
            rows = self._list_passes(row)
            total = sum(self._reader.read(each).radiance.mean(axis=0, dtype=np.float64) for each in rows)
            return images.encode(pictures.display(np.asarray(total / len(rows), np.float32), exposure))
        sample = self._open(row)
        if name == "noise":
            return images.encode(images.draw_noise(sample.radiance))
        a, b = sample.radiance
        if name in (shown := {"a": a, "b": b, "mean": sample.radiance.mean(axis=0)}):
            return images.encode(pictures.display(shown[name], exposure))
        if name not in (arrays := _list_images(sample)):
            raise NotThereError(f"a sample has no picture {name!r}")
        return images.encode(images.draw_array(name, arrays[name], exposure))

    def _list_passes(self, row: int) -> list[int]:
        """The rows of the passes of a sample's view."""
        self._check(row)
        passes: list[int] = self._reader.rows_of_view(self._reader.view_row(row))[:MOST_PASSES].tolist()
        return passes

    # ---------------------------------------------------------------------------------------------------------- points

    def points(self, row: int) -> bytes:
        """The points of a sample's configuration, by `images.pack_points`."""
        cloud = self._open(row).point_cloud
        colour, there = images.colour_points(cloud.albedo, cloud.emission), cloud.present
        return images.pack_points(cloud.position[there], cloud.normal[there], colour[there], cloud.seen[there])

    def photons(self, row: int) -> bytes:
        """The photons of a sample's configuration, by `images.pack_points`; none for a scene without photons."""
        if not self._reader.spec.photons.paths:
            return b""
        sample = self._open(row)
        photons = sample.photons
        there = photons.bounce >= 0
        colour = images.colour_photons(photons.power[there])
        return images.pack_points(
            photons.position[there], photons.normal[there], colour, sample.visibility.photons[there]
        )

    # ------------------------------------------------------------------------------------------------------- in figures

    def about(self, row: int) -> dict[str, Any]:
        """What is known of a sample besides its images."""
        sample, spec = self._open(row), self._reader.spec
        modification, further = sample.modification, sample.modification.describe_further
        rows = self._reader.rows
        place = int(np.searchsorted(rows, row))
        return {
            "row": row,
            "scene": spec.name,
            "key": sample.key.hex(),
            "pass": sample.pass_number,
            "passes": len(self._list_passes(row)),
            "previous": int(rows[place - 1]) if place else None,
            "next": int(rows[place + 1]) if place + 1 < len(rows) else None,
            "origin": sample.view.origin.tolist(),
            "target": sample.view.target.tolist(),
            "up": list(spec.view.up),
            "fov_deg": float(sample.view.fov or spec.view.fov_deg),
            "exposure": spec.exposure,
            "spp": 2 * spec.transport.half_spp,
            "size": [spec.film.width, spec.film.height],
            "noise": self._measure_noise(sample),
            "groups": [
                {"name": group.name, "present": bool(there), "moved": moved.tolist(), "further": further(g)}
                for g, (group, there, moved) in enumerate(
                    zip(spec.groups, modification.present, modification.translation, strict=True)
                )
            ],
            "images": ["mean", "a", "b", "noise", *_list_images(sample)],
        }

    def map_noise(self, cost_of: Callable[[int], float | None]) -> dict[str, Any]:
        """Where samples were seen from, in the plane below `up`, with their noise and what they cost."""
        with self._lock:
            noise = dict(self._noise)
            across = [axis for axis in range(3) if not self._reader.spec.view.up[axis]]
            cells = []
            for row, value in noise.items():
                if self._is_complete(row):
                    _, view, _ = self._reader.inputs(row)
                    cells.append([row, *(float(view.origin[axis]) for axis in across), value, cost_of(row)])
        return {"axes": ["xyz"[axis] for axis in across], "samples": cells}

    # ------------------------------------------------------------------------------------------------------------------

    def _is_complete(self, row: int) -> bool:
        rows = self._reader.rows
        place = int(np.searchsorted(rows, row))
        return place < len(rows) and int(rows[place]) == row

    def _check(self, row: int) -> None:
        with self._lock:
            if not self._is_complete(row):
                self._reader.refresh()
        if not self._is_complete(row):
            raise NotThereError(f"scene {self._scene_id} has no complete sample in row {row}")

    def _open(self, row: int) -> Sample:
        """A sample with its guides."""
        self._check(row)
        return self._opened(row)

    def _measure_noise(self, sample: Sample) -> float | None:
        """The relative noise of a sample's mean, a standard deviation, noted for the map; None for a black image."""
        variance = relative_variance(sample.radiance[0], sample.radiance[1], 1.0)
        if variance is None:
            return None
        with self._lock:
            noise = self._noise[sample.row] = float(np.sqrt(variance))
            if len(self._noise) > MAPPED:
                del self._noise[next(iter(self._noise))]
        return noise


def _list_images(sample: Sample) -> dict[str, F32]:
    """The buffers and guides of a sample that are images, by name."""
    return {name: array for name, array in sample.images.items() if array.shape[:2] == sample.radiance.shape[1:3]}


CURVE_POINTS = 300
"""The most points of a curve."""

STEP = re.compile(r"step-([0-9]{8})\.png")


class FarmPages:
    """A store, its queue and its trainings, for the pages."""

    def __init__(self, place: str | Path, watch: FarmWatch) -> None:
        """Take the store's place, and how the farm is looked at."""
        self._place, self._watch = place, watch
        self._store = Store(place)
        self._view: Cached[FarmProgress] = Cached(watch.look)
        self._samples: dict[str, SceneSamples] = {}
        self._walls: dict[str, Cached[list[int]]] = {}
        self._lock = threading.Lock()

    def view(self) -> FarmProgress:
        """The farm as it was looked at last, seconds ago."""
        return self._view.get()

    def state(self) -> dict[str, Any]:
        """How far the farm is."""
        farm = self._view.get()
        return {
            "store": self._store.storage.where,
            "scenes": [
                asdict(scene.status)
                | {"samples": scene.samples, "passes": scene.passes, "missing": scene.missing}
                | {"in_hand": scene.in_hand, "rate": scene.rate, "left_s": scene.left_s}
                for scene in farm.scenes
            ],
            "queue": farm.describe_queue(),
            "workers": [{"name": name, **asdict(each)} for name, each in farm.queue.activities.items()],
            "waits": [wait.sentence for wait in farm.waits],
            "failed_before": [describe_failed(cause) for cause in farm.queue.kept],
            "trainings": [asdict(training) | {"figures": training.figures} for training in farm.trainings],
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
        """The curves of all runs, held-out error and loss by step and by seconds, and the command of its page live."""
        self._view.get()
        runs, command = self._watch.runs, f"photonfarm live --store {shlex.quote(str(self._place))} --run"
        return [_read_curves(run) | {"live": f"{command} {shlex.quote(str(run.folder))}"} for run in runs]

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
        "steps_between": run.steps_between,
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
