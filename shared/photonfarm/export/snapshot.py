"""What an export holds of each sample: its columns, with type, shape, unit and meaning, and the values of these.

Shape letters: H W image, G movable groups, P points of the cloud, K photon slots, L lit points.

Rows of a store are given as text, such as 0-31,40.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import SpecError
from photonfarm.core.records import Guides
from photonfarm.data import Sample
from photonfarm.plan.hold_out import are_held_out, units_of
from photonfarm.scene.modification import Modification, columns
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import Camera, View
from photonfarm.store import SceneReader, SceneStore
from photonfarm.store.format import declarations, schema
from photonfarm.store.model import plans

BUFFERS = ("albedo", "normal", "depth")
"""The buffers that every view has."""

GUIDES = tuple(field.name for field in fields(Guides))
"""The guides of a view."""

HALVES = ("A", "B")
"""The names of the two half-estimates."""


@dataclass(frozen=True, slots=True)
class Column:
    """A value that each sample has."""

    name: str
    dtype: str  # numpy's name of it; "str" for text
    shape: tuple[int, ...]  # () for a single value
    unit: str
    meaning: str
    fact: bool = False  # it says what the sample is: kilobytes at most, written as JSON where a format has JSON

    def describe(self) -> dict[str, Any]:
        """It as JSON holds it."""
        about = {"name": self.name, "dtype": self.dtype, "shape": list(self.shape)}
        return {**about, "unit": self.unit, "meaning": self.meaning}


@dataclass(frozen=True, slots=True)
class Contents:
    """What each file of an export holds."""

    columns: tuple[Column, ...]
    about: dict[str, Any]  # what is the same for all samples, for formats that have JSON
    single: bool  # one sample per file

    @property
    def facts(self) -> list[Column]:
        """What says what a sample is."""
        return [column for column in self.columns if column.fact]

    @property
    def images(self) -> list[Column]:
        """What has a value for each pixel."""
        (half,) = (column for column in self.columns if column.name == HALVES[0])
        return [column for column in self.columns if not column.fact and column.shape[:2] == half.shape[:2]]

    @property
    def others(self) -> list[Column]:
        """What is neither."""
        images = self.images
        return [column for column in self.columns if not column.fact and column not in images]


def parse_buffers(text: str) -> tuple[str, ...]:
    """The buffers that `--buffers` asks for: "all", "none", or names with commas between them.

    Raises SpecError for a name that is not there.
    """
    there = (*BUFFERS, *GUIDES)
    if text in ("all", "none"):
        return there if text == "all" else ()
    asked = [name.strip() for name in text.split(",")]
    for name in asked:
        if name not in there:
            raise SpecError(f"--buffers: {name!r} is not there: allowed are all, none, or {', '.join(there)}")
    return tuple(name for name in there if name in asked)


def list_columns(spec: SceneSpec, buffers: Sequence[str], *, visibility: bool) -> tuple[Column, ...]:
    """The columns of a scene's samples: facts, the half-estimates, buffers, and visibility if it is asked for.

    A buffer or guide has the type that the store has: its values are the stored ones.
    """
    size, arrays = (spec.film.height, spec.film.width), schema.output_arrays(spec)
    declared = {each.name: each for each in declarations.OUTPUTS}
    columns = _list_facts(spec)
    for name, other in (HALVES, HALVES[::-1]):
        meaning = f"linear RGB, mean over the pixel, not clipped; a noisy estimate of the image, independent of {other}"
        columns.append(Column(name, "float32", (*size, 3), declared["radiance"].unit, meaning))
    for name in buffers:
        array, about = arrays[name], declared[name]
        columns.append(Column(name, array.dtype.name, array.shape, about.unit, about.convention))
    for name, seen in (("point_seen", "point of the cloud"), ("photon_seen", "photon of the configuration")):
        if visibility and (length := schema.bit_counts(spec)[name]):
            columns.append(Column(name, "bool", (length,), "1", f"whether the view sees each {seen}"))
    return tuple(columns)


def _list_facts(spec: SceneSpec) -> list[Column]:
    groups = len(spec.groups)
    moved = (
        "of each movable group, in the order of the spec: translation from rest along x, y, z, then 1: present or 0: "
        "removed"
        + "; then the turn in degrees, and factors on its light: power, red, green, blue"
        * spec.further_changes
    )
    unit = "scene units; the fourth: 1" if spec.further_changes else "scene units; the last: 1"
    camera = "columns: the camera's right, up and backward, and where it stands (the convention of NeRF and OpenGL)"
    facts: list[tuple[str, str, tuple[int, ...], str, str]] = [
        ("row", "int64", (), "1", "the sample's row in the store"),
        ("key", "str", (), "", "the sample's content key, hexadecimal"),
        ("split", "str", (), "", "train, or held-out: of a configuration to be kept from training"),
        ("pass", "int64", (), "1", "number of the noisy pass of this view, from 0"),
        ("configuration_key", "str", (), "", "content key of the configuration: equal for all its views"),
        ("view_key", "str", (), "", "content key of configuration and view: equal for all its passes"),
        *([("modification", "float32", (groups, columns(spec)), unit, moved)] if groups else []),
        ("origin", "float32", (3,), "scene units", "where the camera stands, world coordinates"),
        ("target", "float32", (3,), "scene units", "the point that it looks at, world coordinates"),
        ("camera_to_world", "float64", (4, 4), "scene units", camera),
        *([("fov", "float32", (), "degrees", "the camera's field of view, along the width")] if spec.view.fov else []),
        ("seed_A", "int64", (), "1", "seed of A; a render that was not finite was drawn again with another"),
        ("seed_B", "int64", (), "1", "seed of B, likewise"),
        ("job", "int64", (), "1", "the render job that it came from"),
        ("core_s", "float64", (), "s", "processor time of that job, over its samples"),
    ]
    return [Column(*each, fact=True) for each in facts]


_RANGE = re.compile(r"(\d{1,18})(?:-(\d{1,18}))?")


def format_ranges(rows: Iterable[int]) -> str:
    """Rows as ranges: 0, 1, 2, 7 is 0-2,7."""
    bounds: list[list[int]] = []
    for row in sorted(rows):
        if bounds and row == bounds[-1][1] + 1:
            bounds[-1][1] = row
        else:
            bounds.append([row, row])
    return ",".join(f"{first}-{last}" if last > first else f"{first}" for first, last in bounds)


def parse_ranges(text: str) -> list[range]:
    """The ranges that a text names, in its order; raises ValueError for other text."""
    parsed = []
    for part in filter(None, text.split(",")):
        match = _RANGE.fullmatch(part.strip())
        if match is None or int(match[2] or match[1]) < int(match[1]):
            raise ValueError(f"{part.strip()!r} is no row and no range of rows; write them like 0-31,40")
        parsed.append(range(int(match[1]), int(match[2] or match[1]) + 1))
    return parsed


def parse_rows(text: str) -> list[int]:
    """The rows that `format_ranges` wrote."""
    return [row for span in parse_ranges(text) for row in span]


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
        held_out = are_held_out(units_of(self._reader, self.rows), hold_out)
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
        """The configuration and the view of a row, complete or not: a repair may take back what was exported."""
        sample = plans.sample_at(self._plans, row)
        assert sample is not None  # noqa: S101 - it was exported
        modification = plans.modification_at(self._plans, sample.modification_row)
        return modification, plans.view_at(self._plans, sample.view_row)

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
            "fov": None if sample.view.fov is None else float(sample.view.fov),
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
            **({"fov": spec.view.fov.model_dump()} if spec.view.fov else {}),  # from which each view has its own
        },
        "half_spp": spec.transport.half_spp,
        "exposure": spec.exposure,
    }


def select_facts(values: Values, columns: Sequence[Column]) -> dict[str, Any]:
    """The facts among the values of a sample, as JSON holds them."""
    facts = {column.name: values[column.name] for column in columns if column.fact}
    return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in facts.items()}
