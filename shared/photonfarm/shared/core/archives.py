"""NumPy archives by which one service hands arrays to another: a file is there whole or not at all."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.core.errors import StoreError, store_errors
from photonfarm.shared.core.files import whole_file

_DAMAGED = (ValueError, TypeError, KeyError, IndexError, EOFError, zipfile.BadZipFile, RuntimeError)
"""The errors that reading raises for a file that is not such an archive."""


def write_arrays(file: Path, arrays: Mapping[str, NDArray[Any]], what: str) -> None:
    """Store arrays by name; messages call them `what`. Raises StoreError if the disk refuses."""
    with store_errors(f"write the {what}", file), whole_file(file) as part, part.open("wb") as archive:
        np.savez(archive, allow_pickle=False, **arrays)


@contextmanager
def stored_arrays(file: Path, what: str, verb: str) -> Iterator[Mapping[str, NDArray[Any]]]:
    """The arrays of a file by name, each read at its first use.

    Raises StoreError if the file is missing, unreadable or damaged, and if the code inside the `with` raises KeyError,
    IndexError, TypeError or ValueError on its arrays; the message names `what` the file should hold, and the `verb`
    that writes it.
    """
    try:
        with file.open("rb") as archive, np.load(archive, allow_pickle=False) as stored:  # it leaves damaged ones open
            yield stored
    except FileNotFoundError as error:
        raise StoreError(f"{file}: there is no such file") from error
    except OSError as error:
        raise StoreError(f"{file}: cannot be read: {error.strerror or error}") from error
    except _DAMAGED as error:
        raise StoreError(f"{file}: holds no {what} that `photonfarm {verb}` wrote") from error
