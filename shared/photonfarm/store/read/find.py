"""`photonfarm store find`: samples by what stands where, by camera, key, row and job; and scenes by name.

Where a store does not have the scene of a spec, the messages here say which scenes it has, and how they differ.

Shape letters: R rows of a scene, N rows that match.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import CorruptError, SpecError, StoreError
from photonfarm.core.keys import Key, view_key
from photonfarm.core.models import differing, nearest
from photonfarm.plan.request import UNUSED, PlannedContent
from photonfarm.scene.arrangement import Shot, describe_shot
from photonfarm.scene.modification import Modification, modification_keys
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec
from photonfarm.scene.view import AXES, View, view_keys
from photonfarm.store.format import schema
from photonfarm.store.format.shards import Shard
from photonfarm.store.io.storage import look_into
from photonfarm.store.model import plans
from photonfarm.store.model.scene_store import SceneStore, list_scenes
from photonfarm.store.model.store import Store, name_of

_KEY = re.compile(r"[0-9a-fA-F]{32}")


@dataclass(frozen=True, slots=True, eq=False)
class Query:
    """The conditions on samples; None stands for any value."""

    asked: Shot | None = None  # what stands where, of the groups that it names, and the camera
    like: Key | None = None  # the content key of a configuration, a view or a sample
    sample: Key | None = None
    row: int | None = None
    job: int | None = None
    tolerance: float = 1e-3  # of positions, in scene units; 0: equal bit by bit

    @classmethod
    def of(cls, *, like: str | None = None, **others: Any) -> Query:
        """The query of the command line's options; raises SpecError for text that is no key."""
        if like is not None and not _KEY.fullmatch(like.strip()):
            raise SpecError(f"--like {like!r}: a key of 32 hexadecimal digits is required")
        return cls(like=None if like is None else bytes.fromhex(like.strip()), **others)


@dataclass(frozen=True, slots=True)
class Matches:
    """The result of a search."""

    count: int
    samples: tuple[FoundSample, ...]  # the nearest, then by scene and row
    nearest: float | None  # distance of the nearest sample, even if too far; None if there are no samples


def scene_named(store: Store, text: str) -> str:
    """The id of a scene, given its id, the beginning of its id, or its name; StoreError unless exactly one fits."""
    ids = store.scene_ids()
    matching = [each for each in ids if each == text] or [each for each in ids if text and each.startswith(text)]
    matching = matching or [each for each in ids if name_of(store, each) == text]
    if len(matching) > 1 and all(name_of(store, each) == text for each in matching):
        apart = tell_apart(store, matching)
        raise StoreError(f"{store.storage.where}: {len(matching)} scenes have the name {text!r}: {apart}; give an id")
    if len(matching) != 1:
        held = f"{len(matching)} scenes have" if matching else "no scene has"
        each_named = ", ".join(f"{each} ({name_of(store, each) or 'unreadable'})" for each in matching or ids)
        alike = "" if matching else f"; nearest: {nearest(text, {name_of(store, each) or '' for each in ids})}"
        known = f"give one of the ids {each_named}{alike}" if ids else "the store has no scenes yet"
        raise StoreError(f"{store.storage.where}: {held} the id or name {text!r}; {known}")
    return matching[0]


def is_spec_file(named: str) -> bool:
    """Whether a user names a scene by a spec's file, and not by its name or id."""
    return Path(named).suffix in (".toml", ".json")


def scene_or_spec(store: Store, named: str) -> SceneStore:
    """The scene that a user names by a spec's file, or as `scene_named` takes it.

    Raises StoreError, which names the scenes that are there and how one of the spec's name differs from it, and
    SpecError for a file that is no spec.
    """
    if is_spec_file(named):
        return store.scene(_find_scene_of_spec(store, load_spec(named), named))
    return store.scene(scene_named(store, named))


