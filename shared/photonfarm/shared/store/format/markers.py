"""Markers: a job is committed when its marker is there. The marker names the job's files, their sizes and checksums."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from photonfarm.shared.core.errors import CorruptError, StoreError, store_errors
from photonfarm.shared.core.models import sentences
from photonfarm.shared.store.io.storage import Storage, put_json

COMMITTED = "committed"
_DIGITS = 12
_NAME = re.compile(rf"([0-9]{{{_DIGITS}}})\.json")

CPU = "cpu"
"""The device of jobs that a processor rendered."""

_Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False)]
_ShardName = Annotated[str, Field(pattern=r"^plans/[0-9]{6,}/[a-z0-9_]+/c(\.[0-9]+)+$")]


class _Stored(BaseModel):
    """A part of a marker. Unknown keys are kept: a later program of this version may have added them."""

    model_config = ConfigDict(frozen=True, strict=True, extra="allow")


class _File(_Stored):
    size: Annotated[int, Field(ge=1)]  # bytes
    crc32c: Annotated[str, Field(pattern=r"^[0-9a-f]{8}$")]  # of its rows' checksums and its index's


class _Figures(_Stored):
    core_s: _Seconds
    wall_s: _Seconds
    redrawn: Annotated[int, Field(ge=0)]
    worker: str
    versions: dict[str, str]  # of the packages that rendered
    device: str = CPU  # what rendered
    driver: str = ""
    strategy: dict[str, Any] = {}
    taken_over: Annotated[int, Field(ge=0)] = 0


class _Marker(_Stored):
    job: Annotated[int, Field(ge=0)]
    files: dict[_ShardName, _File] = Field(min_length=1)  # by path below the scene's folder
    figures: _Figures


def name_of(scene: str, job: int) -> str:
    """The name of a job's marker; `scene` is the scene's folder."""
    return f"{scene}/{COMMITTED}/{file_of(job)}"


def file_of(job: int) -> str:
    """The file of a job's marker, in the folder of markers."""
    return f"{job:0{_DIGITS}d}.json"


def place(
    storage: Storage, scene: str, job: int, files: Mapping[str, Mapping[str, Any]], figures: Mapping[str, Any]
) -> bool:
    """Place the marker of a job, whose files have settled; False if it was there already."""
    below = {name.removeprefix(f"{scene}/"): about for name, about in files.items()}
    return put_json(storage, {"job": job, "files": below, "figures": figures}, name_of(scene, job))


def read(storage: Storage, scene: str, job: int) -> dict[str, Any]:
    """The marker of a committed job: its files, by path below the scene's folder, and its figures.

    Raises CorruptError, with the file and the broken rule, for content that no job of ours has written.
    """
    name = name_of(scene, job)
    where = f"{storage.where}/{name}"
    try:
        content = storage.read(name)
    except OSError as error:
        raise StoreError(f"{where}: cannot be read: {error.strerror}") from error
    return parse(content, job, where)


def parse(content: bytes, job: int, where: str) -> dict[str, Any]:
    """The marker in a job's bytes, which are stored at `where`; raises CorruptError as `read` does."""
    try:
        document = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise CorruptError(f"{where}: is not a marker: {error}") from error
    return _checked(document, job, where)


def files(content: bytes, scene: str, job: int) -> dict[str, dict[str, Any]]:
    """The files that a marker names, with their sizes and checksums, by their names in the store; raises as `parse`."""
    named = parse(content, job, name_of(scene, job))["files"]
    return {f"{scene}/{name}": about for name, about in named.items()}


def _checked(document: Any, job: int, where: str) -> dict[str, Any]:
    if not isinstance(document, dict):
        raise CorruptError(f"{where}: is not a marker: it holds no JSON object")
    try:
        marker = _Marker.model_validate(document)
    except ValidationError as error:
        raise CorruptError(f"{where}: is not a marker: {'; '.join(sentences(error))}") from error
    if marker.job != job:
        raise CorruptError(f"{where}: is not a marker: job = {marker.job}: its name says {job}")
    return document


def jobs(storage: Storage, scene: str) -> set[int]:
    """The jobs of a scene that have a marker; costs one listing."""
    with store_errors("list the markers", f"{storage.where}/{scene}"):
        names = storage.names(f"{scene}/{COMMITTED}")
    return jobs_named(names)


def jobs_named(names: Iterable[str]) -> set[int]:
    """The jobs of those names in a folder of markers that are names of markers."""
    return {int(found[1]) for name in names if (found := _NAME.fullmatch(name))}
