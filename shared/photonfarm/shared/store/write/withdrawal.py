"""`photonfarm store withdraw`: what a plan holds and nobody has rendered is forgotten, and may be planned again.

The plan stays as it is. A small file beside it names the jobs whose rows count as unused from now on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.core.errors import SpecError, store_errors
from photonfarm.shared.plan.request import UNUSED
from photonfarm.shared.store.format import withdrawn
from photonfarm.shared.store.write.lease import OnWait, lease
from photonfarm.shared.store.write.plans import StoredPlan
from photonfarm.shared.store.write.scene_store import SceneStore


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


def withdraw(scene: SceneStore, number: int | None = None, *, on_wait: OnWait = lambda _: None) -> Withdrawal:
    """Withdraw the jobs of a plan, by default of the last one, that are not committed.

    Jobs that hold views or configurations of committed ones stay planned. Raises SpecError for a plan that is not
    there, and where samples of a later plan refer to its rows. It waits with `on_wait` for the scene's lease.
    """
    storage = scene.storage
    with lease(storage, scene.scene_id, "store withdraw", on_wait), store_errors("withdraw a plan", storage.where):
        return _withdraw(scene, number)


def _withdraw(scene: SceneStore, number: int | None) -> Withdrawal:
    found = scene.plans()
    if not found or (number is not None and number >= len(found)):
        there = f"the last one is {len(found) - 1}" if found else "nothing is planned"
        raise SpecError(f"scene {scene.scene_id} ({scene.spec.name}): has no plan {number or 0}; {there}")
    plan = found[-1 if number is None else number]
    committed = scene.committed_jobs()
    jobs = _withdrawable(scene, found, plan, committed)
    if jobs:
        withdrawn.write(scene.storage, plan.folder, plan.withdrawn | jobs)
    samples = {job: plan.samples_in(job) for job in range(plan.first_job, plan.end_job)}
    rendered = sum(count for job, count in samples.items() if job in committed)
    forgotten = sum(samples[job] for job in jobs)
    return Withdrawal(
        scene.scene_id, scene.spec.name, plan.number, len(jobs), forgotten, rendered,
        sum(samples.values()) - rendered - forgotten,
    )  # fmt: skip


def _withdrawable(scene: SceneStore, found: list[StoredPlan], plan: StoredPlan, committed: set[int]) -> set[int]:
    """The jobs of a plan that can be withdrawn: not committed, and no sample that stays refers to their rows."""
    jobs = set(range(plan.first_job, plan.end_job)) - committed - plan.withdrawn
    while True:
        leant_on: set[int] = set()
        for other in found[plan.number :]:
            own, referred = _references(other)
            stays = ~np.isin(own, list(jobs))
            leant_on = {int(job) for job in np.unique(referred[stays]) if int(job) in jobs}
            if leant_on and other.number > plan.number:
                of = f"plan {plan.number} of scene {scene.scene_id} ({scene.spec.name})"
                why = f"plan {other.number} has samples of its views or configurations"
                raise SpecError(f"{of}: {why}; withdraw plan {other.number} first")
            if leant_on:
                break
        if not leant_on:
            return jobs
        jobs -= leant_on


def _references(plan: StoredPlan) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """For each sample of a plan its job, and the jobs of its view and of its configuration, (N,) and (N, 2)."""
    used = np.flatnonzero(plan.rows.sample_modification != UNUSED)
    referred = np.stack([plan.rows.sample_view[used], plan.rows.sample_modification[used]], axis=1)
    return (plan.first_row + used) // plan.shard_rows, referred // plan.shard_rows
