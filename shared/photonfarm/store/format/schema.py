"""The arrays of one scene: their shapes, and how they are laid out in chunks and shards, and encoded.

Shape letters: R rows of a plan, J `shard_rows`, H W image, P points, K photon slots.

A row of an output array is one inner chunk, and a job's J rows are one shard: one file, written once and whole. Noise
does not compress and is stored as it is; everything else is Blosc LZ4 behind a byte shuffle. CRC-32C comes last
in every chain, since Blosc alone lets flipped bits through.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import CorruptError
from photonfarm.core.records import F32, LIT_POINTS
from photonfarm.scene.modification import columns
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import view_columns
from photonfarm.store.format.declarations import FIELDS, FURTHER, OUTPUTS, ArrayDeclaration

if TYPE_CHECKING:
    import zarr

    from photonfarm.store.io.storage import Storage

RowKind = Literal["sample", "view", "modification"]

INPUT_ROWS_PER_CHUNK = 65536
BLOSC: dict[str, Any] = {"cname": "lz4", "clevel": 1, "shuffle": "shuffle"}  # bytes: floats compress by exponents


@dataclass(frozen=True, slots=True)
class ArraySchema:
    """One output array of a scene: a row of it belongs to one sample, view or modification."""

    name: str
    kind: RowKind
    shape: tuple[int, ...]  # of a row
    dtype: np.dtype[Any]
    compressed: bool

    def shard_name(self, job: int) -> str:
        """File name of one shard, counted within the plan, in the array's folder."""
        return ".".join(["c", str(job), *("0" for _ in self.shape)])


def output_arrays(spec: SceneSpec) -> dict[str, ArraySchema]:
    """The output arrays of a scene, by name; a scene without photons has none for them."""
    points, photons = (-(-count // 8) for count in bit_counts(spec).values())
    lengths = {"H": spec.film.height, "W": spec.film.width, "K": spec.photons.slots}
    lengths |= {"⌈P/8⌉": points, "⌈K/8⌉": photons, "L": min(spec.points, LIT_POINTS)}
    shapes = {each: tuple(n if isinstance(n, int) else lengths[n] for n in each.shape[1:]) for each in OUTPUTS}
    return {
        each.name: ArraySchema(each.name, cast("RowKind", each.axes[0]), shape, np.dtype(each.dtype), each.compressed)
        for each, shape in shapes.items()
        if all(shape)
    }


def bytes_of_rows(spec: SceneSpec) -> dict[RowKind, int]:
    """The stored bytes of one sample, one view and one modification, with inputs, uncompressed."""
    row_bytes: dict[RowKind, int] = {
        "sample": 0,
        "view": 4 * view_columns(spec),
        "modification": 4 * columns(spec) * len(spec.groups),
    }
    for name, array in output_arrays(spec).items():
        if name != "radiance_wide":  # few rows need it
            row_bytes[array.kind] += int(np.prod(array.shape)) * array.dtype.itemsize
    return row_bytes


def bit_counts(spec: SceneSpec) -> dict[str, int]:
    """The number of bits in a row of the arrays of bits: one for each point, and one for each photon slot."""
    return {"point_seen": spec.points, "photon_seen": spec.photons.slots}


# ------------------------------------------------------------------------------------------------ arrays through zarr


def create_outputs(group: zarr.Group, spec: SceneSpec, rows: int, shard_rows: int) -> None:
    """Declare the arrays of a plan's outputs at their full size; nothing is ever appended or resized."""
    exponents = {"radiance": spec.radiance_exponent, "radiance_wide": 0}
    arrays = output_arrays(spec)
    for declared in OUTPUTS:
        if (name := declared.name) in arrays:
            shape = arrays[name].shape
            scale = {"radiance_exponent": exponents[name]} if name in exponents else {}
            group.create_array(
                name,
                shape=(rows, *shape),
                chunks=(1, *shape),
                shards=(shard_rows, *shape),
                dtype=arrays[name].dtype,
                attributes={**declared.attributes, **scale},
                **_layout(declared),
            )


def create_input(
    group: zarr.Group, declared: ArrayDeclaration, data: NDArray[Any], more: Mapping[str, Any] | None = None
) -> None:
    """Store a whole array of inputs or of the base, compressed and with checksums; `data` has the declared type.

    `more` are attributes beside the declared ones.
    """
    little = data.astype(declared.dtype, casting="equiv", copy=False)
    array = group.create_array(
        declared.name,
        shape=data.shape,
        chunks=(min(max(len(data), 1), INPUT_ROWS_PER_CHUNK), *(max(n, 1) for n in data.shape[1:])),
        dtype=little.dtype,
        attributes={**declared.attributes, **(more or {})},
        config={"write_empty_chunks": True},
        **_layout(declared),
    )
    if data.size:
        array[...] = little


def _layout(declared: ArrayDeclaration) -> dict[str, Any]:
    """How zarr-python stores an array."""
    from zarr.codecs import BloscCodec, Crc32cCodec

    return {
        "compressors": [*([BloscCodec(**BLOSC)] if declared.compressed else []), Crc32cCodec()],
        "filters": None,
        "fill_value": declared.fill,
        "dimension_names": declared.axes,
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "."}},  # one folder, synced once
    }


def chunk_names(array: Any) -> Iterator[str]:
    """The file names of all chunks of an array of inputs or of the base, in the array's folder."""
    if array.size:
        grid = [-(-length // chunk) for length, chunk in zip(array.shape, array.chunks, strict=True)]
        for index in np.ndindex(*grid):
            yield ".".join(["c", *map(str, index)])


def read_input(storage: Storage, folder: str, array: Any) -> NDArray[Any]:
    """Read a whole array of inputs or of the base from its folder.

    Raises CorruptError for a missing chunk, which zarr would read as fill values, and ValueError, with the array's
    name, for chunks that zarr cannot read and for columns that this program does not know.
    """
    held = set(storage.names(folder))
    for name in chunk_names(array):
        if name not in held:
            raise CorruptError(f"{storage.where}/{folder}/{name}: is missing")
    try:
        values = np.asarray(array[...])
        kind = folder.rpartition("/")[2]
        if kind not in FIELDS:
            return values
        stored, known = [field["name"] for field in array.attrs["fields"]], FIELDS[kind]
        if not {*stored} <= {field["name"] for field in known}:
            known += FURTHER[kind]
        return select_by_name(values, stored, known)
    except (ValueError, KeyError, RuntimeError) as error:
        reason = str(error).partition(" Stored: b")[0].rstrip(".")  # bytes of checksums tell nobody anything
        raise ValueError(f"{array.path}: {reason}") from error


def select_by_name(values: F32, stored: Sequence[str], known: Sequence[Mapping[str, Any]]) -> F32:
    """Vectors (…, F) whose columns have the names `stored`, with the `known` fields; those not stored are at rest.

    Unused rows stay NaN. Raises ValueError for a field that is not known.
    """
    names = [field["name"] for field in known]
    if list(stored) == names:
        return values
    if unknown := [name for name in stored if name not in names]:
        raise ValueError(f"has the field {unknown[0]}, which this program does not know: install a newer photonfarm")
    selected = np.empty((*values.shape[:-1], len(names)), np.float32)
    for place, field in enumerate(known):
        at_rest = np.where(np.isnan(values[..., 0]), np.float32(np.nan), np.float32(field["rest"]))
        selected[..., place] = values[..., stored.index(field["name"])] if field["name"] in stored else at_rest
    return selected
