"""Checks the files beside a scene's guides: their settings, and the declarations by which other programs read them.

The jobs of guides are checked as those of samples are, by `job_check`.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence, Set
from typing import Any

from photonfarm.shared.core.errors import CorruptError, StoreError
from photonfarm.shared.store.check.job_check import CheckTarget
from photonfarm.shared.store.check.plan_check import UNREADABLE, declaration
from photonfarm.shared.store.check.plan_repair import differs
from photonfarm.shared.store.write import plans
from photonfarm.shared.store.write.findings import Cause, Finding
from photonfarm.shared.store.write.guides import SETTINGS, GuideStore, build
from photonfarm.shared.store.write.plans import StoredPlan
from photonfarm.shared.store.write.quarantine import Quarantine

_GONE = "is missing, and guides are there"


class GuideCheck:
    """Checks settings and declarations of one scene's guides, and repairs them."""

    def __init__(self, guides: CheckTarget, committed: Set[int]) -> None:
        """Take the guides, and the jobs that had their marker before anything else was read."""
        self._guides = guides
        self._committed = committed

    def run(self) -> Iterator[Finding]:
        """Yield what is wrong."""
        yield from self._settings()
        for plan in self._guides.plans or []:
            try:
                yield from self._declared(plan)
            except OSError as error:
                yield self._finding(Cause.UNREADABLE, error.strerror or str(error), plan.folder)

    def repair(self, quarantine: Quarantine, found: Sequence[Finding]) -> list[str]:
        """Set damaged settings aside, and write damaged declarations again; returns what was done."""
        done = []
        why = [finding for finding in found if finding.cause is Cause.GUIDE_SETTINGS]
        if why and quarantine.settings(self._guides.name, why):
            done.append("settings of the guides")
        for plan in self._guides.plans or []:
            why = [finding for finding in found if finding.cause is Cause.PLAN_INPUTS and _is_in(finding, plan)]
            if why:
                self._declare(plan, quarantine, why)
                done.append(f"guides of plan {plan.number}, declared again")
        return done

    def _settings(self) -> Iterator[Finding]:
        guides, file = self._guides, f"{self._guides.name}/{SETTINGS}"
        store = GuideStore(guides.storage, guides.name.rpartition("/")[0], guides.spec)
        try:
            if store.settings() is None and self._committed:
                yield self._finding(Cause.GUIDE_SETTINGS, _GONE, file)
        except CorruptError as error:
            yield self._finding(Cause.GUIDE_SETTINGS, str(error).partition(": ")[2], file)
        except StoreError as error:
            guides.storage.names(guides.name)  # raises if it is the whole store that cannot be read
            yield self._finding(Cause.UNREADABLE, str(error).partition(": ")[2], file)

    def _declared(self, plan: StoredPlan) -> Iterator[Finding]:
        """What is wrong with the declarations of a plan's guides, which are there once a job has its marker."""
        import zarr

        storage, folder = self._guides.storage, plan.folder
        if not storage.exists(f"{folder}/zarr.json"):
            if not self._committed.isdisjoint(range(plan.first_job, plan.end_job)):
                yield self._finding(Cause.PLAN_INPUTS, _GONE, f"{folder}/zarr.json")
            return
        try:
            group: Any = zarr.open_group(storage.zarr(folder), mode="r", zarr_format=3, use_consolidated=False)
            plans.check_version(group.attrs, storage.where)
        except (StoreError, *UNREADABLE) as error:
            yield self._finding(Cause.PLAN_INPUTS, f"cannot be read: {plans.reason(error)}", f"{folder}/zarr.json")
            return
        for name, array in self._guides.arrays.items():
            if detail := declaration(group, array, plan.jobs, plan.shard_rows):
                yield self._finding(Cause.PLAN_INPUTS, detail, f"{folder}/{name}/zarr.json")

    def _declare(self, plan: StoredPlan, quarantine: Quarantine, why: Sequence[Finding]) -> None:
        """Write the damaged declarations of a plan again: they follow from the spec and the plan.

        If the group's own is damaged, all are compared, since without it the arrays' could not be checked.
        """
        storage = self._guides.storage
        built = storage.part()
        try:
            build(built, self._guides.spec, plan)
            files = {f"{plan.folder}/{path.relative_to(built).as_posix()}": path for path in built.rglob("zarr.json")}
            found = {str(finding.file) for finding in why}
            if f"{plan.folder}/zarr.json" in found:
                found.update(files)
            wrong = {name: files[name] for name in sorted(found) if differs(storage, name, files[name])}
            quarantine.rewrite(self._guides.name, plan.number, wrong, why)
        finally:
            shutil.rmtree(built, ignore_errors=True)

    def _finding(self, cause: Cause, detail: str, file: str) -> Finding:
        return Finding(cause, detail, self._guides.scene_id, file=file, guides=True)


def _is_in(finding: Finding, plan: StoredPlan) -> bool:
    """Whether a finding is about a file in a plan's folder."""
    return str(finding.file).startswith(f"{plan.folder}/")