def find_samples(store: Store, scene_ids: Sequence[str], query: Query, *, limit: int = 20) -> Matches:
    """The samples of some scenes that match a query, described for the first `limit` of them.

    A scene without a group that the query names has no match. Raises StoreError, and SpecError where all lack it.
    """
    matches, refused = [], None
    for index, scene_id in enumerate(scene_ids):
        try:
            matches.append((index, SceneMatch(store.scene(scene_id), query)))
        except SpecError as error:
            refused = error
    if refused is not None and not matches:
        raise refused
    order = sorted(
        (
            (float(d), index, int(row), match)
            for index, match in matches
            for row, d in zip(match.rows[:limit], match.distance[:limit], strict=True)
        ),
        key=lambda entry: entry[:3],
    )
    nearest = [match.nearest for _, match in matches if match.nearest is not None]
    described = tuple(match.describe(row, distance) for distance, _, row, match in order[:limit])
    return Matches(sum(len(match.rows) for _, match in matches), described, min(nearest, default=None))


def find_start(store: str | Path, scene_id: str, row: int | None, like: str | None) -> tuple[Modification, View] | None:
    """What the sample in a row shows, or the first one of a configuration's, a view's or a sample's key; None for none.

    Raises StoreError if no plan of the scene has it, SpecError for text that is no key.
    """
    if row is None and like is None:
        return None
    found = find_samples(Store(store), [scene_id], Query.of(row=row, like=like), limit=1).samples
    if not found:
        named = " and ".join([f"--row {row}"] * (row is not None) + [f"--like {like}"] * (like is not None))
        raise StoreError(f"{named}: no plan of scene {scene_id} has such a sample; `photonfarm store find` shows them")
    groups = found[0].modification
    vector = np.array(groups, np.float32) if groups else np.zeros((0, 4), np.float32)
    return Modification.from_vector(vector), View.from_vector(np.array(found[0].view, np.float32))


F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Place:
    """The place of a row of an array in the store."""

    array: str
    file: str  # its name in the store
    chunk: int  # the inner chunk of that shard
    index: int  # along the first axis of the plan's array
    there: bool  # whether it is written yet


@dataclass(frozen=True, slots=True)
class FoundSample:
    """A sample and everything known of it without reading its arrays."""

    scene_id: str
    scene_name: str
    key: str
    row: int
    pass_: int
    modification_row: int
    modification_key: str
    modification: tuple[tuple[float, ...], ...]  # G times x, y, z, present
    shot: str  # configuration and view by names, as options of the command line
    view_row: int
    view_key: str
    view: tuple[float, ...]  # camera position, look-at point and, where each view has its own, field of view
    distance: float  # of the queried positions, the farthest, in scene units
    plan: int
    jobs: tuple[int, ...]  # of its own row, its view's and its modification's
    committed: tuple[bool, ...]  # these jobs
    places: tuple[Place, ...]

    @property
    def complete(self) -> bool:
        """Whether all of its jobs are committed."""
        return all(self.committed)


