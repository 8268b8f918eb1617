"""`--to parquet`: tables with a row per sample and its images in it, with Croissant metadata."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from photonfarm.core.errors import store_errors
from photonfarm.core.files import whole_file
from photonfarm.export.columns import Column, Contents
from photonfarm.export.formats.croissant import write_croissant
from photonfarm.export.formats.format import Exported
from photonfarm.export.snapshot import Values

if TYPE_CHECKING:
    import pyarrow as pa

SUFFIX = ".parquet"
PACKAGES = ("pyarrow",)
ONE_PER_FILE = False

GROUP_ROWS = 16
"""The samples of a row group: what a reader takes into memory at once."""


def write(file: Path, samples: Iterator[Values], contents: Contents) -> None:
    """Write a table, some rows at a time."""
    from pyarrow import parquet

    names = [column.name for column in contents.columns if column.dtype == "str"]  # the others do not repeat
    options: Any = {"compression": "zstd", "compression_level": 1, "use_dictionary": names, "write_statistics": names}
    schema = _schema(contents.columns)
    with (
        store_errors("write a table", file),
        whole_file(file) as part,
        parquet.ParquetWriter(part, schema, **options) as table,
    ):
        while chosen := list(islice(samples, GROUP_ROWS)):
            table.write_table(_table(chosen, contents.columns, schema))


def finish(exported: Exported) -> None:
    """Write the Croissant metadata."""
    write_croissant(exported.folder, exported.contents.columns, exported.manifest)


def _schema(columns: Sequence[Column]) -> pa.Schema:
    import pyarrow as pa

    return pa.schema([(column.name, _type(column)) for column in columns])


def _type(column: Column) -> pa.DataType:
    import pyarrow as pa

    found = pa.string() if column.dtype == "str" else pa.from_numpy_dtype(np.dtype(column.dtype))
    for _ in column.shape:
        found = pa.list_(found)
    return found


def _table(samples: Sequence[Values], columns: Sequence[Column], schema: pa.Schema) -> pa.Table:
    import pyarrow as pa

    return pa.table([_array([values[column.name] for values in samples], column) for column in columns], schema=schema)


def _array(values: list[Any], column: Column) -> pa.Array:
    """The values of a column for some samples; arrays as nested lists, made without a Python object per number."""
    import pyarrow as pa

    if not column.shape:
        return pa.array(values, _type(column))
    stacked = np.stack(values)
    found = pa.array(stacked.reshape(-1))
    for length in reversed(column.shape):
        found = pa.ListArray.from_arrays(pa.array(np.arange(0, len(found) + 1, length, dtype=np.int32)), found)
    return found
