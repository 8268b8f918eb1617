"""The arrays of one scene: their shapes, and how they are laid out in chunks and shards, and encoded.

Shape letters: R rows of a plan, J `shard_rows`, H W image, P points, K photon slots.

A row of an output array is one inner chunk, and a job's J rows are one shard: one file, written once and whole. Noise
does not compress and is stored as it is; everything else is Blosc LZ4 behind a byte shuffle. CRC-32C comes last
in every chain, since Blosc alone lets flipped bits through.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import CorruptError
from photonfarm.core.records import LIT_POINTS
from photonfarm.scene.spec import SceneSpec
from photonfarm.store.format.declarations import OUTPUTS, ArrayDeclaration

if TYPE_CHECKING:
    import zarr

    from photonfarm.store.io.storage import Storage

from collections.abc import Sequence

from photonfarm.core.records import F32

RowKind = Literal["sample", "view", "modification"]

INPUT_ROWS_PER_CHUNK = 65536
BLOSC: dict[str, Any] = {
    "cname": "lz4",
    "clevel": 1,
    "shuffle": "shuffle",
}  # byte shuffle: floats compress by their exponents


@dataclass(frozen=True, slots=True)
class ArraySchema:
    """One output array of a scene: a row of it belongs to one sample, view or modification."""

    name: str
    kind: RowKind
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    fill: float | int  # of unwritten rows; in `photon_bounce` and bits also a legal value of written ones
    compressed: bool
    dimensions: tuple[str, ...]  # names of the axes after the row
    attributes: dict[str, Any]

    def shard_name(self, job: int) -> str:
        """File name of one shard, counted within the plan, in the array's folder."""
        return ".".join(["c", str(job), *("0" for _ in self.shape)])


