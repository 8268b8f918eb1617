"""Markers: a job is committed when its marker is there. The marker names the job's files, their sizes and checksums.

A small file beside a plan names its withdrawn jobs, whose rows count as unused.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Iterable, Mapping, Set
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from photonfarm.core.errors import CorruptError, StoreError, store_errors
from photonfarm.core.models import sentences
from photonfarm.store.io.storage import Storage, put_json

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


class Figures(_Stored):
    """The cost of a job, and what rendered it."""

    core_s: _Seconds  # processor time, all threads
    wall_s: _Seconds
    redrawn: Annotated[int, Field(ge=0)]  # renders thrown away for a non-finite value, and drawn again
    worker: str
    versions: Mapping[str, str]  # of the packages that rendered
    device: str = CPU  # what rendered; otherwise the name of a card
    driver: str = ""  # the version of the card's driver
    strategy: dict[str, Any] = {}  # how light was sampled, as `SceneSpec.strategy`
    taken_over: Annotated[int, Field(ge=0)] = 0  # samples whose halves were copied from another scene
    counts: dict[str, Annotated[int, Field(ge=0)]] = {}  # of what the job stored: `samples`, `black`, `views`, `near`


class _Marker(_Stored):
    job: Annotated[int, Field(ge=0)]
    files: dict[_ShardName, _File] = Field(min_length=1)  # by path below the scene's folder
    figures: Figures


def marker_name(scene: str, job: int) -> str:
    """The name of a job's marker; `scene` is the scene's folder."""
    return f"{scene}/{COMMITTED}/{job:0{_DIGITS}d}.json"


def place_marker(
    storage: Storage, scene: str, job: int, files: Mapping[str, Mapping[str, Any]], figures: Figures
) -> bool:
    """Place the marker of a job, whose files, named below the scene's folder, have settled; False if it was there."""
    return put_json(storage, {"job": job, "files": files, "figures": figures.model_dump()}, marker_name(scene, job))


def read_marker(storage: Storage, scene: str, job: int) -> dict[str, Any]:
    """The marker of a committed job: its files, by path below the scene's folder, and its figures.

    Raises CorruptError, with the file and the broken rule, for content that no job of ours has written.
    """
    name = marker_name(scene, job)
    try:
        content = storage.read(name)
    except OSError as error:
        raise StoreError(f"{storage.where}/{name}: cannot be read: {error.strerror}") from error
    return parse_marker(content, job, f"{storage.where}/{name}")


def parse_marker(content: bytes, job: int, where: str) -> dict[str, Any]:
    """The marker in a job's bytes, which are stored at `where`; raises CorruptError as `read_marker` does."""
    try:
        marker = _Marker.model_validate_json(content)
    except ValidationError as error:
        raise CorruptError(f"{where}: is not a marker: {'; '.join(sentences(error))}") from error
    if marker.job != job:
        raise CorruptError(f"{where}: is not a marker: job = {marker.job}: its name says {job}")
    return marker.model_dump(exclude_unset=True)


def parse_files(content: bytes, scene: str, job: int) -> dict[str, dict[str, Any]]:
    """The files that a marker names, with their sizes and checksums, by their names in the store."""
    named = parse_marker(content, job, marker_name(scene, job))["files"]
    return {f"{scene}/{name}": about for name, about in named.items()}


def list_jobs(storage: Storage, scene: str) -> set[int]:
    """The jobs of a scene that have a marker; costs one listing."""
    with store_errors("list the markers", f"{storage.where}/{scene}"):
        names = storage.names(f"{scene}/{COMMITTED}")
    return _parse_jobs(names)


def _parse_jobs(names: Iterable[str]) -> set[int]:
    """The jobs of those names in a folder of markers that are names of markers."""
    return {int(match[1]) for name in names if (match := _NAME.fullmatch(name))}


WHOLE_S = 600.0
"""The seconds after which all markers are listed again: only so is it seen that a repair has set jobs aside."""

LISTED_AT_ONCE = 1000
"""The names in an answer of a bucket."""


class FollowedMarkers:
    """The jobs of a scene that have a marker, looked at again and again by one process.

    In a bucket a listing costs a request for each thousand names, and a look each second would cost hundreds of them.
    Jobs are committed about in the order of their numbers; so a look asks for the few that are missing among the first
    ones, one by one, and lists what lies behind. In a folder a look lists all.
    """

    def __init__(self, storage: Storage, scene: str, *, clock: Callable[[], float] = time.monotonic) -> None:
        """Take the folder of a scene; nothing is listed yet."""
        self._storage, self._scene, self._clock = storage, scene, clock
        self._known: set[int] = set()
        self._whole_due = clock()

    def doubt(self) -> None:
        """List all markers at the next look: some may have been removed."""
        self._whole_due = self._clock()

    def look(self) -> set[int]:
        """The jobs that have a marker now.

        In a bucket, one that was there at an earlier look is taken to be there for WHOLE_S, unless there is a doubt.
        """
        now = self._clock()
        if not self._known or now >= self._whole_due or not self._storage.lists_behind:
            self._known = list_jobs(self._storage, self._scene)
            self._whole_due = now + WHOLE_S
        else:
            with store_errors("look for markers", f"{self._storage.where}/{self._scene}"):
                self._known |= self._list_new()
        return set(self._known)

    def _list_new(self) -> set[int]:
        """The jobs that were committed since the last look, by the fewest requests."""
        last = max(self._known)
        seen = np.zeros(last + 1, np.bool_)
        seen[list(self._known)] = True
        missing = np.flatnonzero(~seen)
        behind = np.append(missing, last + 1) - 1  # for 0, 1, 2, … of the missing asked for: the name to list behind
        asked = int(np.argmin(np.arange(len(behind)) + (last - behind) // LISTED_AT_ONCE))
        new = {job for job in missing[:asked].tolist() if self._storage.exists(marker_name(self._scene, job))}
        after = int(behind[asked])
        name = marker_name(self._scene, after).rpartition("/")[2] if after >= 0 else ""
        return new | _parse_jobs(self._storage.names_behind(f"{self._scene}/{COMMITTED}", name))


def withdrawn_file(plan: str) -> str:
    """The file of a plan, given its folder."""
    return f"{plan}.withdrawn.json"


def read_withdrawn(storage: Storage, plan: str) -> frozenset[int]:
    """The withdrawn jobs of a plan whose file is there; raises CorruptError if it names none."""
    name = withdrawn_file(plan)
    try:
        return frozenset(int(job) for job in json.loads(storage.read(name))["jobs"])
    except (ValueError, KeyError, TypeError) as error:
        raise CorruptError(f"{storage.where}/{name}: names no jobs: {error}; put it back from a copy") from error


def write_withdrawn(storage: Storage, plan: str, jobs: Set[int]) -> None:
    """Name the withdrawn jobs of a plan, in place of those named before."""
    put_json(storage, {"jobs": sorted(jobs)}, withdrawn_file(plan), replace=True)
