"""`--to webdataset`: tar shards, in which a sample is the files that begin with its row: 00000007.A.npy and so on."""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from photonfarm.core.errors import store_errors
from photonfarm.core.files import whole_file
from photonfarm.export.columns import Contents
from photonfarm.export.formats.format import nothing_more
from photonfarm.export.snapshot import Values, plain

SUFFIX = ".tar"
PACKAGES = ()
ONE_PER_FILE = False

finish = nothing_more


def write(file: Path, samples: Iterator[Values], contents: Contents) -> None:
    """Write a shard: of each sample a NumPy file for every image, and JSON with all else."""
    arrays = [*contents.images, *contents.others]
    with store_errors("write a shard", file), whole_file(file) as part, tarfile.open(part, "w") as shard:
        for values in samples:
            key = f"{values['row']:08d}"
            for column in arrays:
                _add(shard, f"{key}.{column.name}.npy", _npy(values[column.name]))
            _add(shard, f"{key}.json", json.dumps(plain(values, contents.facts) | contents.about).encode())


def _npy(values: np.ndarray[tuple[int, ...], np.dtype[np.generic]]) -> bytes:
    stream = io.BytesIO()
    np.save(stream, values, allow_pickle=False)
    return stream.getvalue()


def _add(shard: tarfile.TarFile, name: str, content: bytes) -> None:
    entry = tarfile.TarInfo(name)  # without time and owner: equal samples make equal shards
    entry.size = len(content)
    shard.addfile(entry, io.BytesIO(content))