class SceneMatch:
    """The samples of one scene that match a query: their rows (N,), nearest first, and their distances (N,)."""

    rows: NDArray[np.int64]
    distance: F64

    def __init__(self, scene: SceneStore, query: Query) -> None:
        """Search all inputs of the plans at once."""
        self._scene = scene
        self._plans = scene.plans()
        self._committed: set[int] | None = None
        self.nearest: float | None = None  # distance of the nearest, even if too far
        self.rows, self.distance = np.zeros(0, np.int64), np.zeros(0)
        if self._plans:
            self._search(query)

    def _search(self, query: Query) -> None:
        """Set `rows`, `distance` and `nearest`. Distances are computed once per modification and per view."""
        inputs = plans.content(self._plans)
        modification, view = inputs.column("sample_modification"), inputs.column("sample_view")
        rows = np.flatnonzero(modification != UNUSED)
        if query.row is not None:
            rows = rows[rows == query.row]
        if query.job is not None:
            rows = rows[rows // self._plans[0].shard_rows == query.job]
        if query.sample is not None:
            rows = rows[_have_key(inputs.column("sample_key")[rows], query.sample)]
        if query.like is not None and len(rows):
            rows = self._choose_like(inputs, rows, query.like)
        distance = np.zeros(len(rows))
        if (asked := query.asked) is not None:
            distinct, place = np.unique(modification[rows], return_inverse=True)
            distance = asked.fits(spec := self._scene.spec, inputs.vectors("modification", distinct))[place]
            distinct, place = np.unique(view[rows], return_inverse=True)
            vectors = inputs.vectors("view", distinct).astype(np.float64)
            if asked.fov is not None:
                own = vectors[:, 6] if vectors.shape[1] > len(AXES) else np.full(len(vectors), spec.view.fov_deg)
                distance = np.maximum(distance, np.abs(own - np.float32(asked.fov))[place])
            for wanted, columns in ((asked.camera, slice(0, 3)), (asked.look_at, slice(3, 6))):
                if wanted is not None:
                    off = np.linalg.norm(vectors[:, columns] - np.array(wanted, np.float32), axis=1)
                    distance = np.maximum(distance, off[place])
        if np.isfinite(distance).any():
            self.nearest = float(distance.min())
        fits = distance <= query.tolerance
        order = np.argsort(distance[fits], kind="stable")
        self.rows, self.distance = rows[fits][order], distance[fits][order]

    def _choose_like(self, inputs: PlannedContent, rows: NDArray[np.int64], key: Key) -> NDArray[np.int64]:
        """Those of some rows whose sample has a key or, if none has, whose configuration, or else whose view."""
        like = _have_key(inputs.column("sample_key")[rows], key)
        if not like.any():
            distinct, place = np.unique(inputs.column("sample_modification")[rows], return_inverse=True)
            keys = modification_keys(self._scene.spec.radiance_id, inputs.vectors("modification", distinct))
            like = np.array([each == key for each in keys], np.bool_)[place]
        if not like.any():
            of_modification = dict(zip(distinct.tolist(), keys, strict=True))
            distinct, first, place = np.unique(
                inputs.column("sample_view")[rows], return_index=True, return_inverse=True
            )
            owners = inputs.column("sample_modification")[rows[first]].tolist()
            keys = view_keys([of_modification[row] for row in owners], inputs.vectors("view", distinct))
            like = np.array([each == key for each in keys], np.bool_)[place]
        return rows[like]

    # ------------------------------------------------------------------------------------------------------- describing

    def describe(self, row: int, distance: float) -> FoundSample:
        """Everything known of the sample in a row."""
        sample = plans.sample_at(self._plans, row)
        if sample is None:
            raise StoreError(f"row {row} of scene {self._scene.scene_id} is not used")
        if self._committed is None:
            self._committed = self._scene.committed_jobs()
        modification = plans.modification_at(self._plans, sample.modification_row)
        view = plans.view_at(self._plans, sample.view_row)
        key = modification.key(self._scene.spec.radiance_id)
        plan = plans.plan_of(self._plans, row)
        rows = {"sample": row, "view": sample.view_row, "modification": sample.modification_row}
        jobs = tuple(each // plan.shard_rows for each in rows.values())
        return FoundSample(
            scene_id=self._scene.scene_id,
            scene_name=self._scene.spec.name,
            key=sample.key.hex(),
            row=row,
            pass_=sample.pass_,
            modification_row=sample.modification_row,
            modification_key=key.hex(),
            modification=tuple(tuple(map(float, group)) for group in modification.vector),
            shot=describe_shot(self._scene.spec, modification, view),
            view_row=sample.view_row,
            view_key=view_key(key, view.vector).hex(),
            view=tuple(map(float, view.vector)),
            distance=distance,
            plan=plan.number,
            jobs=jobs,
            committed=tuple(job in self._committed for job in jobs),
            places=tuple(self._list_places(rows)),
        )

    def _list_places(self, rows: dict[str, int]) -> list[Place]:
        """Where each array has this sample, given its rows by kind; of radiance, only the array that has it."""
        places = []
        for name, array in schema.output_arrays(self._scene.spec).items():
            row = rows[array.kind]
            plan = plans.plan_of(self._plans, row)
            job, chunk = divmod(row, plan.shard_rows)
            file = plan.shard(name, array, job)
            there = self._is_there(file, array, chunk, plan.shard_rows)
            if there or name != "radiance_wide":  # which has only what float16 cannot hold
                places.append(Place(name, file, chunk, row - plan.first_row, there))
        if any(place.array == "radiance_wide" for place in places):  # and then `radiance` has nothing
            places = [place for place in places if place.array != "radiance" or place.there]
        return places

    def _is_there(self, file: str, array: schema.ArraySchema, chunk: int, shard_rows: int) -> bool:
        """Whether a shard has a chunk; a damaged one has none."""
        storage = self._scene.storage
        try:
            return storage.exists(file) and look_into(
                storage, file, lambda path: chunk in Shard(path, array, shard_rows)
            )
        except CorruptError:
            return False


def _have_key(keys: NDArray[np.uint8], wanted: Key) -> NDArray[np.bool_]:
    """Whether keys (N, 16) are the wanted one, (N,): each as two numbers, which are compared at once."""
    equal: NDArray[np.bool_] = (keys.view("<u8") == np.frombuffer(wanted, "<u8")).all(axis=1)
    return equal


MOST_DIFFERENCES = 4
"""The largest number of differing keys that a message names."""


def _find_scene_of_spec(store: Store, spec: SceneSpec, name: str) -> str:
    """The id of a spec's scene; StoreError if the store does not have it. `name` is what the user calls the spec."""
    if not store.has_scene(spec.scene_id):
        where = store.storage.where
        raise StoreError(f"{where}: holds no samples of {name} (scene {spec.scene_id}); {describe_scenes(store, spec)}")
    return spec.scene_id


def describe_scenes(store: Store, spec: SceneSpec) -> str:
    """The scenes that a store has, in words, and where one of the spec's name differs from it."""
    namesakes = _list_namesakes(store, spec)
    if not namesakes:
        return list_scenes(store.storage)
    more = f"; {len(namesakes) - 1} more have this name" if namesakes[1:] else ""
    differences = describe_differences(namesakes[0].spec, spec)
    return f"scene {namesakes[0].scene_id} of this name is there and differs in {differences}{more}"


def note_first_plan(store: Store, spec: SceneSpec) -> str | None:
    """What to say of a scene's first plan where the store has another scene of this name; None where it has none."""
    if not (namesakes := _list_namesakes(store, spec)):
        return None
    nearest, differ = namesakes[0], describe_differences(namesakes[0].spec, spec)
    return f"scene {nearest.scene_id} of this name is another one, as {differ} differ: {describe_samples(nearest)}"


def find_same_radiance(store: Store, spec: SceneSpec) -> str | None:
    """The id of that other scene of the spec's radiance id with the most complete samples; None if none has any."""

    def count_usable(scene: SceneStore) -> int:
        is_usable = scene.spec.radiance_id == spec.radiance_id and scene.scene_id != spec.scene_id
        return scene.progress().committed_samples if is_usable else 0

    usable, _ = store.each(count_usable)
    most = max(usable, key=lambda scene_id: usable[scene_id], default=None)
    return most if most and usable[most] else None


def tell_apart(store: Store, scene_ids: Sequence[str]) -> str:
    """Scenes of one name in words: how many samples each has, and how it differs from the first."""
    first, *others = [store.scene(each) for each in scene_ids]
    described = [f"{first.scene_id} ({describe_samples(first)})"]
    described += [
        f"{each.scene_id} ({describe_samples(each)}; {describe_differences(first.spec, each.spec)} differ)"
        for each in others
    ]
    return ", ".join(described)


def describe_samples(scene: SceneStore) -> str:
    """How many samples of a scene are complete, in words."""
    try:
        progress = scene.progress()
    except StoreError:
        return "its plans cannot be read"
    return f"{progress.committed_samples} of {progress.planned_samples} samples complete"


def describe_differences(there: SceneSpec, here: SceneSpec) -> str:
    """Where two specs differ in what ids cover, in words."""
    described = [
        "the scene's files"
        if key == "content"
        else f"{key} ({_describe(old)} in the store, {_describe(new)} asked for)"
        for key, (old, new) in differing(there.identity(), here.identity()).items()
    ]
    more = len(described) - MOST_DIFFERENCES
    return ", ".join(described[:MOST_DIFFERENCES]) + (f" and {more} more" if more > 0 else "")


def _list_namesakes(store: Store, spec: SceneSpec) -> list[SceneStore]:
    """The other scenes of a spec's name; the one that differs least from it is the first."""
    scenes, _ = store.each(lambda scene: scene)
    namesakes = [each for each in scenes.values() if each.spec.name == spec.name and each.scene_id != spec.scene_id]
    return sorted(namesakes, key=lambda each: len(differing(each.spec.identity(), spec.identity())))


def _describe(value: object) -> str:
    if value is None:
        return "not"  # as in "not in the store"
    text = f"{value:g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 40 else f"{text[:39]}…"
