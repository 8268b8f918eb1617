"""`photonfarm scene import`: from a file of another program to a spec that renders."""

from __future__ import annotations

import gc
import shutil
import tempfile
from collections.abc import Collection
from dataclasses import asdict, dataclass, replace
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np

from photonfarm.core.errors import SpecError, store_errors
from photonfarm.core.files import write_whole
from photonfarm.core.waiting import Log, WorkLog
from photonfarm.renderer.tools.importing import elements, readers
from photonfarm.renderer.tools.importing.changes import Changes
from photonfarm.renderer.tools.importing.imported import ImportedScene, Vector
from photonfarm.renderer.tools.importing.loading import load, shapes_of_things
from photonfarm.renderer.tools.importing.proposal.groups import group_name
from photonfarm.renderer.tools.importing.proposal.proposed import propose
from photonfarm.renderer.tools.importing.proposal.surfaces import Frame
from photonfarm.renderer.tools.importing.spec_text import SpecText
from photonfarm.renderer.tools.measure import exposure, free_space
from photonfarm.renderer.tools.measure.exposure import DarkError
from photonfarm.scene.spec_loading import load_spec

AXES: dict[str, Vector] = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}

GENERAL = ("scene", "scene_v3", "model", "untitled", "main", "export")
"""Names of files that say nothing; the folder's name is taken instead."""

MESHES = (".ply", ".obj", ".serialized")

DARKEST = 1e5
"""A higher exposure than this is of a scene whose lights do not reach what is seen."""

LIT = {True: exposure.TARGET, False: 0.1}
"""The least share of lit pixels, by whether there is a ceiling: outdoors, the background may be black."""

BY_HAND = (
    "write view.origin (where cameras stand), view.look_at (what they see) and `at` of a [[lights]] by hand, and try "
    "them by `photonfarm scene check`"
)


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


def import_scene(path: Path, out: Path | None, up: Vector | None, log: Log, accept: Collection[str] = ()) -> Imported:
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
            try:
                scene = read(path, Path(scratch), work.begin)
                loaded = load(scene, Path(scratch), work.begin)
                scene.changes.refuse_unless(accept, str(path))
                return _import(scene, loaded, path, spec, folder, Path(scratch), up, work)
            except SpecError as error:  # what lies in the scratch folder is gone when this is read
                gone = (f"{Path(scratch).resolve()}/", f"{Path(scratch)}/")
                raise SpecError(str(error).replace(gone[0], "").replace(gone[1], "")) from error


def _place(path: Path, out: Path | None) -> Path:
    """Where the spec goes: into the present folder, under the name of the file or of its folder."""
    if out is not None:
        return out if out.suffix == ".toml" else out.with_name(f"{out.name}.toml")
    folder = path.resolve().parent.name
    stem = folder if path.stem.lower() in GENERAL and folder else path.stem
    return Path(f"{stem}.toml")


def _import(
    scene: ImportedScene,
    loaded: Any,
    path: Path,
    spec: Path,
    folder: Path,
    scratch: Path,
    up: Vector | None,
    work: WorkLog,
) -> Imported:
    frame = Frame(up or scene.up)
    camera = None if scene.camera is None else frame.inward(np.array(scene.camera))
    proposal = propose(loaded, frame, camera, scene.objects, work.begin)
    if proposal.has_others:
        scene.changes.note(
            "there are other rooms; this is the one with most that may move, unless the file has a camera in another"
        )
    shapes = shapes_of_things(scene, loaded, proposal.shape, proposal.thing)
    scene.write_meshes(scratch / "meshes")
    work.begin("writing the scene")
    _write_scene(scene, scratch / folder.name)
    name, file = group_name(spec.stem), f"{folder.name}/scene.xml"
    shapeless = [str(node.get("id") or node.get("type")) for node in scene.root.findall("emitter")]
    text = SpecText(name, file, path.name, frame, proposal, shapes, shapeless, scene.changes, proposal.views[0])
    text = _lit(text, scene, loaded, scratch / spec.name, work)
    shutil.move(scratch / folder.name, folder)
    write_whole(spec, text.text())
    load_spec(spec)
    return Imported(spec, folder, scene.changes, text.describe())


def _write_scene(scene: ImportedScene, folder: Path) -> None:
    """Write the scene into a folder, with copies of all files that it names, by relative names."""
    folder.mkdir()
    names: dict[str, str] = {}
    for node, key in elements.file_names(scene.root):
        source = Path(node.get(key, ""))
        if str(source) not in names:
            kind = "meshes" if source.suffix.lower() in MESHES else "textures"
            others = (f"{kind}/{source.stem}_{number}{source.suffix}" for number in count(2))
            taken = {name.lower() for name in names.values()}
            name = next(name for name in chain([f"{kind}/{source.name}"], others) if name.lower() not in taken)
            (folder / kind).mkdir(exist_ok=True)
            shutil.copyfile(source, folder / name)
            names[str(source)] = name
        node.set(key, names[str(source)])
    elements.write(scene.root, folder / "scene.xml")


def _lit(text: SpecText, scene: ImportedScene, loaded: Any, draft: Path, work: WorkLog) -> SpecText:
    """The spec with all that is measured, by the scene's own lights or, where they do not reach what cameras see, more.

    Each time all of it is measured, as free space and exposure hold for one choice of lights.
    """
    room = text.proposal.room
    if loaded.emitters():
        try:
            return _measure(text, draft, LIT[room.has_ceiling], work)
        except DarkError:
            work.begin("the scene's own lights do not reach what cameras see; one is added")
    if room.has_ceiling or loaded.environment() is not None:
        text = replace(text, adds_light=True)
    else:
        elements.put_sky(scene.root)
        elements.write(scene.root, draft.parent / text.file)
        scene.changes.note("no light reaches what cameras see, and there is no ceiling; the scene got a white sky")
    try:
        return _measure(text, draft, 0.01, work)
    except DarkError:
        scene.changes.note(f"no view was found that shows anything lit; {BY_HAND}")
        return text


def _measure(text: SpecText, draft: Path, least: float, work: WorkLog) -> SpecText:
    """The spec with the first view of which enough is free, where cameras may stand, and the exposure.

    Raises DarkError where fewer pixels than the share `least` are lit, or hardly.
    """
    for view in text.proposal.views:
        tried = replace(text, view=view)
        work.begin("measuring where cameras may stand")
        draft.write_text(tried.text(), encoding="utf-8")
        try:
            entry = free_space.measure(load_spec(draft), draft.parent, work.begin).entry()
        except free_space.NothingFreeError:
            continue
        text = replace(tried, free_space=entry)
        break
    else:
        text.changes.note(f"no place was found from which cameras see what is there; {BY_HAND}")
    work.begin("choosing the exposure by a quick render")
    draft.write_text(text.text(), encoding="utf-8")
    gc.collect()  # scenes that are collected while Dr.Jit records would end the program
    proposed = exposure.propose(load_spec(draft), draft.parent, work, least=least).exposure
    if proposed > DARKEST:
        raise DarkError(f"exposure {proposed:.3g}")
    return replace(text, exposure=float(f"{proposed:.3g}"))
