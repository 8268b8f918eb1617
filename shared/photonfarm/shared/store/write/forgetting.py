"""`photonfarm store forget`: a scene with all that is planned and rendered of it is deleted.

A small file stays in the folder of its plans. By that, a process that knows the plans sees that they are gone, also
when others have been made under their numbers since. Markers go first, then the plans from the last to the first, then
the rest. So what is left by one that was killed is never taken for complete samples; to forget it again ends it.
"""

from __future__ import annotations

from dataclasses import dataclass
from uuid import uuid4

from photonfarm.shared.core.errors import StoreError, store_errors
from photonfarm.shared.store.format import markers
from photonfarm.shared.store.io.storage import put_json
from photonfarm.shared.store.write import plans
from photonfarm.shared.store.write.lease import OnWait, lease
from photonfarm.shared.store.write.scene_store import SCENES, is_there
from photonfarm.shared.store.write.store import Store


@dataclass(frozen=True, slots=True)
class Forgotten:
    """The outcome of forgetting a scene."""

    scene_id: str
    jobs: int  # committed ones that were deleted


def forget(store: Store, scene_id: str, *, on_wait: OnWait = lambda _: None) -> Forgotten:
    """Delete a scene, damaged or not; waits with `on_wait` for its lease. Raises StoreError if it is not there.

    What a repair has set aside of it stays in the quarantine.
    """
    storage, folder = store.storage, f"{SCENES}/{scene_id}"
    with lease(storage, scene_id, "store forget", on_wait), store_errors("forget a scene", storage.where):
        if not is_there(storage, scene_id):
            raise StoreError(f"{storage.where}: holds no scene {scene_id}")
        jobs = len(markers.jobs(storage, folder))
        below = f"{folder}/{plans.PLANS}"
        put_json(storage, {"jobs": jobs}, f"{below}/{plans.FORGOTTEN}{uuid4().hex}.json")
        storage.delete_folder(f"{folder}/{markers.COMMITTED}")
        for number in reversed(range(plans.count(storage, folder))):
            storage.delete_folder(plans.folder(folder, number))
        for name in storage.names(below):
            if not name.startswith(plans.FORGOTTEN):
                storage.delete(f"{below}/{name}")
        storage.delete_folder(f"{folder}/base")
        for name in ("base.claim", "spec.json"):
            storage.delete(f"{folder}/{name}")
    return Forgotten(scene_id, jobs)
