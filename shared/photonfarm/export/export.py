"""`photonfarm export`: what is complete of a scene, in a folder that may be continued and grows with the store."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from photonfarm.core.errors import IncompleteError, SpecError
from photonfarm.core.formatting import format_count
from photonfarm.core.waiting import tell_waiting
from photonfarm.export import card, folder
from photonfarm.export.card import Exported
from photonfarm.export.folder import ExportRequest, ExportSettings, Files, Manifest, Part, SceneName
from photonfarm.export.formats import Format, load_format
from photonfarm.export.snapshot import (
    GUIDES,
    Column,
    Contents,
    Snapshot,
    Values,
    describe_constants,
    format_ranges,
    list_columns,
    parse_buffers,
    parse_ranges,
    parse_rows,
)
from photonfarm.store import Store
from photonfarm.store.format.declarations import VERSION
from photonfarm.store.read.find import scene_or_spec

FILE_BYTES = 128 << 20
"""About how large a file of several samples becomes, unless their number is given."""

OnProgress = Callable[[int, int, int], None]
"""Called with the samples written, those to write, and the bytes of the values written."""


@dataclass(frozen=True, slots=True)
class Result:
    """What an export wrote."""

    folder: str
    scene_id: str
    samples: int  # in the folder
    new: int  # of them, written now
    new_files: int
    new_bytes: int  # of these files
    configurations: int  # in the folder


def export_scene(
    store: str | Path,
    scene: str,
    out: Path,
    request: ExportRequest,
    log: Callable[[str], None],
    on_progress: OnProgress,
) -> Result:
    """Export what is complete of a scene and not in the folder yet.

    Raises StoreError for a folder with something else in it, a scene that is not there, or a package that is missing;
    SpecError for what the scene does not have; IncompleteError if no sample is complete.
    """
    form = load_format(request.to)
    opened = Store(store)
    stored = scene_or_spec(opened, scene)
    spec, buffers, per_file = stored.spec, parse_buffers(request.buffers), request.samples_per_file
    if "photons" in request.extras and not spec.photons.paths:
        raise SpecError(f"--with: 'photons' is not there: scene {spec.name} has photons.paths = 0")
    if form.ONE_PER_FILE and per_file not in (None, 1):
        raise SpecError(f"--samples-per-file {per_file}: --to {request.to} has one sample per file")
    single = form.ONE_PER_FILE or (form.ONE_PER_FILE is None and per_file in (None, 1))
    columns = list_columns(spec, buffers, visibility="visibility" in request.extras)
    contents = Contents(columns, describe_constants(spec), single)
    settings = ExportSettings(
        to=request.to,
        buffers=buffers,
        extras=tuple(sorted(request.extras)),
        samples_per_file=1 if single else per_file or max(1, FILE_BYTES // _count_bytes(columns)),
        hold_out=request.hold_out,
    )
    name = SceneName(id=stored.scene_id, name=spec.name)
    wanted = Manifest(scene=name, store=opened.store_id, settings=settings, constants=contents.about)
    with folder.lock_folder(out, wanted) as current:
        guides = not set(GUIDES).isdisjoint(buffers)
        with tell_waiting(log, f"looking for what is complete of scene {spec.name} ({stored.scene_id})"):
            snapshot = Snapshot(store, stored, guides=guides, hold_out=settings.hold_out)
        log(f"{len(snapshot.rows)} of {snapshot.planned} planned samples are complete")
        return _Export(form, out, contents, current, log, on_progress).run(snapshot, request)


def _count_bytes(columns: Sequence[Column]) -> int:
    """The bytes of a sample's values, without text."""
    return sum(int(np.prod(each.shape)) * np.dtype(each.dtype).itemsize for each in columns if each.dtype != "str")


