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
from photonfarm.shared.store.write.store import FAILURES_FOLDER, Store


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
    taken = lease(storage, scene_id, "store forget", on_wait)
    with taken as held, store_errors("forget a scene", storage.where):
        if not is_there(storage, scene_id):
            raise StoreError(f"{storage.where}: holds no scene {scene_id}")
        jobs = len(markers.jobs(storage, folder))
        below = f"{folder}/{plans.PLANS}"
        put_json(storage, {"jobs": jobs}, f"{below}/{plans.FORGOTTEN}{uuid4().hex}.json")
        numbers = reversed(range(plans.count(storage, folder)))
        folders = [f"{folder}/{markers.COMMITTED}", *(plans.folder(folder, n) for n in numbers), f"{folder}/base"]
        for each in folders:
            held.check()
            storage.delete_folder(each)
        left = [f"{below}/{name}" for name in storage.names(below) if not name.startswith(plans.FORGOTTEN)]
        failures = [name for name in storage.names(FAILURES_FOLDER) if name.startswith(f"{scene_id}-")]
        for each in (*left, *(f"{FAILURES_FOLDER}/{name}" for name in failures), f"{folder}/base.claim"):
            storage.delete(each)
        storage.delete(f"{folder}/spec.json")
    return Forgotten(scene_id, jobs)