def output_arrays(spec: SceneSpec) -> dict[str, ArraySchema]:
    """The output arrays of a scene, by name; a scene without photons has none for them."""
    points, photons = (-(-count // 8) for count in bit_counts(spec).values())
    lengths = {"H": spec.film.height, "W": spec.film.width, "K": spec.photons.slots}
    lengths |= {"⌈P/8⌉": points, "⌈K/8⌉": photons, "L": min(spec.points, LIT_POINTS)}
    wanted = [each for each in OUTPUTS if all(lengths.get(str(n), 1) for n in each.shape)]
    return {each.name: _resolve(each, lengths, spec) for each in wanted}


def bytes_of_rows(spec: SceneSpec) -> dict[RowKind, int]:
    """The stored bytes of one sample, one view and one modification, with inputs, uncompressed."""
    found: dict[RowKind, int] = {"sample": 0, "view": 6 * 4, "modification": 4 * 4 * len(spec.groups)}
    for name, array in output_arrays(spec).items():
        if name != "radiance_wide":  # few rows need it
            found[array.kind] += int(np.prod(array.shape)) * array.dtype.itemsize
    return found


def bit_counts(spec: SceneSpec) -> dict[str, int]:
    """The number of bits in a row of the arrays of bits: one for each point, and one for each photon slot."""
    return {"point_seen": spec.points, "photon_seen": spec.photons.slots}


def _resolve(declared: ArrayDeclaration, lengths: Mapping[str, int], spec: SceneSpec) -> ArraySchema:
    exponents = {"radiance": spec.radiance_exponent, "radiance_wide": 0}
    scale = {"radiance_exponent": exponents[declared.name]} if declared.name in exponents else {}
    return ArraySchema(
        declared.name,
        cast("RowKind", declared.axes[0]),
        tuple(n if isinstance(n, int) else lengths[n] for n in declared.shape[1:]),
        np.dtype(declared.dtype),
        declared.fill,
        declared.compressed,
        declared.axes[1:],
        {**declared.attributes, **scale},
    )


# ------------------------------------------------------------------------------------------------ arrays through zarr


def create_outputs(group: zarr.Group, arrays: Iterable[ArraySchema], rows: int, shard_rows: int) -> None:
    """Declare arrays of a plan's outputs at their full size; nothing is ever appended or resized."""
    for array in arrays:
        group.create_array(
            array.name,
            shape=(rows, *array.shape),
            chunks=(1, *array.shape),
            shards=(shard_rows, *array.shape),
            dtype=array.dtype,
            fill_value=array.fill,
            compressors=_codecs(compressed=array.compressed),
            filters=None,
            dimension_names=(array.kind, *array.dimensions),
            attributes=array.attributes,
            chunk_key_encoding=_FLAT,
        )


def create_input(
    group: zarr.Group, declared: ArrayDeclaration, data: NDArray[Any], more: Mapping[str, Any] | None = None
) -> None:
    """Store a whole array of inputs or of the base, compressed and with checksums; `data` has the declared type.

    `more` are attributes beside the declared ones.
    """
    chunks = (min(max(len(data), 1), INPUT_ROWS_PER_CHUNK), *(max(n, 1) for n in data.shape[1:]))
    little = data.astype(declared.dtype, casting="equiv", copy=False)
    array = group.create_array(
        declared.name,
        shape=data.shape,
        chunks=chunks,
        dtype=little.dtype,
        fill_value=declared.fill,
        compressors=_codecs(compressed=declared.compressed),
        filters=None,
        dimension_names=declared.axes,
        attributes={**declared.attributes, **(more or {})},
        chunk_key_encoding=_FLAT,
        config={"write_empty_chunks": True},
    )
    if data.size:
        array[...] = little


def chunk_names(array: Any) -> Iterator[str]:
    """The file names of all chunks of an array of inputs or of the base, in the array's folder."""
    if array.size:
        grid = [-(-length // chunk) for length, chunk in zip(array.shape, array.chunks, strict=True)]
        for index in np.ndindex(*grid):
            yield ".".join(["c", *map(str, index)])


def read_input(storage: Storage, folder: str, array: Any) -> NDArray[Any]:
    """Read a whole array of inputs or of the base from its folder.

    Raises CorruptError for a missing chunk, which zarr would read as fill values, and ValueError, with the array's
    name, for chunks that zarr cannot read.
    """
    held = set(storage.names(folder))
    for name in chunk_names(array):
        if name not in held:
            raise CorruptError(f"{storage.where}/{folder}/{name}: is missing")
    try:
        return np.asarray(array[...])
    except (ValueError, KeyError, RuntimeError) as error:
        reason = str(error).partition(" Stored: b")[0].rstrip(".")  # bytes of checksums tell nobody anything
        raise ValueError(f"{array.path}: {reason}") from error


_FLAT: Any = {"name": "default", "configuration": {"separator": "."}}  # c.0.0 in one folder, which is synced once


def _codecs(*, compressed: bool) -> list[Any]:
    from zarr.codecs import BloscCodec, Crc32cCodec

    return [BloscCodec(**BLOSC), Crc32cCodec()] if compressed else [Crc32cCodec()]


FIELDS = {
    "modification": (
        {"name": "x", "unit": "scene units", "rest": 0.0, "zero": "where the group was modelled"},
        {"name": "y", "unit": "scene units", "rest": 0.0, "zero": "where the group was modelled"},
        {"name": "z", "unit": "scene units", "rest": 0.0, "zero": "where the group was modelled"},
        {"name": "present", "unit": "1", "rest": 1.0, "zero": "removed"},
    ),
    "view": tuple(
        {"name": f"{point}_{axis}", "unit": "scene units", "rest": 0.0, "zero": "the origin of world coordinates"}
        for point in ("origin", "look_at")
        for axis in "xyz"
    ),
}
"""What the columns of `modification`, for each group, and of `view` hold, by name; part of the format's version.

More may follow; a plan names those it has. A field that a plan lacks is at `rest` in all of its rows. `zero` says what
0 means.
"""


def vector_attributes(name: str, groups: Sequence[str]) -> dict[str, Any]:
    """The attributes that describe the columns of an array of inputs; empty for one that holds no vectors."""
    described: dict[str, Any] = {"fields": list(FIELDS[name])} if name in FIELDS else {}
    return described | ({"groups": list(groups)} if name == "modification" else {})


def select_columns(name: str, values: F32, attributes: Mapping[str, Any]) -> F32:
    """Stored vectors (…, F) with the columns that this program knows; raises as `by_name` does."""
    return select_by_name(values, [str(field["name"]) for field in attributes["fields"]], FIELDS[name])


def select_by_name(values: F32, stored: Sequence[str], known: Sequence[Mapping[str, Any]]) -> F32:
    """Vectors (…, F) whose columns have the names `stored`, with the `known` fields; those not stored are at rest.

    Unused rows stay NaN. Raises ValueError for a field that is not known.
    """
    names = [field["name"] for field in known]
    if list(stored) == names:
        return values
    if unknown := [name for name in stored if name not in names]:
        raise ValueError(f"has the field {unknown[0]}, which this program does not know: install a newer photonfarm")
    found = np.empty((*values.shape[:-1], len(names)), np.float32)
    for place, field in enumerate(known):
        at_rest = np.where(np.isnan(values[..., 0]), np.float32(np.nan), np.float32(field["rest"]))
        found[..., place] = values[..., stored.index(field["name"])] if field["name"] in stored else at_rest
    return found
