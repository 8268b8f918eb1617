"""What an export holds of each sample: its columns, by name, with type, shape, unit and meaning.

Shape letters: H W image, G movable groups, P points of the cloud, K photon slots, L lit points.

Rows of a store are given as text, such as 0-31,40.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any

from photonfarm.core.errors import SpecError
from photonfarm.core.records import Guides
from photonfarm.scene.spec import SceneSpec
from photonfarm.store.format import declarations, schema

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
    )
    camera = "columns: the camera's right, up and backward, and where it stands (the convention of NeRF and OpenGL)"
    facts: list[tuple[str, str, tuple[int, ...], str, str]] = [
        ("row", "int64", (), "1", "the sample's row in the store"),
        ("key", "str", (), "", "the sample's content key, hexadecimal"),
        ("split", "str", (), "", "train, or held-out: of a configuration to be kept from training"),
        ("pass", "int64", (), "1", "number of the noisy pass of this view, from 0"),
        ("configuration_key", "str", (), "", "content key of the configuration: equal for all its views"),
        ("view_key", "str", (), "", "content key of configuration and view: equal for all its passes"),
        *([("modification", "float32", (groups, 4), "scene units; the last: 1", moved)] if groups else []),
        ("origin", "float32", (3,), "scene units", "where the camera stands, world coordinates"),
        ("target", "float32", (3,), "scene units", "the point that it looks at, world coordinates"),
        ("camera_to_world", "float64", (4, 4), "scene units", camera),
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
    """The rows that `ranges` wrote."""
    return [row for span in parse_ranges(text) for row in span]
