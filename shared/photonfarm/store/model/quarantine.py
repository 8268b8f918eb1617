"""Damaged files are set aside, never deleted: moved to a folder of its own, with a record of what and why.

STORE/quarantine/000000/repair.json                  a repair: when; its number is claimed by placing this file
STORE/quarantine/000000/job-<scene id>-<job>.json    what was set aside of a job and why; base-…, spec-…, plan-…
alike
STORE/quarantine/000000/scenes/<scene id>/…          the files, under the names that they had

A repair has the scene's lease. The marker goes first: from then on the job is missing. So a repair may be killed at any
point: the record is there before anything moves; files not yet moved are data without a marker, which the next commit
of the job keeps if they are whole and replaces otherwise; and the next check finds whatever is still wrong.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from photonfarm.core.errors import CorruptError, store_errors
from photonfarm.store.format import markers
from photonfarm.store.io.storage import Storage, put_bytes, put_json, read_or_none
from photonfarm.store.model.findings import Finding

QUARANTINE = "quarantine"
_DIGITS = 6


class Quarantine:
    """One repair, which sets files aside. Nothing is written before there is one to set aside."""

    def __init__(self, storage: Storage, when: str) -> None:
        """Begin; `when` goes into the records."""
        self._storage = storage
        self._when = when
        self.folder: str | None = None  # its name in the store, once claimed

    def job(self, scene: str, job: int, marker: bytes, files: Iterable[str], why: Sequence[Finding]) -> bool:
        """Set a committed job aside: its marker, then its files; `scene` is the scene's folder.

        False if its marker is not `marker` any more: the job was committed anew since that was read. Raises StoreError.
        """
        with store_errors(f"set job {job} aside", self._storage.where):
            name = markers.marker_name(scene, job)
            if read_or_none(self._storage, name) != marker:
                return False
            there = [file for file in files if self._storage.exists(file)]
            self._record(f"job-{_id(scene)}-{job}", why, [name, *there], "workers find the job missing, and render it")
            self._move([name])
            self._move(there)
        return True

    def base(self, scene: str, why: Sequence[Finding]) -> bool:
        """Set a scene's geometry and base point cloud aside, for the next job to write them; False if none is there."""
        folder = f"{scene}/base"
        with store_errors("set the base aside", self._storage.where):
            if is_there := bool(self._storage.names(folder)):
                self._record(f"base-{_id(scene)}", why, [folder], "the next job that is rendered writes it")
                self._storage.move_folder(folder, f"{self._claimed()}/{folder}")
                self._storage.settle([folder, f"{self._claimed()}/{folder}"])
            return is_there

    def spec(self, scene: str, why: Sequence[Finding]) -> bool:
        """Set a scene's spec aside, so that the next submission of it writes it; False if it is not there."""
        name = f"{scene}/spec.json"
        with store_errors("set the spec aside", self._storage.where):
            if is_there := self._storage.exists(name):
                self._record(f"spec-{_id(scene)}", why, [name], "`photonfarm submit` of the same spec writes it")
                self._move([name])
            return is_there

    def rewrite(self, scene: str, plan: int, files: Mapping[str, Path], why: Sequence[Finding]) -> None:
        """Replace damaged files of a plan by new ones (parts); copies of the damaged ones are set aside first.

        No name is ever without bytes, so that no reader of the plan takes it for another one meanwhile.
        """
        with store_errors(f"write plan {plan} again", self._storage.where):
            held = {name: read_or_none(self._storage, name) for name in files}
            there = [name for name, content in held.items() if content is not None]
            self._record(f"plan-{_id(scene)}-{plan}", why, there, "written again from the plan's request")
            for name, part in files.items():
                if (content := held[name]) is not None:
                    put_bytes(self._storage, content, f"{self._claimed()}/{name}")
                self._storage.adopt(part, name, replace=True)
            self._storage.settle(files)

    # -----------------------------------------------------------------------------------------------------------------

    def _claimed(self) -> str:
        """The folder of this repair; repairs of other scenes at the same time get others."""
        number = 0
        while self.folder is None:
            number = max([number, *(int(name) + 1 for name in self._storage.names(QUARANTINE) if name.isdecimal())])
            folder = f"{QUARANTINE}/{number:0{_DIGITS}d}"
            if put_json(self._storage, {"when": self._when}, f"{folder}/repair.json"):
                self.folder = folder
            number += 1
        return self.folder

    def _record(self, name: str, why: Sequence[Finding], moved: Sequence[str], then: str) -> None:
        document: dict[str, Any] = {
            "when": self._when,
            "why": [{"cause": f.cause.label, "row": f.row, "file": f.file, "detail": f.detail} for f in why],
            "moved": list(moved),
            "then": then,
        }
        put_json(self._storage, document, f"{self._claimed()}/{name}.json")

    def _move(self, names: Sequence[str]) -> None:
        """Move files durably."""
        for name in names:
            with suppress(FileNotFoundError):  # two writers of a job may find the same marker wrong
                self._storage.move(name, f"{self._claimed()}/{name}")
        self._storage.settle([*names, *(f"{self._claimed()}/{name}" for name in names)])


def was_set_aside(storage: Storage, scene: str, job: int, marker: bytes) -> bool:
    """Whether a repair has moved a job's marker and all of its files away, and these were the same as they are now.

    If so, the job has been rendered again with the same result. Raises CorruptError for an invalid marker.
    """
    name, now = markers.marker_name(scene, job), markers.parse_files(marker, scene, job)
    for number in storage.names(QUARANTINE):
        folder = f"{QUARANTINE}/{number}"
        try:
            then = markers.parse_files(storage.read(f"{folder}/{name}"), scene, job)
        except (FileNotFoundError, NotADirectoryError, CorruptError):
            continue
        if then == now and all(storage.exists(f"{folder}/{file}") for file in then):
            return True
    return False


def _id(scene: str) -> str:
    """The id of the scene in a folder."""
    return scene.rpartition("/")[2]
