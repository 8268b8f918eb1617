"""`photonfarm scene import`: from a file of another program to a spec that renders."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Collection
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from photonfarm.renderer.importing import elements, readers, splitting
from photonfarm.renderer.importing.changes import Changes
from photonfarm.renderer.importing.imported import Ids, ImportedScene, Vector
from photonfarm.renderer.importing.loading import load
from photonfarm.renderer.importing.proposal.groups import CELL, Thing, faces_of, find_things
from photonfarm.renderer.importing.proposal.pieces import Pieces
from photonfarm.renderer.importing.proposal.proposed import Proposal, propose
from photonfarm.renderer.importing.proposal.room import find_room
from photonfarm.renderer.importing.proposal.surfaces import Frame, Surfaces
from photonfarm.renderer.importing.spec_text import SpecText
from photonfarm.renderer.importing.writing import write_scene
from photonfarm.renderer.measure import exposure, free_space
from photonfarm.shared.core.errors import SpecError, store_errors
from photonfarm.shared.core.files import write_whole
from photonfarm.shared.core.waiting import Log, WorkLog
from photonfarm.shared.scene.spec_loading import load_spec

AXES: dict[str, Vector] = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}

GENERAL = ("scene", "scene_v3", "model", "untitled", "main", "export")
"""Names of files that say nothing; the folder's name is taken instead."""

FRAMES = 12
"""The views that the exposure is measured on: it is a proposal, and `scene exposure` renders more."""

DARKEST = 1e5
"""A higher exposure than this is of a scene whose lights do not reach what is seen."""


@dataclass(frozen=True, slots=True)
class Imported:
    """What was made."""

    spec: Path
    folder: Path  # of the scene's files
    changes: Changes  # from what the file says
    found: list[str]  # what is proposed, a line each

    def document(self) -> dict[str, Any]:
        """All of it, for JSON."""
        changes = [asdict(change) for change in self.changes]
        return {"spec": str(self.spec), "folder": str(self.folder), "changes": changes, "found": self.found}


def import_scene(
    path: Path, out: Path | None, up: Vector | None, log: Log, accept: Collection[str] = ()
) -> Imported:  # fmt: skip
    """Import a file: write a spec and, beside it, a folder with the scene.

    `accept` names changes of the picture that may be made, or their effects. Mitsuba must have been loaded. Raises
    SpecError for a file that cannot be imported, for changes that are not accepted, and for results that are there
    already; BackendError without Blender where it is needed. Then nothing is written.
    """
    read = readers.reader_of(path)
    spec = _place(path, out)
    folder = spec.with_name(f"{spec.stem}-scene")
    for there in (spec, folder):
        if there.exists():
            raise SpecError(f"{there}: is there already; give another name by --out, or take it away")
    with store_errors("write the scene", spec.parent):
        spec.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=spec.parent, prefix=".import-") as scratch, WorkLog(log) as work:
            scene = read(path, Path(scratch), work.begin)
            loaded = load(scene, Path(scratch), work.begin)
            scene.changes.refuse_unless(accept, str(path))
            return _import(scene, loaded, path, spec, folder, Path(scratch), up, work)


def _place(path: Path, out: Path | None) -> Path:
    """Where the spec goes: into the present folder, under the name of the file or of its folder."""
    if out is not None:
        return out if out.suffix == ".toml" else out.with_name(f"{out.name}.toml")
    folder = path.resolve().parent.name
    stem = folder if path.stem.lower() in GENERAL and folder else path.stem
    return Path(f"{stem}.toml")


def _import(
    scene: ImportedScene, loaded: Any, path: Path, spec: Path, folder: Path, scratch: Path, up: Vector | None,
    work: WorkLog,
) -> Imported:  # fmt: skip
    frame = Frame(up or scene.up)
    proposal, things, belonging = _proposal(scene, loaded, frame, work.begin)
    if not loaded.emitters() and not proposal.room.has_ceiling:
        elements.put_sky(scene.root)
        scene.changes.note("the scene has no light and no ceiling; it got a white sky")
    shapes = splitting.shapes_of_things(scene, loaded, belonging, len(things), scratch)
    written = scratch / "written"
    written.mkdir()
    work.begin("writing the scene")
    write_scene(scene, written)
    text = SpecText(_name(spec.stem), f"{folder.name}/scene.xml", path.name, frame, proposal, shapes, scene.changes)
    if not loaded.emitters() and proposal.room.has_ceiling:
        text.ceiling = proposal.ceiling_light()
    (scratch / folder.name).symlink_to(written.resolve(), target_is_directory=True)
    _keep_in_the_open(text, scratch / spec.name, work.begin)
    _expose(text, scratch / spec.name, work)
    shutil.move(str(written), folder)
    write_whole(spec, text.text())
    load_spec(spec)
    return Imported(spec, folder, scene.changes, _found(text))


def _proposal(scene: ImportedScene, loaded: Any, frame: Frame, log: Log) -> tuple[Proposal, list[Thing], Any]:
    surfaces = Surfaces.of(loaded, frame)
    log(f"looking for the room and what stands in it, among {len(surfaces.shape)} triangles")
    camera = None if scene.camera is None else frame.inward(np.array(scene.camera))
    room = find_room(loaded, surfaces, frame, camera)
    pieces = Pieces.of(surfaces, CELL * room.height)
    things = [] if room.is_stage else find_things(pieces, surfaces, room, scene.objects)
    thing_of = np.full(len(surfaces.shape), splitting.REST, np.int64)
    for number, thing in enumerate(things):
        thing_of[faces_of(thing, pieces)] = number
    proposal = propose(pieces, room, things, loaded, frame)
    return proposal, things, splitting.Belonging(surfaces.shape, thing_of)


def _name(stem: str) -> str:
    """A spec's name, like that of its file."""
    return Ids().make(stem.lstrip("._-"), "scene")


def _keep_in_the_open(text: SpecText, draft: Path, log: Log) -> None:
    """Put in where cameras may stand."""
    log("measuring where cameras may stand")
    draft.write_text(text.text(), encoding="utf-8")
    try:
        text.free_space = free_space.measure(load_spec(draft), draft.parent, log).entry()
    except SpecError as error:
        text.changes.note(f"cameras are not kept out of solids: {error}")


def _expose(text: SpecText, draft: Path, work: WorkLog) -> None:
    """Put the exposure in; a scene that stays dark gets a light under its ceiling."""
    work.begin("choosing the exposure by a quick render")
    for _ in range(2):  # the second time with a light that is added
        draft.write_text(text.text(), encoding="utf-8")
        spec = load_spec(draft)
        try:
            found = exposure.propose(spec, draft.parent, work, frames=FRAMES)
        except SpecError:
            if text.ceiling is not None:
                raise
        else:
            if found.exposure < DARKEST or text.ceiling is not None:
                text.exposure = float(f"{found.exposure:.3g}")
                return
        text.ceiling = text.proposal.ceiling_light()
        work.begin("the scene stays dark; a light is added under its ceiling")


def _found(text: SpecText) -> list[str]:
    room = text.proposal.room
    named = [movable.thing.name for movable in text.proposal.movables]
    static = "nothing was found that stands by itself; the scene is static (if it lies on its side, see --up)"
    lengths = " × ".join(f"{part:.3g}" for part in room.size)
    extent = f"no room; what is there is {lengths} units" if room.is_stage else f"room: {lengths} units"
    return [
        extent if room.has_ceiling else f"{extent}, without a ceiling",
        f"may move: {', '.join(named) or static}",
        f"lights: {'one is added under the ceiling' if text.ceiling else 'those of the file'}",
        f"exposure: {text.exposure:g}",
    ]
