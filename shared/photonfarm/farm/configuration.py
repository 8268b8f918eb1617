"""A configuration as a user names it: a vector of numbers, or the content key of one that is planned."""

from __future__ import annotations

import numpy as np

from photonfarm.core.errors import SpecError, StoreError
from photonfarm.scene.modification import Modification, rest
from photonfarm.store import SceneStore, Store
from photonfarm.store.read.find import Query, find_samples


def find_configuration(store: Store, scene: SceneStore, text: str | None) -> Modification:
    """The configuration of `--modification VECTOR|KEY`, as `store find` takes it; without a text, the scene at rest.

    Raises SpecError for a vector of another number of groups, StoreError for a key that is in no plan.
    """
    if text is None:
        return rest(scene.spec)
    query = Query.of(modification=text)
    wanted, groups = query.modification, len(scene.spec.groups)
    if isinstance(wanted, np.ndarray):
        if wanted.size != 4 * groups:
            raise SpecError(
                f"--modification: has {wanted.size} numbers; {4 * groups} are required, 4 for each of the "
                f"{groups} movable groups of {scene.spec.name}"
            )
        return Modification.from_vector(wanted.reshape(groups, 4))
    samples = find_samples(store, [scene.scene_id], query, limit=1).samples
    if not samples:
        raise StoreError(f"--modification {text}: no plan of scene {scene.scene_id} has a configuration of this key")
    return Modification.from_vector(np.array(samples[0].modification, np.float32).reshape(groups, 4))
