"""NumPy archives by which one service hands arrays to another, and OpenEXR images; a file is there whole or not at all.

The costs of a frame's parts, and what kind of surface each pixel shows, are such an archive: the renderer measures, and
reports read it without a renderer. Images have a layer for each array, without loss; they need the package OpenEXR.

Shape letters: N rows of the store, H W image, T timed frames, K sizes of image.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from enum import IntEnum
from importlib import import_module
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import StoreError, say_install, store_errors
from photonfarm.core.files import whole_file

_DAMAGED = (ValueError, TypeError, KeyError, IndexError, EOFError, zipfile.BadZipFile, RuntimeError)
"""The errors that reading raises for a file that is not such an archive."""


def write_arrays(file: Path, arrays: Mapping[str, NDArray[Any]], what: str) -> None:
    """Store arrays by name; messages call them `what`. Raises StoreError if the disk refuses."""
    with store_errors(f"write the {what}", file), whole_file(file) as part, part.open("wb") as archive:
        np.savez(archive, allow_pickle=False, **arrays)


@contextmanager
def read_arrays(file: Path, what: str, verb: str) -> Iterator[Mapping[str, NDArray[Any]]]:
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


PARTS = ("edit_s", "buffers_s", "surface_s", "guides_s", "points_s", "photons_s", "photons_seen_s")
"""What a network's frame needs besides samples, in the order in which it is made."""


@dataclass(frozen=True, slots=True)
class Seconds:
    """Wall time of a piece of work that was timed several times."""

    median: float
    low: float  # the 10th percentile
    high: float  # the 90th percentile

    @classmethod
    def of(cls, times: NDArray[np.float64]) -> Self:
        """The median and percentiles of some times, (T,); raises ValueError if there are none."""
        if not len(times):
            raise ValueError("times is empty; a median needs at least one")
        low, median, high = np.quantile(times, (0.1, 0.5, 0.9)).tolist()
        return cls(median, low, high)


class Surface(IntEnum):
    """The kinds of first surface that a ray meets between the near and the far plane, by how they scatter."""

    NOTHING = 0  # there is none
    DIFFUSE = 1  # diffuse lobes only; also behind a mask
    SPECULAR = 2  # a glossy lobe, or a diffuse one beside a mirror's: metals, and what is coated
    MIRROR = 3  # neither diffuse nor glossy: mirrors, clear glass, and surfaces that let everything through
    EMITTER = 4  # its shape emits, whatever else it does


@dataclass(frozen=True, slots=True, eq=False)
class FrameCosts:
    """Seconds on one core, or on a card, for each timed frame, and the first surfaces of some rows."""

    scene_id: str
    rows: NDArray[np.int64]  # (N,) of the store
    surface: NDArray[np.uint8]  # (N, H, W) a `Surface` at each pixel's centre
    edit_s: NDArray[np.float64]  # (T,) bringing the scene into the frame's configuration, from another one
    buffers_s: NDArray[np.float64]  # (T,) depth, albedo, normal, where no guides are wanted
    surface_s: NDArray[np.float64]  # (T,) the guides that take no shadow ray, and the view's buffers
    guides_s: NDArray[np.float64]  # (T,) the view's guides and its buffers, which share their rays
    points_s: NDArray[np.float64]  # (T,) which points of the base cloud, or of its first ones, the view sees
    photons_s: NDArray[np.float64]  # (T,) tracing photons; 0 in a scene without photons
    photons_seen_s: NDArray[np.float64]  # (T,) which photons the view sees; 0 likewise
    kept: NDArray[np.int64]  # (K,) k: an image of about 1/k of the pixels
    halves: NDArray[np.int64]  # (K,) so many times `half_spp` samples of each of these pixels
    render_s: NDArray[np.float64]  # (K, T) such an image

    def parts(self) -> dict[str, Seconds]:
        """The times of each part of a frame, by its name in `PARTS`, over the timed frames."""
        return {name: Seconds.of(getattr(self, name)) for name in PARTS}

    def renders(self) -> dict[tuple[int, int], Seconds]:
        """The times of n half-estimates of 1/k of the pixels, by (k, n), over the timed frames."""
        amounts = zip(self.kept.tolist(), self.halves.tolist(), strict=True)
        return {amount: Seconds.of(times) for amount, times in zip(amounts, self.render_s, strict=True)}

    def write(self, file: Path) -> None:
        """Store them as a NumPy archive, whole or not at all; raises StoreError if the disk refuses."""
        arrays = {each.name: np.asarray(getattr(self, each.name)) for each in fields(self)}
        write_arrays(file, arrays, "frame costs")

    @classmethod
    def read(cls, file: Path) -> Self:
        """Read what `write` stored; raises StoreError for anything else."""
        with read_arrays(file, "frame costs", "measure-frames") as stored:
            arrays: dict[str, Any] = {each.name: stored[each.name] for each in fields(cls)}
            return cls(**{**arrays, "scene_id": str(arrays["scene_id"])})


def require_openexr(file: Path) -> Any:
    """The module OpenEXR, by which `write_layers` writes; raises StoreError without it."""
    try:
        return import_module("OpenEXR")
    except ModuleNotFoundError as error:
        raise StoreError(f"{file}: needs the package OpenEXR; {say_install('export')}") from error


def write_layers(file: Path, layers: Mapping[str, NDArray[Any]], attributes: Mapping[str, Any]) -> None:
    """Write an image with layers by name, (H, W, 3) or (H, W), float16 or float32; "" is the one shown first.

    Integers are written as float32, which is exact up to 2²⁴.

    Channels are R, G, B of colours, X, Y, Z of normals, Z of depths, and V of other single values. Raises StoreError
    if OpenEXR is not installed, or the disk refuses.
    """
    OpenEXR = require_openexr(file)  # noqa: N806 - the module's own name
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **attributes}
    with store_errors("write an image", file), whole_file(file) as part:
        try:
            with OpenEXR.File(header, _channels(layers)) as image:
                image.write(str(part))
        except RuntimeError as error:  # OpenEXR's own, which names the cause
            raise OSError(None, str(error), str(file)) from error


def _channels(layers: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    channels: dict[str, NDArray[Any]] = {}
    for layer, given in layers.items():
        values = given.astype(np.float32) if given.dtype.kind in "iu" else given
        if values.ndim == 3:
            names, planes = "XYZ" if "normal" in layer else "RGB", np.moveaxis(values, -1, 0)
        else:
            names, planes = "Z" if "depth" in layer else "V", values[None]
        for name, plane in zip(names, planes, strict=True):  # OpenEXR minds no strides
            channels[f"{layer}.{name}" if layer else name] = np.ascontiguousarray(plane)
    return channels
