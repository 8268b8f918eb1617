"""Where cameras may stand: the cells of the box of origins that are in the open, and the room that each group takes.

The renderer measures both by rays (`photonfarm scene free-space`), and a spec holds them, so that whoever plans needs
no Mitsuba. Shape letters: N points, X Y Z cells along the axes.
"""

from __future__ import annotations

import base64
import binascii
import zlib
from functools import lru_cache
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from photonfarm.core.models import Frozen

MOST_ALONG = 128
"""The most cells along an axis."""

Cells = Annotated[int, Field(ge=1, le=MOST_ALONG)]
Corner = tuple[float, float, float]


class FreeSpace(Frozen):
    """The free space of a scene, as it was measured."""

    of: str  # digest of all that it was measured for: geometry, groups, box of origins
    cells: tuple[Cells, Cells, Cells]  # along each axis of the box of origins
    free: str  # one bit for each cell, the last axis fastest, 1 in the open: packed, deflated, base64
    groups: dict[str, tuple[Corner, Corner]] = Field(default_factory=dict)
    """The box around each group, to both corners from its `at`; no camera stands in it."""

    @model_validator(mode="after")
    def _can_be_read(self) -> FreeSpace:
        if not _cells(self.free, self.cells).any():
            raise ValueError("has no free cell; no camera could stand anywhere")
        return self

    def holds(self, low: NDArray[np.float64], high: NDArray[np.float64], points: NDArray[np.float32]) -> Free:
        """Whether points (N, 3) lie in free cells of the box of origins, (N,); outside of the box nothing is known."""
        size = np.where(high > low, high - low, 1.0)
        place = (points.astype(np.float64) - low) / size
        count = np.array(self.cells)
        cell = np.clip(np.floor(place * count), 0, count - 1).astype(np.int64)
        outside = ((points < np.float32(low)) | (points > np.float32(high))).any(axis=1)
        free: Free = outside | _cells(self.free, self.cells)[cell[:, 0], cell[:, 1], cell[:, 2]]
        return free


Free = NDArray[np.bool_]


def pack(free: Free) -> str:
    """Cells (X, Y, Z) as the text of `FreeSpace.free`."""
    return base64.b64encode(zlib.compress(np.packbits(free).tobytes(), 9)).decode()


@lru_cache(maxsize=16)
def _cells(text: str, shape: tuple[int, int, int]) -> Free:
    """Cells (X, Y, Z) from their text; raises ValueError for a text that is no such cells."""
    count = int(np.prod(shape))
    try:
        data = zlib.decompressobj().decompress(base64.b64decode(text, validate=True), count // 8 + 2)
    except (binascii.Error, zlib.error) as error:
        raise ValueError(f"has cells that cannot be read ({error}); measure them again") from error
    if len(data) != -(-count // 8):
        raise ValueError(f"has other cells than {' × '.join(map(str, shape))}; measure them again")
    cells: Free = np.unpackbits(np.frombuffer(data, np.uint8), count=count).astype(np.bool_).reshape(shape)
    cells.setflags(write=False)
    return cells
