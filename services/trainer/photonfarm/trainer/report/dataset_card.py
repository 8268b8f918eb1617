"""The data that a network was trained on: their scene, their cost, and how to make them again."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from photonfarm.plan.request import UNUSED
from photonfarm.scene.spec import SceneSpec
from photonfarm.store import SceneStatus, Store
from photonfarm.store.model.status import scene_status

SAMPLES = "samples"
"""The kind of plans whose rows are of new views; others add passes to these, which need no photons and no buffers."""


@dataclass(frozen=True, slots=True)
class PlanTotals:
    """The totals of the plans of one kind of request."""

    planned: int  # rows
    rows: int  # of committed jobs
    core_seconds: float  # processor time of these jobs


@dataclass(frozen=True, slots=True, eq=False)
class DatasetCard:
    """A scene of a store, described by its plans and markers."""

    spec: SceneSpec
    status: SceneStatus
    requests: tuple[dict[str, Any], ...]  # of each plan: all rows follow from them
    versions: dict[str, list[str]]  # of the packages that rendered, each with all versions
    workers: int  # the number of workers
    spent: dict[str, PlanTotals]  # by the kind of the plans' requests; without kinds that have no committed job

    @classmethod
    def of(cls, store: str | Path, scene_id: str, exposure: float) -> DatasetCard:
        """The card of one scene, exposed as its runs are; raises StoreError for one that the store does not hold."""
        scene = Store(store).scene(scene_id)
        status, plans, committed = scene_status(scene), scene.plans(), set(scene.committed_jobs())
        versions: dict[str, set[str]] = defaultdict(set)
        workers: set[str] = set()
        spent: dict[str, PlanTotals] = defaultdict(lambda: PlanTotals(0, 0, 0.0))
        for plan in plans:
            used = (plan.rows.sample_modification != UNUSED).reshape(plan.jobs, plan.shard_rows).sum(axis=1)
            totals = spent[plan.request.kind]
            planned, rows, core_seconds = totals.planned + plan.samples, totals.rows, totals.core_seconds
            for job in sorted(committed.intersection(range(plan.first_job, plan.end_job))):
                figures = scene.marker(job)["figures"]
                rows += int(used[job - plan.first_job])
                core_seconds += figures["core_s"]
                workers.add(figures["worker"])
                for package, version in figures["versions"].items():
                    versions[package].add(version)
            spent[plan.request.kind] = PlanTotals(planned, rows, core_seconds)
        return cls(
            scene.spec.model_copy(update={"exposure": exposure}),
            status,
            tuple(plan.request.model_dump(mode="json") for plan in plans),
            {package: sorted(numbers) for package, numbers in sorted(versions.items())},
            len(workers),
            {kind: totals for kind, totals in spent.items() if totals.rows},
        )

    @property
    def samples(self) -> PlanTotals:
        """The rows of new views: the samples that networks are trained on, except held-out ones."""
        return self.spent.get(SAMPLES, PlanTotals(0, 0, 0.0))

    @property
    def further_passes(self) -> PlanTotals:
        """The rows that add passes to views, such as for references."""
        others = [spent for kind, spent in self.spent.items() if kind != SAMPLES]
        return PlanTotals(*(sum(getattr(spent, name) for spent in others) for name in PlanTotals.__slots__))

    @property
    def core_s_per_sample(self) -> float:
        """The processor time of a sample of a new view, with buffers, guides and photons; 0 without one."""
        return self.samples.core_seconds / self.samples.rows if self.samples.rows else 0.0

    @property
    def source(self) -> str:
        """Where the scene's description is from."""
        return self.spec.scene.file or f"built-in {self.spec.scene.builtin}"

    @property
    def kind(self) -> str:
        """The variable parts of the scene, in words."""
        counts = {"objects": len(self.spec.objects), "lights": len(self.spec.lights)}
        movable = " and ".join(f"{count} {name}" for name, count in counts.items() if count)
        return f"dynamic: {movable} move" if movable else "static: views alone differ"

    def document(self) -> dict[str, Any]:
        """Its part of report.json."""
        spec, status = self.spec, self.status
        return {
            "scene": spec.name,
            "scene_id": spec.scene_id,
            "credits": None if spec.credits is None else spec.credits.model_dump(),
            "source": self.source,
            "kind": self.kind,
            "width": spec.film.width,
            "height": spec.film.height,
            "exposure": spec.exposure,
            "points": spec.points,
            "transport": spec.transport.model_dump(),
            "photons": spec.photons.model_dump(),
            "guides": spec.guides.model_dump(),
            "spp_per_sample": 2 * spec.transport.half_spp,
            "samples_planned": status.samples_planned,
            "samples_complete": status.samples_complete,
            "requests": list(self.requests),
            "bytes": status.size_bytes,
            "core_seconds": status.core_s,
            "spent": {kind: asdict(spent) for kind, spent in self.spent.items()},
            "core_seconds_per_sample": self.core_s_per_sample,
            "redrawn": status.redrawn,
            "workers": self.workers,
            "versions": self.versions,
        }
