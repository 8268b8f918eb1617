"""`photonfarm store join`: samples that another store has of the same scenes, copied into this one.

A join plans what the other store has complete and this one does not know, and then commits the jobs of these samples
itself, as a worker would, with what it reads from the other store. So whatever holds for plans, jobs and markers holds
for it: it may be killed at any point and repeated, and what it does not come to is a missing job, which workers render.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from photonfarm.core.errors import SpecError
from photonfarm.core.keys import Key
from photonfarm.plan.request import Joined, PlannedContent, SamplesToPlan, samples_to_join
from photonfarm.store import Figures, JobRows, JobWriter, SceneReader, SceneStore, Store
from photonfarm.store.model import plans
from photonfarm.store.model.lease import OnWait, hold_lease
from photonfarm.store.read.find import scene_named

OnProgress = Callable[[str, int, int], object]
"""Called with a scene's name, and how many of how many jobs are copied."""


@dataclass(frozen=True, slots=True)
class JoinedScene:
    """The outcome for one scene."""

    scene_id: str
    name: str
    there: int  # complete samples of the other store
    planned: int  # of these, the ones that this store did not know
    jobs: int  # jobs committed, of this join or of an earlier one that was cut off
    left: int  # samples that are planned here in jobs of which the other store lacks some: workers render them


def join(
    store: str | Path,
    other: str | Path,
    scene: str | None = None,
    *,
    on_progress: OnProgress = lambda *_: None,
    on_wait: OnWait = lambda _: None,
) -> list[JoinedScene]:
    """Copy the complete samples of every scene of another store, or of one, into a store, which may be new.

    Scenes are joined one after the other, each under its lease, for which this waits with `on_wait`.
    Raises SpecError for a store joined with itself, StoreError for one that is not there or a scene that it does not
    hold, CorruptError for bytes that are not what was committed.
    """
    source = Store(other)
    target = Store(store, create=True)
    if source.storage.where == target.storage.where:
        raise SpecError(f"{other}: is the store that it is to be joined with; name another one")
    only = None if scene is None else scene_named(source, scene)
    joined = []
    for there in source.scenes(only):
        with hold_lease(target.storage, there.scene_id, "store join", on_wait):
            joined.append(_join_scene(target, source, there, on_progress))
    return joined


def _join_scene(target: Store, source: Store, there: SceneStore, on_progress: OnProgress) -> JoinedScene:
    reader = SceneReader(source.root, there.scene_id)
    reader.refresh()
    if not len(reader.rows):
        return JoinedScene(there.scene_id, there.spec.name, 0, 0, 0, 0)
    here = target.scene(there.scene_id) if target.has_scene(there.scene_id) else target.add(there.spec)
    here.write_base(*reader.base())
    stored_plans = there.plans()
    content = plans.content(stored_plans)

    def wanted(known: PlannedContent) -> SamplesToPlan:
        return samples_to_join(content, reader.rows, known)

    joined = Joined(store=source.store_id, samples=len(reader.rows))
    planned = here.plan(joined, usual_rows=stored_plans[0].shard_rows, samples=wanted)
    copies = _Copies(reader, there)
    known = [(rows, copies.known(rows)) for rows in map(here.job_rows, here.missing_jobs())]
    whole = [rows for rows, count in known if count == len(rows.samples)]
    for done, rows in enumerate(whole):
        on_progress(here.spec.name, done, len(whole))
        copies.commit(here, rows)
    on_progress(here.spec.name, len(whole), len(whole))
    left = sum(count for rows, count in known if count < len(rows.samples))
    return JoinedScene(there.scene_id, there.spec.name, len(reader.rows), planned.new, len(whole), left)


class _Copies:
    """Commits jobs of this store with what another one has."""

    def __init__(self, reader: SceneReader, there: SceneStore) -> None:
        self._reader, self._there = reader, there
        self._rows: dict[Key, int] = reader.rows_by_key()
        self._shard_rows = there.plans()[0].shard_rows

    def known(self, rows: JobRows) -> int:
        """How many samples of a job the other store has."""
        return sum(sample.key in self._rows for sample in rows.samples)

    def commit(self, here: SceneStore, rows: JobRows) -> None:
        """Commit a job."""
        new_views, new_modifications = set(rows.new_views), set(rows.new_modifications)
        with JobWriter(here, rows) as out:
            for sample in rows.samples:
                row = self._rows[sample.key]
                if sample.modification_row in new_modifications and here.spec.photons.paths:
                    out.photons(sample.modification_row, self._reader.read_photons(row))
                new_modifications.discard(sample.modification_row)
                read = self._reader.read(row, guides=True) if sample.view_row in new_views else None
                if read is not None and read.guides is not None:
                    out.view(sample.view_row, read.buffers, read.guides, read.visibility)
                    new_views.discard(sample.view_row)
                out.radiance(sample.row, self._reader.read_radiance(row) if read is None else read.radiance)
            out.commit(self._figures([self._rows[sample.key] for sample in rows.samples]))

    def _figures(self, rows: list[int]) -> Figures:
        """The time that the other store's jobs took for these rows, and how the first of them was rendered."""
        jobs = [row // self._shard_rows for row in rows]
        of = {job: self._there.marker(job)["figures"] for job in sorted(set(jobs))}
        share = {job: 1 / len(self._there.job_rows(job).samples) for job in of}
        first = of[jobs[0]]
        return Figures(
            core_s=sum(of[job]["core_s"] * share[job] for job in jobs),
            wall_s=sum(of[job]["wall_s"] * share[job] for job in jobs),
            redrawn=0,
            worker=first["worker"],
            versions=first["versions"],
            device=first["device"],
            driver=first["driver"],
            strategy=first["strategy"],
            taken_over=len(rows),
        )
