"""`photonfarm store check`: reads everything in a store, reports what is wrong with it, and sets that aside.

Nothing is deleted and no value is changed. A check reads at any time; a repair takes the scene's lease for what it sets
aside, and leaves alone what was committed anew since it was read. Scenes and rows are read one after the other: memory
holds the plans, 32 bytes a sample, and one row of each array for each thread.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from math import ceil

from photonfarm.core.errors import CorruptError, IncompleteError, StoreError, store_errors
from photonfarm.scene.spec import SceneSpec
from photonfarm.store.check.content_check import SIGNIFICANCE, CheckTotals, HalvesResult, HalvesTest
from photonfarm.store.check.job_check import CheckTarget
from photonfarm.store.check.job_pool import JobPool
from photonfarm.store.check.plan_check import PlanCheck, find_unplanned_files, jobs_to_render
from photonfarm.store.check.plan_repair import PlanRepair
from photonfarm.store.check.repeated_seeds import equal_samples
from photonfarm.store.format import markers
from photonfarm.store.io.storage import TMP, Storage
from photonfarm.store.model import plans
from photonfarm.store.model.findings import Cause, Finding, FindingGroup, Findings, Remedy
from photonfarm.store.model.lease import Claim, OnWait, hold_lease
from photonfarm.store.model.quarantine import Quarantine, was_set_aside
from photonfarm.store.model.scene_store import SCENES, read_spec, scene_ids
from photonfarm.store.model.store import Store

CheckProgress = Callable[[str, int, int, int], None]
"""Called with the scene's name, the jobs checked, the jobs to check, and the bytes read."""


AT_ONCE = 32
"""The number of jobs handed to the threads at a time; findings are reported in their order."""


@dataclass(frozen=True, slots=True)
class SceneReport:
    """What was read and found of one scene."""

    scene_id: str
    name: str | None  # None if its spec cannot be read
    jobs: int  # committed ones that were checked
    samples: int
    size_bytes: int
    back_facing_share: float | None  # of the pixels that meet something; None if none does
    halves: HalvesResult | None
    groups: tuple[FindingGroup, ...]
    set_aside: tuple[str, ...]  # "job 12", "base", "spec"


@dataclass(frozen=True, slots=True)
class StoreReport:
    """What was read and found of a store."""

    scenes: tuple[SceneReport, ...]
    parts: int  # unfinished files
    repaired: bool  # whether what can be repaired was set aside
    quarantine: str | None  # the folder that it was moved to

    @property
    def exit_code(self) -> int:
        """0: nothing is wrong; 7: what was wrong is set aside, to be written again; 4: something is still wrong."""
        remedies = {group.cause.remedy for scene in self.scenes for group in scene.groups} - {Remedy.LOOK}
        if not remedies:
            return 0
        return StoreError.exit_code if Remedy.REPORT in remedies or not self.repaired else IncompleteError.exit_code


def check_store(
    store: Store,
    scene_id: str | None = None,
    *,
    when: str,
    repair: bool = False,
    joined_from: Store | None = None,
    on_progress: CheckProgress | None = None,
    on_wait: OnWait = lambda _: None,
) -> StoreReport:
    """Check every scene of a store, or one; `repair` sets what is damaged aside, at the time `when`.

    Plans of joins are written again from `joined_from`. A repair waits with `on_wait` until it has a damaged scene
    alone. Raises StoreError if the scene is not there, or the store cannot be read.
    """
    storage = store.storage
    with store_errors("check the store", storage.where):
        ids = scene_ids(storage) if scene_id is None else [scene_id]
        if scene_id is not None and not storage.names(f"{SCENES}/{scene_id}"):
            raise StoreError(f"{storage.where}: holds no scene {scene_id}")
        quarantine = Quarantine(storage, when)
        reports = []
        for each in ids:
            checking = _SceneChecking(storage, each, len(ids), on_progress or (lambda *_: None), on_wait, joined_from)
            reports.append(checking.run(quarantine if repair else None))
        return StoreReport(
            tuple(reports), sum(name.endswith(".partial") for name in storage.names(TMP)), repair, quarantine.folder
        )


