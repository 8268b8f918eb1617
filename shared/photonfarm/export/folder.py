"""The folder of an export: which rows its files hold, which files are to be written, and its lock.

What samples of one configuration share, its point cloud and its photons, is in a file of its own.

Shape letters: P points, K photon slots.
"""

from __future__ import annotations

import fcntl
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.archives import write_arrays
from photonfarm.core.errors import SpecError, StoreError, store_errors
from photonfarm.core.records import arrays_of
from photonfarm.data import Sample
from photonfarm.export import manifest
from photonfarm.export.columns import format_ranges, parse_rows
from photonfarm.export.manifest import MANIFEST, Extra, Manifest, Part
from photonfarm.scene.spec import SceneSpec

LOCK = ".lock"
DATA, SAMPLES = "data", "samples"
"""The folders of files with several samples, and of those with one."""


@dataclass(frozen=True, slots=True)
class Planned:
    """A file that is to be written, whole or not at all, and the rows in it."""

    file: Path
    rows: tuple[int, ...]


@contextmanager
def lock_folder(folder: Path, wanted: Manifest) -> Iterator[Manifest]:
    """Make the folder and lock it; gives the manifest to go on with, which is the wanted one in a new folder.

    Raises StoreError if the folder holds something else, or another process exports into it.
    """
    with store_errors("export into this folder", folder):
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / MANIFEST).exists() and (foreign := _find_foreign(folder)):
            raise StoreError(f"{folder}: is neither empty nor an export (it holds {foreign!r}); give another folder")
        file = (folder / LOCK).open("ab")
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise StoreError(f"{folder}: another process exports into it; wait, or give another folder") from error
        earlier = manifest.read(folder)
        if earlier is not None:
            manifest.check(folder, earlier, wanted)
        _sweep(folder)
        yield (
            wanted
            if earlier is None
            else wanted.model_copy(update={"parts": earlier.parts, "versions": earlier.versions})
        )


def _find_foreign(folder: Path) -> str | None:
    """A file that no export of ours has begun; None if there is none."""
    names = (each.name for each in folder.iterdir())
    return min((name for name in names if name != LOCK and ".partial" not in name), default=None)


def _sweep(folder: Path) -> None:
    """Remove what killed processes left half written."""
    with store_errors("remove unfinished files", folder):
        for part in folder.rglob(".*.partial*"):
            part.unlink(missing_ok=True)


class Files:
    """The files of an export, by the rows that they hold."""

    def __init__(self, folder: Path, suffix: str, samples_per_file: int, *, single: bool) -> None:
        """Take the folder; files end in `suffix`, and with `single` each is of one sample, by its row."""
        self._folder, self._suffix, self._per_file, self._single = folder, suffix, samples_per_file, single

    def scan(self, parts: Sequence[Part]) -> tuple[list[int], list[Part]]:
        """The rows in files that are there, and those of the planned parts whose files are."""
        if self._single:
            files = (self._folder / SAMPLES).glob(f"*{self._suffix}")
            return sorted(int(file.stem) for file in files if file.stem.isdecimal()), []
        written = [part for part in parts if (self._folder / part.file).exists()]
        return sorted(row for part in written for row in parse_rows(part.rows)), written

    def plan(self, splits: Mapping[str, Sequence[int]], written: Sequence[Part]) -> tuple[list[Planned], list[Part]]:
        """The files for new rows, by their split, and all parts of the export: those written and the new ones."""
        if self._single:
            every = sorted(row for rows in splits.values() for row in rows)
            return [Planned(self._of_row(row), (row,)) for row in every], []
        taken = {part.file for part in written}
        planned, parts = [], list(written)
        for split, rows in splits.items():
            free = (name for i in count() if (name := f"{DATA}/{split}-{i:06d}{self._suffix}") not in taken)
            for start, name in zip(range(0, len(rows), self._per_file), free, strict=False):
                chosen = tuple(rows[start : start + self._per_file])
                planned.append(Planned(self._folder / name, chosen))
                parts.append(Part(file=name, rows=format_ranges(chosen)))
        return planned, parts

    def _of_row(self, row: int) -> Path:
        """The file of a sample that has one of its own."""
        return self._folder / SAMPLES / f"{row:08d}{self._suffix}"


FOLDER = "configurations"

OF_CONFIGURATION: tuple[Extra, ...] = ("points", "photons")
"""The extras that are written once per configuration."""

POINT_ARRAYS = ("position", "normal", "albedo", "emission", "present")


def check_extras(spec: SceneSpec, extras: Sequence[Extra]) -> None:
    """Raise SpecError if photons are asked for and the scene has none."""
    if "photons" in extras and not spec.photons.paths:
        raise SpecError(f"--with: 'photons' is not there: scene {spec.name} has photons.paths = 0")


def configuration_file(folder: Path, key: str) -> Path:
    """The file of the configuration with this content key, in the folder of an export."""
    return folder / FOLDER / f"{key}.npz"


def list_configurations(folder: Path) -> Iterator[str]:
    """The content keys of the configurations whose files are there."""
    return (file.stem for file in (folder / FOLDER).glob("[!.]*.npz"))


def write_configuration(file: Path, sample: Sample, extras: Sequence[Extra]) -> None:
    """Write what is asked for of a sample's configuration: points as they stand in it, (P, …), and photons, (K, …)."""
    arrays: dict[str, NDArray[Any]] = {"modification": sample.modification.vector}
    if "points" in extras:
        cloud = sample.point_cloud
        arrays |= {f"point_{name}": np.asarray(getattr(cloud, name)) for name in POINT_ARRAYS}
    if "photons" in extras:
        arrays |= {f"photon_{name}": np.asarray(values) for name, values in arrays_of(sample.photons).items()}
    write_arrays(file, arrays, "exported configuration")