class _Export:
    """One run of an export, in a folder that is locked."""

    def __init__(
        self,
        form: type[Format],
        out: Path,
        contents: Contents,
        current: Manifest,
        log: Callable[[str], None],
        on_progress: OnProgress,
    ) -> None:
        self._form, self._out, self._contents, self._manifest = form, out, contents, current
        self._log, self._on_progress = log, on_progress
        self._files = Files(out, form.SUFFIX, current.settings.samples_per_file, single=contents.single)
        self._configurations = {file.stem for file in (out / folder.FOLDER).glob("[!.]*.npz")}
        self._done = self._total = 0

    def run(self, snapshot: Snapshot, request: ExportRequest) -> Result:
        """Write what is new, and then what describes the whole."""
        chosen = _choose_rows(snapshot, request)
        there, written = self._files.scan(self._manifest.parts)
        new = sorted(set(chosen) - set(there))
        splits = {split: [row for row in new if snapshot.split_of(row) == split] for split in ("train", "held-out")}
        planned = self._files.plan(splits, written)
        if there:
            self._log(f"{self._out} holds {format_count(len(there), 'sample')} already; new: {len(new)}")
        self._total = len(new)
        parts = () if self._contents.single else (*written, *planned)
        self._manifest = self._manifest.model_copy(update={"complete": False, "parts": parts})
        folder.write_manifest(self._out, self._manifest)
        written_bytes = 0
        for part in planned:
            file = self._out / part.file
            self._form.write(file, self._samples(snapshot, part), self._contents)
            written_bytes += file.stat().st_size
        rows = [*there, *new]
        with tell_waiting(self._log, f"describing {format_count(len(rows), 'sample')}"):
            self._manifest = self._manifest.model_copy(update=self._description(snapshot, rows))
            exported = Exported(self._out, snapshot, self._contents, self._manifest)
            self._form.finish(exported)
            card.write_card(exported)
            folder.write_manifest(self._out, self._manifest)
        shared = len(self._configurations)
        return Result(str(self._out), snapshot.spec.scene_id, len(rows), len(new), len(planned), written_bytes, shared)

    def _samples(self, snapshot: Snapshot, part: Part) -> Iterator[Values]:
        """The samples of a file; what belongs to their configurations is written before them."""
        extras = [each for each in self._manifest.settings.extras if each in folder.OF_CONFIGURATION]
        for row in parse_rows(part.rows):
            sample = snapshot.sample(row)
            values = snapshot.values(sample, self._contents.columns)
            key = values["configuration_key"]
            if extras and key not in self._configurations:
                folder.write_configuration(folder.configuration_file(self._out, key), sample, extras)
                self._configurations.add(key)
            yield values
            self._done += 1
            self._on_progress(self._done, self._total, self._done * _count_bytes(self._contents.columns))

    def _description(self, snapshot: Snapshot, rows: Collection[int]) -> dict[str, Any]:
        """What the manifest says of a folder with these rows."""
        before = self._manifest.versions.get("rendered_by", [])
        rendered = [*before, *(each for each in snapshot.versions if each not in before)]
        return {
            "complete": True,
            "samples": len(rows),
            "rows": format_ranges(rows),
            "configurations": len(self._configurations),
            "columns": tuple(column.describe() for column in self._contents.columns),
            "credits": snapshot.spec.credits and snapshot.spec.credits.model_dump(),
            "jobs": format_ranges(snapshot.jobs_of(rows)),
            "plans": tuple(snapshot.plans()),
            "versions": {"photonfarm": version("photonfarm"), "store": VERSION, "rendered_by": rendered},
        }


def _choose_rows(snapshot: Snapshot, request: ExportRequest) -> list[int]:
    """The rows that are asked for; raises IncompleteError if none of them is complete."""
    asked = parse_ranges(request.rows)
    rows = [row for row in snapshot.rows if not asked or any(row in span for span in asked)]
    if request.split != "all":
        rows = [row for row in rows if snapshot.split_of(row) == request.split]
    if not rows:
        narrowed = " that is asked for (--rows, --split)" if len(snapshot.rows) else ""
        raise IncompleteError(
            f"scene {snapshot.spec.name}: no sample{narrowed} is complete; `photonfarm status` shows what is missing"
        )
    return rows