def halves_in_words(halves: HalvesResult) -> str:
    """The outcome of the test between A and B, in words."""
    verdict = "no difference beyond chance" if halves.passed else "they differ by more than chance"
    if not halves.is_conclusive:
        verdict = f"too few samples to tell, {ceil(halves.limit**2)} are needed at least"
    return (
        f"{verdict}: |S| = {halves.statistic:.2f} in {halves.where}, {'below' if halves.passed else 'above'} "
        f"{halves.limit:.2f}, which chance reaches with probability {SIGNIFICANCE:g} at most; of whole images "
        f"(A − B)/(A + B) = {halves.difference:+.2%}, and chance allows ± {halves.allowed:.2%} over {halves.samples} "
        "samples"
    )


class _SceneChecking:
    """One scene on its way through the check."""

    def __init__(
        self,
        storage: Storage,
        scene_id: str,
        scenes: int,
        on_progress: CheckProgress,
        on_wait: OnWait,
        joined_from: Store | None,
    ) -> None:
        self._storage = storage
        self._scene_id = scene_id
        self._name = f"{SCENES}/{scene_id}"
        self._on_progress = on_progress
        self._on_wait = on_wait
        self._joined_from = joined_from
        self._findings = Findings()
        self._markers: dict[int, bytes] = {}  # of jobs with findings
        self._same: dict[int, bool] = {}  # of such jobs: whether they were equal again after being rendered again
        self._scenes = scenes
        self._totals = CheckTotals(HalvesTest(scenes))

    def run(self, quarantine: Quarantine | None) -> SceneReport:
        """Check everything; set aside what is damaged, unless `quarantine` is None."""
        try:
            spec = read_spec(self._storage, self._scene_id)
        except StoreError as error:
            detail = str(error).partition(": ")[2]
            self._add([Finding(Cause.SPEC, detail, self._scene_id, file=f"{self._name}/spec.json")])
            aside = []
            if quarantine:
                with self._alone():
                    aside = ["spec"] if quarantine.spec(self._name, self._findings.of(Cause.SPEC)) else []
            return self._report(None, aside)
        committed = markers.list_jobs(self._storage, self._name)
        inputs, done = self._plans(spec, quarantine)
        self._add(inputs.check_base(committed))
        scene = None
        if inputs.shard_rows is not None:
            scene = CheckTarget(
                self._storage, self._scene_id, self._name, spec, inputs.plans, inputs.shard_rows, frozenset(inputs.lost)
            )
            self._jobs(scene, sorted(committed))
        if quarantine and (self._findings.jobs or self._findings.of(Cause.BASE)):
            with self._alone():
                done += self._repair(scene, quarantine)
        return self._report(spec.name, done)

    def _alone(self) -> contextlib.AbstractContextManager[Claim]:
        return hold_lease(self._storage, self._scene_id, "store check --repair", self._on_wait)

    def _plans(self, spec: SceneSpec, quarantine: Quarantine | None) -> tuple[PlanCheck, list[str]]:
        """Check the plans, before the jobs, which need them; also returns what was written again."""
        check = PlanCheck(self._storage, spec, self._name)
        found = list(check.check_plans())
        self._add(found)
        damaged = [finding for finding in found if finding.cause is Cause.PLAN_INPUTS]
        if quarantine is None or not damaged:
            return check, []
        rewritten = []
        repair = PlanRepair(self._storage, spec, self._name, quarantine, self._joined_from)
        with self._alone():
            for number in range(plans.count(self._storage, self._name)):
                folder = f"{plans.folder(self._name, number)}/"
                if why := [finding for finding in damaged if str(finding.file).startswith(folder)]:
                    try:
                        repair.run(number, why)
                        rewritten.append(f"plan {number}, written again")
                    except StoreError as error:
                        what = str(error).partition(": ")[2]
                        self._add([Finding(Cause.PLAN, what, self._scene_id, file=folder[:-1])])
        check = PlanCheck(self._storage, spec, self._name)
        self._add([finding for finding in check.check_plans() if finding not in found])
        return check, rewritten

    def _jobs(self, scene: CheckTarget, committed: list[int]) -> None:
        self._read(scene, committed)
        self._add(self._again(equal_samples(scene, self._totals)))
        if (halves := self._totals.halves.result()) is not None and not halves.passed:
            self._add([Finding(Cause.HALVES_DIFFER, halves_in_words(halves), self._scene_id)])

    def _read(self, scene: CheckTarget, committed: list[int]) -> None:
        """Read everything that committed jobs stored, and look for what is missing."""
        called, total = scene.spec.name, self._totals
        with JobPool(scene, self._scenes) as pool:
            for done in range(0, len(committed), AT_ONCE):
                jobs = committed[done : done + AT_ONCE]
                self._on_progress(called, done, len(committed), pool.size_bytes)
                for job, (found, marker) in zip(jobs, pool.run(jobs), strict=True):
                    if found:
                        self._markers[job] = marker
                        self._add(self._again(found))
            for part in pool.totals:
                total.add(part)
        self._on_progress(called, len(committed), len(committed), total.size_bytes)
        self._add(find_unplanned_files(scene))

    def _again(self, found: Iterable[Finding]) -> Iterator[Finding]:
        """The findings, with another cause for equal halves that were equal again after being rendered again."""
        for finding in found:
            equal = finding.cause in (Cause.EQUAL_HALVES, Cause.EQUAL_SAMPLES)
            again = equal and finding.job is not None and self._came_out_the_same(finding.job)
            yield replace(finding, cause=Cause.SAME_AGAIN) if again else finding

    def _came_out_the_same(self, job: int) -> bool:
        if job not in self._same:
            self._same[job] = False
            with contextlib.suppress(FileNotFoundError, CorruptError):  # set aside just now, or reported by itself
                self._same[job] = was_set_aside(self._storage, self._name, job, self._marker(job))
        return self._same[job]

    def _marker(self, job: int) -> bytes:
        """The marker that findings of a job refer to; raises FileNotFoundError if it was set aside in the meantime."""
        if job not in self._markers:  # found when all samples were looked at
            self._markers[job] = self._storage.read(markers.marker_name(self._name, job))
        return self._markers[job]

    def _add(self, found: Iterator[Finding] | list[Finding]) -> None:
        self._findings.add(found)

    def _report(self, name: str | None, set_aside: list[str]) -> SceneReport:
        totals = self._totals
        share = totals.back_facing_pixels / totals.hit_pixels if totals.hit_pixels else None
        return SceneReport(
            self._scene_id,
            name,
            totals.jobs,
            totals.samples,
            totals.size_bytes,
            share,
            totals.halves.result(),
            self._findings.groups(),
            tuple(set_aside),
        )

    # ----------------------------------------------------------------------------------------------------------- repair

    def _repair(self, scene: CheckTarget | None, quarantine: Quarantine) -> list[str]:
        aside = []
        for job, why in sorted(self._findings.jobs.items()):
            if scene is None or scene.plans is None:
                detail = "stays until the plans are whole"
                self._add([Finding(Cause.LEFT, detail, self._scene_id, job)])
            elif self._set_aside(scene, quarantine, job, why):
                aside.append(f"job {job}")
        if why := self._findings.of(Cause.BASE):
            if quarantine.base(self._name, why):
                aside.append("base")
            committed = markers.list_jobs(self._storage, self._name)
            jobs = jobs_to_render(scene.plans) if scene is not None and scene.plans else set()
            if scene is not None and jobs and committed >= jobs:
                # nothing is missing, and only a job that is rendered writes the base
                reason = Finding(Cause.BASE, "this job is whole: it is rendered again for the base", self._scene_id)
                self._set_aside(scene, quarantine, max(jobs), [reason])
                aside.append(f"job {max(jobs)} (whole; rendered again, as a job writes the base)")
        return aside

    def _set_aside(self, scene: CheckTarget, quarantine: Quarantine, job: int, why: list[Finding]) -> bool:
        files = set(scene.files_of(job).values())
        try:
            marker = self._marker(job)
            files.update(markers.parse_files(marker, scene.name, job))
        except FileNotFoundError:  # it is missing by now
            return False
        except CorruptError:
            pass
        return quarantine.job(scene.name, job, marker, sorted(files), why)
