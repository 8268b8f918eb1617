"""`store withdraw`: what a plan holds and nobody has rendered may be planned again. `store forget`: a scene is deleted.

*Withdrawn.* The plan stays as it is. A small file beside it names the jobs whose rows count as unused from now on.

*Forgotten.* A small file stays in the folder of its plans. By that, a process that knows the plans sees that they are
gone, also when others have been made under their numbers since. Markers go first, then the plans from the last to the
first, then the rest. So what is left by one that was killed is never taken for complete samples; to forget it again
ends it.
"""

from __future__ import annotations

from dataclasses import dataclass
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import SpecError, StoreError, store_errors
from photonfarm.core.formatting import format_count
from photonfarm.plan.request import UNUSED
from photonfarm.store.format import markers
from photonfarm.store.io.storage import put_json
from photonfarm.store.model import plans
from photonfarm.store.model.lease import OnWait, hold_lease
from photonfarm.store.model.plans import StoredPlan
from photonfarm.store.model.scene_store import SCENES, SceneStore, is_there
from photonfarm.store.model.store import FAILURES_FOLDER, Store


@dataclass(frozen=True, slots=True)
class Withdrawal:
    """The outcome of a withdrawal."""

    scene_id: str
    name: str
    plan: int
    jobs: int  # withdrawn now
    samples: int  # forgotten now
    rendered: int  # samples of the plan in committed jobs, which stay
    kept: int  # samples that stay planned, as rendered ones show their views or configurations
    left: str  # what is planned still and not rendered, by plan, in words


def withdraw(scene: SceneStore, number: int | None = None, *, on_wait: OnWait = lambda _: None) -> Withdrawal:
    """Withdraw the jobs of a plan, by default of the last one that has such, that are not committed.

    Jobs that hold views or configurations of committed ones stay planned. Raises SpecError for a plan that is not
    there, and where samples of a later plan refer to its rows. It waits with `on_wait` for the scene's lease.
    """
    storage = scene.storage
    with hold_lease(storage, scene.scene_id, "store withdraw", on_wait), store_errors("withdraw a plan", storage.where):
        return _withdraw(scene, number)


def _withdraw(scene: SceneStore, number: int | None) -> Withdrawal:
    stored_plans, committed = scene.plans(), scene.committed_jobs()
    if not stored_plans or (number is not None and number >= len(stored_plans)):
        there = (
            f"the last one is {len(stored_plans) - 1}; {_left(stored_plans, committed)}"
            if stored_plans
            else "nothing is planned"
        )
        raise SpecError(f"scene {scene.scene_id} ({scene.spec.name}): has no plan {number or 0}; {there}")
    for plan in reversed(stored_plans) if number is None else [stored_plans[number]]:
        jobs = _withdrawable(scene, stored_plans, plan, committed)
        if jobs:
            markers.write_withdrawn(scene.storage, plan.folder, plan.withdrawn | jobs)
            break
    samples = {job: plan.samples_in(job) for job in range(plan.first_job, plan.end_job)}
    rendered = sum(count for job, count in samples.items() if job in committed)
    forgotten = sum(samples[job] for job in jobs)
    return Withdrawal(
        scene.scene_id,
        scene.spec.name,
        plan.number,
        len(jobs),
        forgotten,
        rendered,
        sum(samples.values()) - rendered - forgotten,
        _left(stored_plans, committed | jobs),
    )


def _left(stored_plans: list[StoredPlan], done: set[int]) -> str:
    """What is planned in other jobs than those that are done, in words."""
    jobs = {plan.number: set(range(plan.first_job, plan.end_job)) - done for plan in stored_plans}
    samples = {plan.number: sum(map(plan.samples_in, jobs[plan.number])) for plan in stored_plans}
    left = ", ".join(f"{format_count(count, 'sample')} of plan {number}" for number, count in samples.items() if count)
    return f"not rendered yet: {left or 'none'}"


def _withdrawable(scene: SceneStore, stored_plans: list[StoredPlan], plan: StoredPlan, committed: set[int]) -> set[int]:
    """The jobs of a plan that can be withdrawn: not committed, and no sample that stays refers to their rows."""
    jobs = set(range(plan.first_job, plan.end_job)) - committed - plan.withdrawn
    while True:
        leant_on: set[int] = set()
        for other in stored_plans[plan.number :]:
            own, referred = _references(other)
            leaning = ~np.isin(own, list(jobs)) & np.isin(referred, list(jobs)).any(axis=1)
            leant_on = jobs & set(referred[leaning].ravel().tolist())
            if other.number > plan.number and not committed.issuperset(own[leaning].tolist()):
                of = f"plan {plan.number} of scene {scene.scene_id} ({scene.spec.name})"
                why = f"plan {other.number} has samples of its views or configurations"
                first = f"withdraw plan {other.number} first; {_left(stored_plans, committed)}"
                raise SpecError(f"{of}: {why}; {first}")
            if leant_on:
                break
        if not leant_on:
            return jobs
        jobs -= leant_on


def _references(plan: StoredPlan) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The job of each sample of a plan, (N,), and the jobs of its view and of its configuration, (N, 2)."""
    used = np.flatnonzero(plan.rows.sample_modification != UNUSED)
    referred = np.stack([plan.rows.sample_view[used], plan.rows.sample_modification[used]], axis=1)
    return (plan.first_row + used) // plan.shard_rows, referred // plan.shard_rows


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
    taken = hold_lease(storage, scene_id, "store forget", on_wait)
    with taken as held, store_errors("forget a scene", storage.where):
        if not is_there(storage, scene_id):
            raise StoreError(f"{storage.where}: holds no scene {scene_id}")
        jobs = len(markers.list_jobs(storage, folder))
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
