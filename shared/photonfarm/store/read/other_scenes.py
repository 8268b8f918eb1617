"""What to say where a store does not have the scene of a spec: which scenes it has, and how they differ."""

from __future__ import annotations

from collections.abc import Sequence

from photonfarm.core.errors import StoreError
from photonfarm.core.models import differing
from photonfarm.scene.spec import SceneSpec
from photonfarm.store.model.scene_store import SceneStore, list_scenes
from photonfarm.store.model.store import Store

FEW = 4
"""Up to so many differing keys are named."""


def check_scene(store: Store, name: str, spec: SceneSpec) -> str:
    """The id of a spec's scene, which the store holds; StoreError if it does not. `name` is the spec's for its user."""
    if not store.has_scene(spec.scene_id):
        where = store.storage.where
        raise StoreError(f"{where}: holds no samples of {name} (scene {spec.scene_id}); {describe_scenes(store, spec)}")
    return spec.scene_id


def describe_scenes(store: Store, spec: SceneSpec) -> str:
    """The scenes that a store has, in words, and where one of the spec's name differs from it."""
    alike = _alike(store, spec)
    if not alike:
        return list_scenes(store.storage)
    more = f"; {len(alike) - 1} more have this name" if alike[1:] else ""
    differ = describe_differences(alike[0].spec, spec)
    return f"scene {alike[0].scene_id} of this name is there and differs in {differ}{more}"


def note_first_plan(store: Store, spec: SceneSpec) -> str | None:
    """What to say of a scene's first plan where the store has another scene of this name; None where it has none."""
    for nearest in _alike(store, spec):
        differ = describe_differences(nearest.spec, spec)
        return f"scene {nearest.scene_id} of this name is another one, as {differ} differ: {describe_samples(nearest)}"
    return None


def find_same_radiance(store: Store, spec: SceneSpec) -> str | None:
    """The id of the other scene that has most complete samples of the same radiance id; None without one."""

    def complete(scene: SceneStore) -> int:
        alike = scene.spec.radiance_id == spec.radiance_id and scene.scene_id != spec.scene_id
        return scene.progress().committed_samples if alike else 0

    counted, _ = store.each(complete)
    best = max(counted, key=lambda scene_id: counted[scene_id], default=None)
    return best if best and counted[best] else None


def tell_apart(store: Store, scene_ids: Sequence[str]) -> str:
    """Scenes of one name in words: how many samples each has, and how it differs from the first."""
    first, *others = [store.scene(each) for each in scene_ids]
    said = [f"{first.scene_id} ({describe_samples(first)})"]
    said += [
        f"{each.scene_id} ({describe_samples(each)}; {describe_differences(first.spec, each.spec)} differ)"
        for each in others
    ]
    return ", ".join(said)


def describe_samples(scene: SceneStore) -> str:
    """How many samples of a scene are complete, in words."""
    try:
        found = scene.progress()
    except StoreError:
        return "its plans cannot be read"
    return f"{found.committed_samples} of {found.planned_samples} samples complete"


def describe_differences(there: SceneSpec, here: SceneSpec) -> str:
    """Where two specs differ in what ids cover, in words."""
    said = [
        "the scene's files" if key == "content" else f"{key} ({_say(a)} in the store, {_say(b)} asked for)"
        for key, (a, b) in differing(there.identity(), here.identity()).items()
    ]
    return ", ".join(said[:FEW]) + (f" and {len(said) - FEW} more" if said[FEW:] else "")


def _alike(store: Store, spec: SceneSpec) -> list[SceneStore]:
    """The other scenes of a spec's name; the one that differs least from it is the first."""
    there, _ = store.each(lambda scene: scene)
    alike = [each for each in there.values() if each.spec.name == spec.name and each.scene_id != spec.scene_id]
    return sorted(alike, key=lambda each: len(differing(each.spec.identity(), spec.identity())))


def _say(value: object) -> str:
    if value is None:
        return "not"
    text = f"{value:g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 40 else f"{text[:39]}…"
