"""`photonfarm store check`: reads everything in a store, reports what is wrong with it, and sets that aside.

Nothing is deleted and no value is changed. A check reads at any time; a repair takes the scene's lease for what it sets
aside, and leaves alone what was committed anew since it was read. Scenes are read one after the other, and some jobs of
a scene at a time: memory holds the plans, 32 bytes a sample, and one row of each array for each thread.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

from photonfarm.core.errors import CorruptError, IncompleteError, StoreError, store_errors
from photonfarm.core.processes import usable_cores
from photonfarm.store.check.content_check import CheckTotals, HalvesResult, HalvesTest
from photonfarm.store.check.job_check import check_job, find_equal_samples
from photonfarm.store.check.plan_check import (
    CheckedScene,
    check_base,
    check_plans,
    find_unplanned_files,
    jobs_to_render,
)
from photonfarm.store.check.plan_repair import PlanRepair
from photonfarm.store.format import markers
from photonfarm.store.io.storage import TMP
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

MOST_THREADS = 4
"""The most threads: more would wait for the disk, or for each other."""


@dataclass(frozen=True, slots=True)
class SceneReport:
    """What was read and found of one scene."""

    scene_id: str
    name: str | None  # None if its spec cannot be read
    jobs: int  # committed ones that were checked
    samples: int
    size_bytes: int
    halves: HalvesResult | None
    counts: Mapping[str, int]  # as `Figures` has them, of what could be read
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
    on_progress: CheckProgress = lambda *_: None,
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
            check = _SceneCheck(store, each, quarantine if repair else None, on_wait)
            reports.append(check.run(len(ids), on_progress, joined_from))
        unfinished = sum(name.endswith(".partial") for name in storage.names(TMP))
        return StoreReport(tuple(reports), unfinished, repair, quarantine.folder)


class _SceneCheck:
    """One scene on its way through the check; what is damaged is set aside if there is a `quarantine`."""

    def __init__(self, store: Store, scene_id: str, quarantine: Quarantine | None, on_wait: OnWait) -> None:
        self._storage = store.storage
        self._scene_id = scene_id
        self._name = f"{SCENES}/{scene_id}"
        self._quarantine = quarantine
        self._on_wait = on_wait
        self._findings = Findings()
        self._markers: dict[int, bytes] = {}  # of jobs with findings
        self._same: dict[int, bool] = {}  # of such jobs: whether they were equal again after being rendered again

    def run(self, scenes: int, on_progress: CheckProgress, joined_from: Store | None) -> SceneReport:
        """Check everything, of one of several scenes."""
        totals, done = CheckTotals(HalvesTest(scenes)), []
        try:
            spec = read_spec(self._storage, self._scene_id)
        except StoreError as error:
            detail, file = str(error).partition(": ")[2], f"{self._name}/spec.json"
            self._findings.add([Finding(Cause.SPEC, detail, self._scene_id, file=file)])
            if self._quarantine:
                with self._alone():
                    done = ["spec"] if self._quarantine.spec(self._name, self._findings.of(Cause.SPEC)) else []
            return self._report(None, totals, done)
        committed = markers.list_jobs(self._storage, self._name)
        scene = CheckedScene(self._storage, spec)
        findings = check_plans(scene)  # before the jobs, which need them
        self._findings.add(findings)
        damaged = [finding for finding in findings if finding.cause is Cause.PLAN_INPUTS]
        if self._quarantine and damaged:
            done += self._rewrite_plans(PlanRepair(scene, self._quarantine, joined_from), damaged)
            self._findings.add(finding for finding in check_plans(scene) if finding not in findings)
        self._findings.add(check_base(scene, committed))
        if scene.shard_rows is not None:
            self._check_jobs(scene, sorted(committed), totals, on_progress)
        if self._quarantine and (self._findings.jobs or self._findings.of(Cause.BASE)):
            with self._alone():
                done += self._repair(scene, self._quarantine)
        return self._report(spec.name, totals, done)

    def _alone(self) -> contextlib.AbstractContextManager[Claim]:
        return hold_lease(self._storage, self._scene_id, "store check --repair", self._on_wait)

    def _rewrite_plans(self, repair: PlanRepair, damaged: list[Finding]) -> list[str]:
        """Write damaged inputs of plans again; returns what was."""
        rewritten = []
        with self._alone():
            for number in range(plans.count(self._storage, self._name)):
                folder = f"{plans.folder(self._name, number)}/"
                if why := [finding for finding in damaged if str(finding.file).startswith(folder)]:
                    try:
                        repair.run(number, why)
                        rewritten.append(f"plan {number}, written again")
                    except StoreError as error:
                        what = str(error).partition(": ")[2]
                        self._findings.add([Finding(Cause.PLAN, what, self._scene_id, file=folder[:-1])])
        return rewritten

    def _check_jobs(
        self, scene: CheckedScene, committed: list[int], totals: CheckTotals, on_progress: CheckProgress
    ) -> None:
        """Read everything that committed jobs stored, and look for what is missing."""
        check = partial(check_job, scene, totals.halves.scenes)
        with ThreadPoolExecutor(min(MOST_THREADS, usable_cores())) as threads:
            for done in range(0, len(committed), AT_ONCE):
                jobs = committed[done : done + AT_ONCE]
                on_progress(scene.spec.name, done, len(committed), totals.size_bytes)
                for job, (findings, marker, read) in zip(jobs, threads.map(check, jobs), strict=True):
                    totals.add(read)
                    if findings:
                        self._markers[job] = marker
                        self._findings.add(self._tell_same(findings))
        on_progress(scene.spec.name, len(committed), len(committed), totals.size_bytes)
        self._findings.add(find_unplanned_files(scene))
        self._findings.add(self._tell_same(find_equal_samples(scene, totals)))
        if (halves := totals.halves.result()) is not None and not halves.passed:
            self._findings.add([scene.finding(Cause.HALVES_DIFFER, halves.in_words)])

    def _tell_same(self, findings: Iterable[Finding]) -> Iterator[Finding]:
        """The findings, with another cause for equal halves that were equal again after being rendered again."""
        for finding in findings:
            equal = finding.cause in (Cause.EQUAL_HALVES, Cause.EQUAL_SAMPLES)
            same = equal and finding.job is not None and self._came_out_the_same(finding.job)
            yield replace(finding, cause=Cause.SAME_AGAIN) if same else finding

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

    def _report(self, name: str | None, totals: CheckTotals, set_aside: list[str]) -> SceneReport:
        read = totals.jobs, totals.samples, totals.size_bytes, totals.halves.result(), dict(totals.counts)
        return SceneReport(self._scene_id, name, *read, self._findings.groups(), tuple(set_aside))

    # ----------------------------------------------------------------------------------------------------------- repair

    def _repair(self, scene: CheckedScene, quarantine: Quarantine) -> list[str]:
        aside = []
        for job, why in sorted(self._findings.jobs.items()):
            if scene.plans is None:
                self._findings.add([scene.finding(Cause.LEFT, "stays until the plans are whole", job=job)])
            elif self._set_aside(scene, quarantine, job, why):
                aside.append(f"job {job}")
        if why := self._findings.of(Cause.BASE):
            if quarantine.base(self._name, why):
                aside.append("base")
            jobs = jobs_to_render(scene.plans or [])
            if jobs and markers.list_jobs(self._storage, self._name) >= jobs:
                # nothing is missing, and only a job that is rendered writes the base
                reason = scene.finding(Cause.BASE, "this job is whole: it is rendered again for the base")
                self._set_aside(scene, quarantine, max(jobs), [reason])
                aside.append(f"job {max(jobs)} (whole; rendered again, as a job writes the base)")
        return aside

    def _set_aside(self, scene: CheckedScene, quarantine: Quarantine, job: int, why: list[Finding]) -> bool:
        files = set(scene.files_of(job).values())
        try:
            marker = self._marker(job)
            files.update(markers.parse_files(marker, scene.name, job))
        except FileNotFoundError:  # it is missing by now
            return False
        except CorruptError:
            pass
        return quarantine.job(scene.name, job, marker, sorted(files), why)
