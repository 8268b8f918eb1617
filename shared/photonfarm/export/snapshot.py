"""The samples of a scene that are complete now, as values by the names of columns."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from photonfarm.data import Sample
from photonfarm.export.columns import HALVES, Column
from photonfarm.plan.hold_out import rows_held_out
from photonfarm.scene.modification import Modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import Camera, View
from photonfarm.store import SceneReader, SceneStore

Split = Literal["train", "held-out"]

Values = dict[str, Any]
"""The values of one sample, by the names of columns: arrays, numbers and text."""


class Snapshot:
    """The complete samples of a scene: what they hold, what they are, and which jobs they came from."""

    def __init__(self, place: str | Path, stored: SceneStore, *, guides: bool, hold_out: float) -> None:
        """Look once; samples that are completed later are not in it. With `guides` samples come with their guides."""
        self._stored, self._guides = stored, guides
        self._reader = SceneReader(place, stored.scene_id)
        self.rows: list[int] = self._reader.refresh().tolist()  # of all complete samples, ascending
        self.spec: SceneSpec = self._reader.spec
        self._plans = stored.plans()
        held_out = rows_held_out(self._reader, self.rows, hold_out)
        self._held_out = {row for row, is_held_out in zip(self.rows, held_out, strict=True) if is_held_out}
        self._figures: tuple[int, dict[str, Any]] = -1, {}  # of the last job, as rows come in order
        self.versions: list[dict[str, str]] = []
        """The versions of the packages that rendered what has been read so far, each set once."""

    def split_of(self, row: int) -> Split:
        """Whether the sample in a row is to be trained on or held out."""
        return "held-out" if row in self._held_out else "train"

    def jobs_of(self, rows: Iterable[int]) -> list[int]:
        """The jobs of rows, each once."""
        return sorted({row // self._plans[0].shard_rows for row in rows})

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

    # ----------------------------------------------------------------------------------------------------- of a sample

    def sample(self, row: int) -> Sample:
        """The sample in a row; raises CorruptError if stored bytes are not what was committed."""
        return self._reader.read(row, guides=self._guides)

    def inputs(self, row: int) -> tuple[Modification, View]:
        """The configuration and the view of a row."""
        return self._reader.inputs(row)[:2]

    def values(self, sample: Sample, columns: Sequence[Column]) -> Values:
        """The values of a sample, each in its column's type."""
        values = self._facts(sample) | dict(zip(HALVES, sample.radiance, strict=True)) | sample.images
        values |= {"point_seen": sample.visibility.points, "photon_seen": sample.visibility.photons}
        return {
            each.name: np.ascontiguousarray(values[each.name], each.dtype) if each.shape else values[each.name]
            for each in columns
        }

    def _facts(self, sample: Sample) -> Values:
        """What a sample is: all its columns but images and visibility."""
        (job,) = self.jobs_of([sample.row])
        seed_a, seed_b = sample.seeds
        return {
            "row": sample.row,
            "key": sample.key.hex(),
            "split": self.split_of(sample.row),
            "pass": sample.pass_number,
            "configuration_key": self._reader.modification_key(sample.row).hex(),
            "view_key": self._reader.view_key(sample.row).hex(),
            "modification": sample.modification.vector,
            "origin": sample.view.origin,
            "target": sample.view.target,
            "camera_to_world": camera_to_world(sample.view, self.spec),
            "seed_A": seed_a,
            "seed_B": seed_b,
            "job": job,
            "core_s": self._core_s(job),
        }

    def _core_s(self, job: int) -> float:
        """The cost of a sample of a job; the versions of what rendered it are kept."""
        if self._figures[0] != job:
            self._figures = job, self._stored.marker(job)["figures"]
        figures = self._figures[1]
        if figures["versions"] not in self.versions:
            self.versions.append(figures["versions"])
        (samples,) = (plan.samples_in(job) for plan in self._plans if job in plan.own_jobs)
        return float(figures["core_s"]) / samples


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
