"""The formats: how samples become a file, and what describes all files of a folder.

`webdataset`: tar shards, in which a sample is the files that begin with its row: 00000007.A.npy and so on. `exr`: an
image per sample with a layer for everything, and `transforms.json` with the cameras. `npz`: NumPy archives with an
array for each column, one per sample or with the samples along a first axis. `parquet`: tables with a row per sample
and its images in it, with Croissant metadata.
"""

from __future__ import annotations

import io
import json
import tarfile
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from photonfarm.core.archives import write_arrays, write_layers
from photonfarm.core.errors import StoreError, say_install, store_errors
from photonfarm.core.files import whole_file, write_whole
from photonfarm.export.card import Exported, write_croissant
from photonfarm.export.folder import SAMPLES, FormatName
from photonfarm.export.snapshot import (
    HALVES,
    Column,
    Contents,
    Values,
    camera_to_world,
    parse_rows,
    select_facts,
)
from photonfarm.scene.view import Camera

if TYPE_CHECKING:
    import pyarrow as pa


class Format(ABC):
    """A format."""

    SUFFIX: str  # of its files
    PACKAGES: Sequence[str] = ()  # modules that it needs, of the extra `export`
    ONE_PER_FILE: bool | None  # True, False: always one sample, always several in a file; None: as is asked, or one

    @staticmethod
    @abstractmethod
    def write(file: Path, samples: Iterator[Values], contents: Contents) -> None:
        """Write samples into a file, which appears whole. Raises StoreError if the disk refuses."""

    @staticmethod  # noqa: B027 - most formats have no more to write
    def finish(exported: Exported) -> None:
        """Write what describes all files of the folder; nothing, unless a format says otherwise."""


def load_format(name: FormatName) -> type[Format]:
    """A format by its name; raises StoreError if a package that it needs is not installed."""
    for package in FORMATS[name].PACKAGES:
        try:
            import_module(package)
        except ModuleNotFoundError as error:
            raise StoreError(f"--to {name}: needs the package {package}; {say_install('export')}") from error
    return FORMATS[name]


class TarShards(Format):
    """`--to webdataset`."""

    SUFFIX = ".tar"
    ONE_PER_FILE = False

    @staticmethod
    def write(file: Path, samples: Iterator[Values], contents: Contents) -> None:
        """Write a shard: of each sample a NumPy file for every image, and JSON with all else."""
        arrays = [*contents.images, *contents.others]
        with store_errors("write a shard", file), whole_file(file) as part, tarfile.open(part, "w") as shard:
            for values in samples:
                files = {}
                for column in arrays:
                    stream = io.BytesIO()
                    np.save(stream, values[column.name], allow_pickle=False)
                    files[f"{column.name}.npy"] = stream.getvalue()
                files["json"] = json.dumps(select_facts(values, contents.facts) | contents.about).encode()
                for name, content in files.items():
                    entry = tarfile.TarInfo(f"{values['row']:08d}.{name}")  # without time: equal samples, equal shards
                    entry.size = len(content)
                    shard.addfile(entry, io.BytesIO(content))


