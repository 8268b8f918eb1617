"""The samples of a scene that are complete now, as values by the names of columns."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.keys import seed_of, view_key
from photonfarm.data import Sample, Scene
from photonfarm.export.columns import HALVES, Column
from photonfarm.scene.modification import Modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import Camera, View
from photonfarm.store import SceneStore

Split = Literal["train", "held-out"]

Values = dict[str, Any]
"""The values of one sample, by the names of columns: arrays, numbers and text."""


class Snapshot:
    """The complete samples of a scene: what they hold, what they are, and which jobs they came from."""

    def __init__(self, place: str | Path, stored: SceneStore, *, guides: bool, hold_out: float) -> None:
        """Look once; samples that are completed later are not in it. With `guides` samples come with their guides."""
        self._stored = stored
        self._scene = Scene(place, stored.scene_id, guides=guides)  # it is not refreshed
        self.spec: SceneSpec = self._scene.spec
        self._plans = stored.plans()
        self._place = {row: place for place, row in enumerate(self._scene.rows.tolist())}
        self._held_out = set(self._scene.split("held-out", hold_out=hold_out).rows.tolist())
        self._job: _Job | None = None
        self.versions: list[dict[str, str]] = []
        """The versions of the packages that rendered what has been read so far, each set once."""

    @property
    def rows(self) -> Collection[int]:
        """The rows of all complete samples, ascending."""
        return self._place.keys()

    def split_of(self, row: int) -> Split:
        """Whether the sample in a row is to be trained on or held out."""
        return "held-out" if row in self._held_out else "train"

    def jobs_of(self, rows: Iterable[int]) -> list[int]:
        """The jobs of rows, each once."""
        return sorted({row // self._shard_rows for row in rows})

    def plans(self) -> list[dict[str, Any]]:
        """The plans of the scene: number, first row, samples and request of each."""
        return [
            {"number": p.number, "first_row": p.first_row, "samples": p.samples, "request": p.request.model_dump()}
            for p in self._plans
        ]

    @property
    def planned(self) -> int:
        """The number of samples in all plans."""
        return sum(plan.samples for plan in self._plans)

    @property
    def _shard_rows(self) -> int:
        return self._plans[0].shard_rows

    # ----------------------------------------------------------------------------------------------------- of a sample

    def sample(self, row: int) -> Sample:
        """The sample in a row; raises CorruptError if stored bytes are not what was committed."""
        sample: Sample = self._scene[self._place[row]]
        return sample

    def values(self, sample: Sample, columns: Sequence[Column]) -> Values:
        """The values of a sample, each in its column's type."""
        values = self._facts(sample.row) | dict(zip(HALVES, sample.radiance, strict=True))
        return {column.name: _take_value(sample, column, values) for column in columns}

    def inputs(self, row: int) -> tuple[Modification, View]:
        """The configuration and the view of a row, complete or not."""
        return self._of_job(row // self._shard_rows).inputs(row)

    def _facts(self, row: int) -> Values:
        """What the sample in a row is: all its columns but images and visibility."""
        job = self._of_job(row // self._shard_rows)
        modification, view = job.inputs(row)
        sample = job.samples[row]
        key = modification.key(self.spec.radiance_id)
        return {
            "row": row,
            "key": sample.key.hex(),
            "split": self.split_of(row),
            "pass": sample.pass_,
            "configuration_key": key.hex(),
            "view_key": view_key(key, view.vector).hex(),
            "modification": modification.vector,
            "origin": view.origin,
            "target": view.target,
            "camera_to_world": camera_to_world(view, self.spec),
            "seed_A": seed_of(sample.key, "half A"),
            "seed_B": seed_of(sample.key, "half B"),
            "job": job.number,
            "core_s": self._core_s(job),
        }

    def _of_job(self, number: int) -> _Job:
        """A job; the last one is kept, as rows come in order."""
        if self._job is None or self._job.number != number:
            self._job = _Job(self._stored, number)
        return self._job

    def _core_s(self, job: _Job) -> float:
        if job.versions not in self.versions:
            self.versions.append(job.versions)
        return job.core_s


class _Job:
    """A job: its inputs and, of a committed one, its cost per sample, and what rendered it."""

    def __init__(self, stored: SceneStore, number: int) -> None:
        self._stored, self.number = stored, number
        self._rows = stored.job_rows(number)
        self.samples = {sample.row: sample for sample in self._rows.samples}

    def inputs(self, row: int) -> tuple[Modification, View]:
        sample = self.samples[row]
        return self._rows.modifications[sample.modification_row], self._rows.views[sample.view_row]

    @cached_property
    def _figures(self) -> dict[str, Any]:
        figures: dict[str, Any] = self._stored.marker(self.number)["figures"]
        return figures

    @property
    def core_s(self) -> float:
        return float(self._figures["core_s"]) / len(self.samples)

    @property
    def versions(self) -> dict[str, str]:
        return dict(self._figures["versions"])


def _take_value(sample: Sample, column: Column, values: Values) -> Any:
    """The value of a column, in its type."""
    if column.name in values:
        value = values[column.name]
    elif column.name == "point_seen":
        value = sample.point_cloud.seen
    elif column.name == "photon_seen":
        value = sample.seen_photons
    else:
        value = getattr(sample, column.name)
    return np.ascontiguousarray(value, column.dtype) if column.shape else value


def camera_to_world(view: View, spec: SceneSpec) -> NDArray[np.float64]:
    """The camera of a view as NeRF and OpenGL have it, (4, 4): columns right, up, backward, origin."""
    camera = Camera.of(view, spec)
    matrix = np.eye(4)
    matrix[:3] = np.stack([camera.right, -camera.down, -camera.forward, camera.origin], axis=1)
    return matrix


def describe_constants(spec: SceneSpec) -> dict[str, Any]:
    """What is the same for all samples of a scene: its id and name, its movable groups, its camera, its light."""
    width, half_angle = spec.film.width, 0.5 * np.radians(spec.view.fov_deg)
    return {
        "scene": {"id": spec.scene_id, "name": spec.name},
        "groups": [group.name for group in spec.groups],
        "camera": {
            "fov_deg": spec.view.fov_deg,  # along the width
            "focal_px": float(0.5 * width / np.tan(half_angle)),
            "width": width,
            "height": spec.film.height,
            "up": list(spec.view.up),
        },
        "half_spp": spec.transport.half_spp,
        "exposure": spec.exposure,
    }


def select_facts(values: Values, columns: Sequence[Column]) -> dict[str, Any]:
    """The facts among the values of a sample, as JSON holds them."""
    facts = {column.name: values[column.name] for column in columns if column.fact}
    return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in facts.items()}
