"""The folder of an export: what is asked of it, its manifest `export.json`, the rows that its files hold, and its lock.

What samples of one configuration share, its point cloud and its photons, is in a file of its own.

Shape letters: P points, K photon slots.
"""

from __future__ import annotations

import fcntl
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from photonfarm.core.archives import write_arrays
from photonfarm.core.errors import StoreError, store_errors
from photonfarm.core.files import write_whole
from photonfarm.core.models import Frozen, sentences
from photonfarm.core.records import arrays_of
from photonfarm.data import Sample
from photonfarm.export.snapshot import format_ranges, parse_rows
from photonfarm.plan.hold_out import HOLD_OUT

FormatName = Literal["webdataset", "exr", "npz", "parquet"]
Extra = Literal["points", "photons", "visibility"]


class ExportSettings(Frozen):
    """What every sample of an export holds, and in which files: the same for all of a folder's."""

    to: FormatName
    buffers: tuple[str, ...]  # names of buffers and guides
    extras: tuple[Extra, ...] = ()  # what is exported only where it is asked for
    samples_per_file: Annotated[int, Field(ge=1)]
    hold_out: Annotated[float, Field(gt=0, lt=1)]  # the share of configurations labelled as held out


@dataclass(frozen=True, slots=True)
class ExportRequest:
    """What a user asks to be exported."""

    to: FormatName
    split: Literal["all", "train", "held-out"] = "all"
    rows: str = ""  # such as 0-31,40; "": all
    buffers: str = "all"
    extras: tuple[Extra, ...] = ()
    samples_per_file: int | None = None  # None: as many as the format has, or as make 128 MB
    hold_out: float = HOLD_OUT


MANIFEST = "export.json"
RowText = Annotated[str, Field(pattern=r"^[0-9,-]*$")]


class _Read(BaseModel):
    """A part of the manifest. Unknown keys are ignored: a later program may have added them."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class SceneName(_Read):
    """The scene that the samples are of."""

    id: str
    name: str


class Part(_Read):
    """A file with samples."""

    file: Annotated[str, Field(pattern=r"^(data/[a-z-]+-[0-9]{6,}|samples/[0-9]{8,})\.[a-z]+$")]  # below the folder
    rows: RowText  # such as 0-31,40


class Manifest(_Read):
    """Everything about an export but its samples."""

    format: Literal["photonfarm export"] = "photonfarm export"
    version: Literal[1] = 1
    complete: bool = False  # False: files of `parts` may be missing, and the same command writes them
    scene: SceneName
    store: str  # the store's id
    settings: ExportSettings
    samples: int = 0
    rows: RowText = ""  # the rows of the store that the folder holds
    parts: tuple[Part, ...] = ()  # of formats with several samples in a file
    configurations: int = 0  # files in configurations/
    constants: dict[str, Any] = {}  # what is the same for all samples
    columns: tuple[dict[str, Any], ...] = ()  # what each sample holds, with types, shapes, units and meanings
    credits: dict[str, str] | None = None
    jobs: RowText = ""  # the committed jobs that the samples came from
    plans: tuple[dict[str, Any], ...] = ()
    versions: dict[str, Any] = {}


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write the manifest, whole; raises StoreError if the disk refuses."""
    text = json.dumps(manifest.model_dump(mode="json"), indent=1, ensure_ascii=False)
    with store_errors("write the manifest", folder):
        write_whole(folder / MANIFEST, text + "\n")


def read_manifest(folder: Path) -> Manifest | None:
    """The manifest of a folder; None if it has none. Raises StoreError for one that cannot be read."""
    file = folder / MANIFEST
    remedy = "remove that folder, or give another one with --out"
    try:
        return Manifest.model_validate_json(file.read_bytes())
    except FileNotFoundError:
        return None
    except ValidationError as error:
        raise StoreError(f"{file}: is not the manifest of an export: {next(sentences(error))}; {remedy}") from error
    except OSError as error:
        raise StoreError(f"{file}: cannot be read: {error.strerror}") from error


