"""What is asked of an export, and its manifest `export.json`: what a folder holds, from where, and what is to come."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from photonfarm.core.errors import StoreError, store_errors
from photonfarm.core.files import write_whole
from photonfarm.core.models import Frozen, sentences
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
    """A file with several samples."""

    file: Annotated[str, Field(pattern=r"^data/[a-z-]+-[0-9]{6,}\.[a-z]+$")]  # below the folder
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


def write(folder: Path, manifest: Manifest) -> None:
    """Write the manifest, whole; raises StoreError if the disk refuses."""
    text = json.dumps(manifest.model_dump(mode="json"), indent=1, ensure_ascii=False)
    with store_errors("write the manifest", folder):
        write_whole(folder / MANIFEST, text + "\n")


def read(folder: Path) -> Manifest | None:
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


def check(folder: Path, earlier: Manifest, wanted: Manifest) -> None:
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
