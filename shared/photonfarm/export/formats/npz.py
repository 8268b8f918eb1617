"""`--to npz`: NumPy archives with an array for each column, one per sample or with the samples along a first axis."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from photonfarm.core.archives import write_arrays
from photonfarm.export.columns import Contents
from photonfarm.export.formats.format import nothing_more
from photonfarm.export.snapshot import Values

SUFFIX = ".npz"
PACKAGES = ()
ONE_PER_FILE = None

finish = nothing_more


def write(file: Path, samples: Iterator[Values], contents: Contents) -> None:
    """Write an archive; it holds no Python objects."""
    found = list(samples)
    arrays = {each.name: np.asarray([values[each.name] for values in found]) for each in contents.columns}
    if contents.single:
        arrays = {name: values[0] for name, values in arrays.items()}
    write_arrays(file, arrays, "exported samples")
