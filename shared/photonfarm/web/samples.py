"""The samples of one scene as the pages show them: those that landed last, and one of them opened."""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from photonfarm.core import pictures
from photonfarm.core.errors import IncompleteError
from photonfarm.core.records import F32
from photonfarm.plan.sample_costs import relative_variance
from photonfarm.store import Sample, SceneReader
from photonfarm.web import images
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
        self._noise: OrderedDict[int, float] = OrderedDict()  # by row, of those whose pictures were made
        self._opened: OrderedDict[int, Sample] = OrderedDict()

    def look(self) -> list[int]:
        """Look for new samples; returns the rows on the wall, the latest first."""
        with self._lock:
            try:
                new = self._reader.refresh()
            except IncompleteError:  # the scene was forgotten, and is another one now
                self._reader, new = SceneReader(self._place, self._scene_id), np.zeros(0, np.int64)
                self._noise.clear()
                self._opened.clear()
            kept = [row for row in self._wall if self._is_complete(row)]
            at_once = AT_ONCE if kept else WALL
            if len(new) > at_once:
                new = new[np.linspace(0, len(new) - 1, at_once).astype(np.int64)]
            self._wall = deque([*kept, *new.tolist()], maxlen=WALL)
            self._fill_maps()
            return list(reversed(self._wall))

    def _fill_maps(self) -> None:
        """Measure the noise of a few samples more, spread over all that are there, until the maps are full."""
        rows = self._reader.rows
        spread = rows[np.linspace(0, len(rows) - 1, min(len(rows), MAPPED)).astype(np.int64)]
        for row in [row for row in spread.tolist() if row not in self._noise][:AT_ONCE]:
            self._noted_noise(self._reader.read(row))

    # -------------------------------------------------------------------------------------------------------- pictures

    def thumbnail(self, row: int) -> bytes:
        """The mean of A and B as a JPEG, at the spec's exposure; its noise is noted for the map."""
        sample = self._read(row)
        return images.encode(pictures.display(sample.radiance.mean(axis=0), self._reader.spec.exposure), "JPEG")

    def picture(self, row: int, name: str) -> bytes:
        """A picture of a sample as a PNG: a, b, mean, noise, reference, or a buffer or guide by its name."""
        exposure = self._reader.spec.exposure
        if name == "reference":
            return images.encode(pictures.display(self._merged(row)[0], exposure))
        sample = self._open(row)
        if name in (shown := {"a": sample.radiance[0], "b": sample.radiance[1], "mean": sample.radiance.mean(axis=0)}):
            return images.encode(pictures.display(shown[name], exposure))
        if name == "noise":
            return images.encode(images.draw_noise(sample.radiance))
        arrays = _draw_images(sample)
        if name not in arrays:
            raise NotThereError(f"a sample has no picture {name!r}")
        return images.encode(images.draw_array(name, arrays[name], exposure))

    def _merged(self, row: int) -> tuple[F32, int]:
        """The mean of the passes of a sample's view, and their number."""
        with self._lock:
            self._check(row)
            rows = self._reader.rows_of_view(self._reader.view_row(row))[:MOST_PASSES].tolist()
        total = sum(self._reader.read(each).radiance.mean(axis=0).astype(np.float64) for each in rows)
        return np.asarray(total / len(rows), np.float32), len(rows)

    # ---------------------------------------------------------------------------------------------------------- points

    def points(self, row: int) -> bytes:
        """The points of a sample's configuration, as `images.packed` has them."""
        cloud = self._open(row).point_cloud
        colour, there = images.colour_points(cloud.albedo, cloud.emission), cloud.present
        return images.pack_points(cloud.position[there], cloud.normal[there], colour[there], cloud.seen[there])

    def photons(self, row: int) -> bytes:
        """The photons of a sample's configuration, as `images.packed` has them; none for a scene without photons."""
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
        modification = sample.modification
        rows = self._reader.rows
        place = int(np.searchsorted(rows, row))
        return {
            "row": row,
            "scene": spec.name,
            "key": sample.key.hex(),
            "pass": sample.pass_number,
            "passes": self._merged(row)[1],
            "previous": int(rows[place - 1]) if place else None,
            "next": int(rows[place + 1]) if place + 1 < len(rows) else None,
            "origin": sample.view.origin.tolist(),
            "target": sample.view.target.tolist(),
            "up": list(spec.view.up),
            "fov_deg": spec.view.fov_deg,
            "exposure": spec.exposure,
            "spp": 2 * spec.transport.half_spp,
            "size": [spec.film.width, spec.film.height],
            "noise": self._noted_noise(sample),
            "groups": [
                {"name": group.name, "present": bool(there), "moved": moved.tolist()}
                for group, there, moved in zip(spec.groups, modification.present, modification.translation, strict=True)
            ],
            "images": ["mean", "a", "b", "noise", *_draw_images(sample)],
        }

    def map_noise(self, cost_of: Callable[[int], float | None]) -> dict[str, Any]:
        """Where samples were seen from, in the plane below `up`, with their noise and what they cost."""
        with self._lock:
            noise = dict(self._noise)
            across = [axis for axis in range(3) if not self._reader.spec.view.up[axis]]
            cells = []
            for row, value in noise.items():
                if row in self._opened or self._is_complete(row):
                    _, view, _ = self._reader.inputs(row)
                    cells.append([row, *(float(view.origin[axis]) for axis in across), value, cost_of(row)])
        return {"axes": ["xyz"[axis] for axis in across], "samples": cells}

    # ------------------------------------------------------------------------------------------------------------------

    def _is_complete(self, row: int) -> bool:
        rows = self._reader.rows
        place = int(np.searchsorted(rows, row))
        return place < len(rows) and int(rows[place]) == row

    def _check(self, row: int) -> None:
        if not self._is_complete(row):
            self._reader.refresh()
        if not self._is_complete(row):
            raise NotThereError(f"scene {self._scene_id} has no complete sample in row {row}")

    def _read(self, row: int) -> Sample:
        """A sample without its guides, its noise noted."""
        with self._lock:
            self._check(row)
        sample = self._reader.read(row)
        self._noted_noise(sample)
        return sample

    def _open(self, row: int) -> Sample:
        """A sample with its guides."""
        with self._lock:
            self._check(row)
            if row not in self._opened:
                self._opened[row] = self._reader.read(row, guides=True)
                while len(self._opened) > OPENED:
                    self._opened.popitem(last=False)
            self._opened.move_to_end(row)
            return self._opened[row]

    def _noted_noise(self, sample: Sample) -> float | None:
        """The relative noise of a sample's mean, a standard deviation; None for a black image."""
        variance = relative_variance(sample.radiance[0], sample.radiance[1], 1.0)
        if variance is None:
            return None
        with self._lock:
            self._noise[sample.row] = float(np.sqrt(variance))
            while len(self._noise) > MAPPED:
                self._noise.popitem(last=False)
            return self._noise[sample.row]


def _draw_images(sample: Sample) -> dict[str, F32]:
    """The buffers and guides of a sample that are images, by name."""
    return {name: array for name, array in sample.images.items() if array.shape[:2] == sample.radiance.shape[1:3]}
