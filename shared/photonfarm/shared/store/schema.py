"""What lies in a scene's Zarr arrays: names, shapes, types, codecs, units. The one place that knows them.

Shape letters: R rows of a plan, J `shard_rows`, H W image, K photon slots, G movable groups.

A row of an output array is one inner chunk, and a job's J rows are one shard: one file, written once and whole. Noise
does not compress and is stored as it is; everything else is Blosc LZ4 behind a byte shuffle. CRC-32C comes last
in every chain, since Blosc alone lets flipped bits through.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.keys import KEY_BYTES
from photonfarm.shared.scene import SceneSpec

if TYPE_CHECKING:
    import zarr

FORMAT = "photonfarm store"
VERSION = 2

Kind = Literal["sample", "view", "modification"]

INPUT_ROWS_PER_CHUNK = 65536
BLOSC = {"cname": "lz4", "clevel": 5, "shuffle": "shuffle"}  # byte shuffle: floats compress by their exponents


@dataclass(frozen=True, slots=True)
class ArraySchema:
    """One output array: a row of it belongs to one sample, view or modification."""

    name: str
    kind: Kind
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    fill: float | int  # of rows that are not written; never a legal value of a written one, but for `photon_bounce`
    compressed: bool
    dimensions: tuple[str, ...]  # names of the axes after the row
    attributes: dict[str, Any]

    def block(self, shard_rows: int) -> NDArray[Any]:
        """The rows of one job, (J, ...), unwritten."""
        return np.full((shard_rows, *self.shape), self.fill, self.dtype)

    def shard_name(self, job: int) -> str:
        """File name of one shard, counted within the plan, in the array's folder."""
        return ".".join(["c", str(job), *("0" for _ in self.shape)])


def output_arrays(spec: SceneSpec) -> dict[str, ArraySchema]:
    """The output arrays of a scene, by name."""
    arrays = [*_radiance(spec), *_buffers(spec)]
    if spec.photons.paths:
        arrays += _photons(spec)
    return {array.name: array for array in arrays}


def _radiance(spec: SceneSpec) -> list[ArraySchema]:
    shape = (2, spec.film.height, spec.film.width, 3)
    axes = ("half", "y", "x", "channel")
    about = {
        "unit": "radiance, as the scene states its emitters",
        "convention": "linear RGB, not clipped; halves are independent",
    }
    scaled = {
        **about,
        "radiance_exponent": spec.radiance_exponent,
        "note": "stored = radiance × 2^radiance_exponent; rows that float16 cannot hold lie in radiance_wide",
    }
    wide = {**about, "radiance_exponent": 0, "note": "rows with values beyond float16, unscaled"}
    return [
        ArraySchema("radiance", "sample", shape, np.dtype("<f2"), np.nan, False, axes, scaled),
        ArraySchema("radiance_wide", "sample", shape, np.dtype("<f4"), np.nan, False, axes, wide),
    ]


def _buffers(spec: SceneSpec) -> list[ArraySchema]:
    size = (spec.film.height, spec.film.width)
    depth = {"unit": "scene units", "convention": "along the camera's forward axis; 0: nothing is met"}
    albedo = {"unit": "1", "convention": "diffuse reflectance, linear RGB"}
    normal = {"unit": "1", "convention": "unit shading normal, world coordinates, as modelled; 0: nothing is met"}
    return [
        ArraySchema("depth", "view", size, np.dtype("<f4"), np.nan, True, ("y", "x"), depth),
        ArraySchema("albedo", "view", (*size, 3), np.dtype("<f2"), np.nan, True, ("y", "x", "channel"), albedo),
        ArraySchema("normal", "view", (*size, 3), np.dtype("<f2"), np.nan, True, ("y", "x", "axis"), normal),
    ]


def _photons(spec: SceneSpec) -> list[ArraySchema]:
    slots = spec.photons.paths * spec.photons.depth
    world = "world coordinates"

    def vectors(name: str, dtype: str, last: str, unit: str, convention: str) -> ArraySchema:
        about = {"unit": unit, "convention": convention}
        return ArraySchema(
            f"photon_{name}", "modification", (slots, 3), np.dtype(dtype), np.nan, True, ("slot", last), about
        )

    bounce = {"unit": "1", "convention": "0 for the first hit of a path; -1: an empty slot, zero in the other arrays"}
    return [
        vectors("position", "<f4", "axis", "scene units", world),
        vectors("direction", "<f2", "axis", "1", f"unit, the way the light travels, {world}"),
        vectors("normal", "<f2", "axis", "1", f"unit geometric normal, {world}"),
        vectors("power", "<f4", "channel", "W", "RGB flux; the sum does not depend on the number emitted"),
        ArraySchema("photon_bounce", "modification", (slots,), np.dtype("i1"), -1, True, ("slot",), bounce),
    ]


# ------------------------------------------------------------------------------------------------ arrays through zarr


def create_outputs(group: zarr.Group, spec: SceneSpec, rows: int, shard_rows: int) -> None:
    """Declare every output array of a plan at its full size; nothing is ever appended or resized."""
    for array in output_arrays(spec).values():
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


def create_input(group: zarr.Group, name: str, data: NDArray[Any], dimensions: tuple[str, ...], about: str) -> None:
    """Store one whole array of inputs or of the base, compressed and with checksums."""
    chunks = (min(max(len(data), 1), INPUT_ROWS_PER_CHUNK), *(max(n, 1) for n in data.shape[1:]))
    little = data.astype(data.dtype.newbyteorder("<"), copy=False)
    array = group.create_array(
        name,
        shape=data.shape,
        chunks=chunks,
        dtype=little.dtype,
        fill_value=np.nan if data.dtype.kind == "f" else 0,
        compressors=_codecs(compressed=True),
        filters=None,
        dimension_names=dimensions,
        attributes={"convention": about},
        chunk_key_encoding=_FLAT,
        config={"write_empty_chunks": True},
    )
    if data.size:
        array[...] = little


_FLAT: Any = {"name": "default", "configuration": {"separator": "."}}  # c.0.0 in one folder, which is synced once


def _codecs(*, compressed: bool) -> list[Any]:
    from zarr.codecs import BloscCodec, Crc32cCodec

    return [BloscCodec(**BLOSC), Crc32cCodec()] if compressed else [Crc32cCodec()]  # type: ignore[arg-type]


PLAN_INPUTS = {
    "modification": (
        ("modification", "group", "component"),
        "translation (scene units), then 1 if present; NaN: unused",
    ),
    "view": (("view", "component"), "origin, then look-at point, world coordinates; NaN: unused"),
    "sample_modification": (("sample",), "row of the sample's modification; -1: unused row"),
    "sample_view": (("sample",), "row of the sample's view; -1: unused row"),
    "sample_pass": (("sample",), "number of the noisy pass; -1: unused row"),
    "sample_key": (("sample", "byte"), f"the sample's content key, {KEY_BYTES} bytes"),
}
