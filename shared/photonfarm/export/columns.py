"""What an export holds of each sample: its columns, by name, with type, shape, unit and meaning.

Shape letters: H W image, G movable groups, P points of the cloud, K photon slots, L lit points.

Rows of a store are given as text, such as 0-31,40.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
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
        size = self._size
        return [column for column in self.columns if not column.fact and column.shape[:2] == size]

    @property
    def others(self) -> list[Column]:
        """What is neither."""
        size = self._size
        return [column for column in self.columns if not column.fact and column.shape[:2] != size]

    @property
    def _size(self) -> tuple[int, ...]:
        return next(column.shape[:2] for column in self.columns if column.name == HALVES[0])


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
    """The columns of a scene's samples: facts, the half-estimates, buffers, and visibility if it is asked for."""
    size = (spec.film.height, spec.film.width)
    unit, _ = _find_declaration("radiance")
    halves = [Column(name, "float32", (*size, 3), unit, _describe_half(name)) for name in HALVES]
    return (
        *_list_facts(spec),
        *halves,
        *(_describe_stored(spec, name) for name in buffers),
        *(_list_visibility(spec) if visibility else ()),
    )


def _describe_half(name: str) -> str:
    other = HALVES[name == "A"]
    return f"linear RGB, mean over the pixel, not clipped; a noisy estimate of the image, independent of {other}"


def _list_facts(spec: SceneSpec) -> list[Column]:
    groups = len(spec.groups)
    moved = Column(
        "modification",
        "float32",
        (groups, 4),
        "scene units; the last: 1",
        "of each movable group, in the "
        "order of the spec: translation from rest along x, y, z, then 1: present or 0: removed",
    )
    facts = [
        Column("row", "int64", (), "1", "the sample's row in the store"),
        Column("key", "str", (), "", "the sample's content key, hexadecimal"),
        Column("split", "str", (), "", "train, or held-out: of a configuration to be kept from training"),
        Column("pass", "int64", (), "1", "number of the noisy pass of this view, from 0"),
        Column("configuration_key", "str", (), "", "content key of the configuration: equal for all its views"),
        Column("view_key", "str", (), "", "content key of configuration and view: equal for all its passes"),
        *([moved] if groups else []),
        Column("origin", "float32", (3,), "scene units", "where the camera stands, world coordinates"),
        Column("target", "float32", (3,), "scene units", "the point that it looks at, world coordinates"),
        Column(
            "camera_to_world",
            "float64",
            (4, 4),
            "scene units",
            "columns: the camera's right, up and backward, and where it stands (the convention of NeRF and OpenGL)",
        ),
        Column("seed_A", "int64", (), "1", "seed of A; a render that was not finite was drawn again with another"),
        Column("seed_B", "int64", (), "1", "seed of B, likewise"),
        Column("job", "int64", (), "1", "the render job that it came from"),
        Column("core_s", "float64", (), "s", "processor time of that job, over its samples"),
    ]
    return [replace(each, fact=True) for each in facts]


def _describe_stored(spec: SceneSpec, name: str) -> Column:
    """A buffer or guide in the type that the store has: its values are the stored ones."""
    array = schema.output_arrays(spec)[name]
    return Column(name, array.dtype.name, array.shape, *_find_declaration(name))


def _list_visibility(spec: SceneSpec) -> list[Column]:
    columns = []
    for name, count in schema.bit_counts(spec).items():
        what = "point of the cloud" if name == "point_seen" else "photon of the configuration"
        columns.append(Column(name, "bool", (count,), "1", f"whether the view sees each {what}"))
    return [column for column in columns if column.shape[0]]


def _find_declaration(name: str) -> tuple[str, str]:
    """Unit and convention of an array, as the store's format declares them."""
    (declaration,) = (each for each in declarations.OUTPUTS if each.name == name)
    return declaration.unit, declaration.convention


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