class Exr(Format):
    """`--to exr`."""

    SUFFIX = ".exr"
    PACKAGES = ("OpenEXR",)
    ONE_PER_FILE = True
    TRANSFORMS = "transforms.json"

    @staticmethod
    def write(file: Path, samples: Iterator[Values], contents: Contents) -> None:
        """Write the image of one sample; what is no image goes first, into an archive of the same name."""
        (values,) = samples
        if contents.others:
            others = {column.name: values[column.name] for column in contents.others}
            write_arrays(file.with_suffix(".npz"), others, "exported samples")
        half_a, half_b = (values[name] for name in HALVES)
        layers = {"": (half_a + half_b) / np.float32(2)}
        layers |= {column.name: values[column.name] for column in contents.images}
        matrix = np.linalg.inv(values["camera_to_world"]).T  # OpenEXR multiplies row vectors
        said = json.dumps(select_facts(values, contents.facts) | contents.about)
        write_layers(file, layers, {"worldToCamera": np.ascontiguousarray(matrix, np.float32), "photonfarm": said})

    @staticmethod
    def finish(exported: Exported) -> None:
        """Write the cameras of all images, as NeRF's programs read them."""
        camera = exported.contents.about["camera"]
        width, height = camera["width"], camera["height"]
        focal = {"fl_x": camera["focal_px"], "fl_y": camera["focal_px"], "cx": width / 2, "cy": height / 2}
        head = {"camera_model": "PINHOLE", "camera_angle_x": float(np.radians(camera["fov_deg"]))}
        snapshot, frames = exported.snapshot, []
        for row in parse_rows(exported.manifest.rows):
            modification, view = snapshot.inputs(row)
            frame: dict[str, Any] = {
                "file_path": f"{SAMPLES}/{row:08d}{Exr.SUFFIX}",
                "transform_matrix": camera_to_world(view, snapshot.spec).tolist(),
                "look_at": view.target.tolist(),
                "configuration_key": modification.key(snapshot.spec.radiance_id).hex(),
                "split": snapshot.split_of(row),
            }
            if view.fov is not None:
                focal_px = Camera.of(view, snapshot.spec).focal_px
                frame |= {"fl_x": focal_px, "fl_y": focal_px, "camera_angle_x": float(np.radians(view.fov))}
            frames.append(frame)
        document = {**head, **focal, "w": width, "h": height, "up": camera["up"], "frames": frames}
        with store_errors("write the cameras", exported.folder):
            write_whole(exported.folder / Exr.TRANSFORMS, json.dumps(document, indent=1) + "\n")


class Npz(Format):
    """`--to npz`."""

    SUFFIX = ".npz"
    ONE_PER_FILE = None

    @staticmethod
    def write(file: Path, samples: Iterator[Values], contents: Contents) -> None:
        """Write an archive; it holds no Python objects."""
        rows = list(samples)
        arrays = {each.name: np.asarray([values[each.name] for values in rows]) for each in contents.columns}
        if contents.single:
            arrays = {name: values[0] for name, values in arrays.items()}
        write_arrays(file, arrays, "exported samples")


class Parquet(Format):
    """`--to parquet`."""

    SUFFIX = ".parquet"
    PACKAGES = ("pyarrow",)
    ONE_PER_FILE = False
    GROUP_ROWS = 16  # samples of a row group: what a reader takes into memory at once

    @staticmethod
    def write(file: Path, samples: Iterator[Values], contents: Contents) -> None:
        """Write a table, some rows at a time."""
        import pyarrow as pa
        from pyarrow import parquet

        columns = contents.columns
        names = [column.name for column in columns if column.dtype == "str"]  # the others do not repeat
        options: Any = {"compression": "zstd", "compression_level": 1}
        options |= {"use_dictionary": names, "write_statistics": names}
        schema = pa.schema([(column.name, _arrow_type(column)) for column in columns])
        with (
            store_errors("write a table", file),
            whole_file(file) as part,
            parquet.ParquetWriter(part, schema, **options) as table,
        ):
            while rows := list(islice(samples, Parquet.GROUP_ROWS)):
                arrays = [_arrow_array([values[column.name] for values in rows], column) for column in columns]
                table.write_table(pa.table(arrays, schema=schema))

    @staticmethod
    def finish(exported: Exported) -> None:
        """Write the Croissant metadata."""
        write_croissant(exported)


def _arrow_type(column: Column) -> pa.DataType:
    import pyarrow as pa

    kind = pa.string() if column.dtype == "str" else pa.from_numpy_dtype(np.dtype(column.dtype))
    for _ in column.shape:
        kind = pa.list_(kind)
    return kind


def _arrow_array(values: list[Any], column: Column) -> pa.Array:
    """The values of a column for some samples; arrays as nested lists, made without a Python object per number."""
    import pyarrow as pa

    if not column.shape:
        return pa.array(values, _arrow_type(column))
    nested = pa.array(np.stack(values).reshape(-1))
    for length in reversed(column.shape):
        nested = pa.ListArray.from_arrays(pa.array(np.arange(0, len(nested) + 1, length, dtype=np.int32)), nested)
    return nested


FORMATS: dict[FormatName, type[Format]] = {"webdataset": TarShards, "exr": Exr, "npz": Npz, "parquet": Parquet}