def check_settings(folder: Path, earlier: Manifest, wanted: Manifest) -> None:
    """Raise StoreError if a folder's export is of another scene, another store, or with other settings."""
    remedy = "give another folder with --out"
    if earlier.scene.id != wanted.scene.id:
        scenes = (
            f"scene {earlier.scene.id} ({earlier.scene.name}), and {wanted.scene.id} ({wanted.scene.name}) was asked"
        )
        raise StoreError(f"{folder}: holds an export of {scenes} for; {remedy}")
    if earlier.store != wanted.store:
        raise StoreError(f"{folder}: holds an export of the store {earlier.store}, not of {wanted.store}; {remedy}")
    for name, said in earlier.settings:
        if said != (asked := getattr(wanted.settings, name)):
            option = "--with" if name == "extras" else f"--{name.replace('_', '-')}"
            differ = f"{option} {_format_value(said)}, and {_format_value(asked)} was asked for"
            raise StoreError(f"{folder}: holds an export with {differ}; ask for the same, or {remedy}")


def _format_value(value: Any) -> str:
    return (",".join(value) or "none") if isinstance(value, tuple) else str(value)


LOCK = ".lock"
DATA, SAMPLES = "data", "samples"
"""The folders of files with several samples, and of those with one."""


@contextmanager
def lock_folder(folder: Path, wanted: Manifest) -> Iterator[Manifest]:
    """Make the folder and lock it; gives the manifest to go on with, which is the wanted one in a new folder.

    Raises StoreError if the folder holds something else, or another process exports into it.
    """
    with store_errors("export into this folder", folder):
        folder.mkdir(parents=True, exist_ok=True)
        names = [each.name for each in folder.iterdir() if each.name != LOCK and ".partial" not in each.name]
        if names and MANIFEST not in names:
            foreign = min(names)  # what no export of ours has begun
            raise StoreError(f"{folder}: is neither empty nor an export (it holds {foreign!r}); give another folder")
        file = (folder / LOCK).open("ab")
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise StoreError(f"{folder}: another process exports into it; wait, or give another folder") from error
        earlier = read_manifest(folder)
        if earlier is not None:
            check_settings(folder, earlier, wanted)
            wanted = wanted.model_copy(update={"parts": earlier.parts, "versions": earlier.versions})
        with store_errors("remove unfinished files", folder):
            for part in folder.rglob(".*.partial*"):  # of killed processes
                part.unlink(missing_ok=True)
        yield wanted


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

    def plan(self, splits: Mapping[str, Sequence[int]], written: Sequence[Part]) -> list[Part]:
        """The files for new rows, by their split."""
        if self._single:
            every = sorted(row for rows in splits.values() for row in rows)
            return [Part(file=f"{SAMPLES}/{row:08d}{self._suffix}", rows=str(row)) for row in every]
        taken, planned = {part.file for part in written}, []
        for split, rows in splits.items():
            free = (name for i in count() if (name := f"{DATA}/{split}-{i:06d}{self._suffix}") not in taken)
            for start, name in zip(range(0, len(rows), self._per_file), free, strict=False):
                planned.append(Part(file=name, rows=format_ranges(rows[start : start + self._per_file])))
        return planned


FOLDER = "configurations"

OF_CONFIGURATION: tuple[Extra, ...] = ("points", "photons")
"""The extras that are written once per configuration."""

POINT_ARRAYS = ("position", "normal", "albedo", "emission", "present")


def configuration_file(folder: Path, key: str) -> Path:
    """The file of the configuration with this content key, in the folder of an export."""
    return folder / FOLDER / f"{key}.npz"


def write_configuration(file: Path, sample: Sample, extras: Sequence[Extra]) -> None:
    """Write what is asked for of a sample's configuration: points as they stand in it, (P, …), and photons, (K, …)."""
    arrays: dict[str, NDArray[Any]] = {"modification": sample.modification.vector}
    if "points" in extras:
        cloud = sample.point_cloud
        arrays |= {f"point_{name}": np.asarray(getattr(cloud, name)) for name in POINT_ARRAYS}
    if "photons" in extras:
        arrays |= {f"photon_{name}": np.asarray(values) for name, values in arrays_of(sample.photons).items()}
    write_arrays(file, arrays, "exported configuration")
