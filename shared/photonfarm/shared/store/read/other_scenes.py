"""What to say where a store does not have the scene of a spec: which scenes it has, and how they differ."""

from __future__ import annotations

from photonfarm.shared.core.errors import StoreError
from photonfarm.shared.core.models import differing
from photonfarm.shared.scene.spec import SceneSpec
from photonfarm.shared.store.write.scene_store import held
from photonfarm.shared.store.write.store import Store

FEW = 4
"""Up to so many differing keys are named."""

FILES = "the scene's files"
"""What the digest `content` is of."""


def scene_of(store: Store, name: str, spec: SceneSpec) -> str:
    """The id of a spec's scene, which the store holds; StoreError if it does not. `name` is the spec's for its user."""
    if not store.has_scene(spec.scene_id):
        where = store.storage.where
        raise StoreError(f"{where}: holds no samples of {name} (scene {spec.scene_id}); {other_scenes(store, spec)}")
    return spec.scene_id


def other_scenes(store: Store, spec: SceneSpec) -> str:
    """The scenes that a store has, in words, and where one of the spec's name differs from it."""
    there, _ = store.each(lambda scene: scene.spec)
    alike = [each for each in there.values() if each.name == spec.name]
    if not alike:
        return held(store.storage)
    compared = [(differing(each.identity(), spec.identity()), each) for each in alike]
    changes, nearest = min(compared, key=lambda found: len(found[0]))
    few = list(changes.items())[:FEW]
    more = f" and {len(changes) - len(few)} more" if len(changes) > len(few) else ""
    said = ", ".join(FILES if key == "content" else f"{key} ({_said(a)} there, {_said(b)} here)" for key, (a, b) in few)
    return f"scene {nearest.scene_id} of this name is there and differs in {said}{more}"


def _said(value: object) -> str:
    if value is None:
        return "not"
    text = f"{value:g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 40 else f"{text[:39]}…"
