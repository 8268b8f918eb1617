"""`photonfarm store find`: samples by their content (modification, view, keys), or by row and job."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from photonfarm.shared.core.errors import StoreError
from photonfarm.shared.scene.spec_loading import load_spec
from photonfarm.shared.store.read.other_scenes import scene_of, told_apart
from photonfarm.shared.store.read.query import Query
from photonfarm.shared.store.read.scene_match import FoundSample, Place, SceneMatch
from photonfarm.shared.store.write.scene_store import SceneStore
from photonfarm.shared.store.write.store import Store

__all__ = ["FoundSample", "Matches", "Place", "Query", "find_samples", "scene_named", "scene_or_spec"]


@dataclass(frozen=True, slots=True)
class Matches:
    """The result of a search."""

    count: int
    samples: tuple[FoundSample, ...]  # the nearest, then by scene and row
    nearest: float | None  # distance of the nearest sample, even if too far; None if there are no samples


def scene_named(store: Store, text: str) -> str:
    """The id of a scene, given its id, the beginning of its id, or its name; StoreError unless exactly one fits."""
    ids = store.scene_ids()
    found = [each for each in ids if each == text] or [each for each in ids if text and each.startswith(text)]
    found = found or [each for each in ids if _name(store, each) == text]
    if len(found) > 1 and all(_name(store, each) == text for each in found):
        apart = told_apart(store, found)
        raise StoreError(f"{store.storage.where}: {len(found)} scenes have the name {text!r}: {apart}; give an id")
    if len(found) != 1:
        held = f"{len(found)} scenes have" if found else "no scene has"
        each_named = ", ".join(f"{each} ({_name(store, each) or 'unreadable'})" for each in found or ids)
        known = f"give one of the ids {each_named}" if ids else "the store has no scenes yet"
        raise StoreError(f"{store.storage.where}: {held} the id or name {text!r}; {known}")
    return found[0]


def is_spec_file(named: str) -> bool:
    """Whether a user names a scene by a spec's file, and not by its name or id."""
    return Path(named).suffix in (".toml", ".json")


def scene_or_spec(store: Store, named: str) -> SceneStore:
    """The scene that a user names by a spec's file, or as `scene_named` takes it.

    Raises StoreError, which names the scenes that are there and how one of the spec's name differs from it, and
    SpecError for a file that is no spec.
    """
    return store.scene(scene_of(store, named, load_spec(named)) if is_spec_file(named) else scene_named(store, named))


def _name(store: Store, scene_id: str) -> str | None:
    """The name of a scene; None if its spec is unreadable: then it has to be named by its id."""
    try:
        return store.scene(scene_id).spec.name
    except StoreError:
        return None


def find_samples(store: Store, scene_ids: Sequence[str], query: Query, *, limit: int = 20) -> Matches:
    """The samples of some scenes that match a query, described for the first `limit` of them.

    A scene whose number of movable groups differs from the query's vector has no match. Raises StoreError.
    """
    found = [(index, SceneMatch(store.scene(scene_id), query)) for index, scene_id in enumerate(scene_ids)]
    order = sorted(
        ((float(d), index, int(row), match) for index, match in found
         for row, d in zip(match.rows[:limit], match.distance[:limit], strict=True)),
        key=lambda entry: entry[:3],
    )  # fmt: skip
    nearest = [match.nearest for _, match in found if match.nearest is not None]
    described = tuple(match.describe(row, distance) for distance, _, row, match in order[:limit])
    return Matches(sum(len(match.rows) for _, match in found), described, min(nearest, default=None))
