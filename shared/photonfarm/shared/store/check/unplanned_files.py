"""Files of a scene that belong to no committed job."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import chain

from photonfarm.shared.store.check.job_check import CheckTarget
from photonfarm.shared.store.format import markers, schema
from photonfarm.shared.store.write.findings import Cause, Finding


def unplanned_files(scene: CheckTarget) -> Iterator[Finding]:
    """Yield files of jobs that are not committed, and files that are not ours."""
    left: dict[int, str] = {}
    foreign = [
        f"{scene.name}/{markers.COMMITTED}/{name}"
        for name in scene.storage.names(f"{scene.name}/{markers.COMMITTED}")
        if not re.fullmatch(r"\d+\.json", name)
    ]
    for folder, first_job, end_job, array in _array_folders(scene):
        for name in sorted(set(scene.storage.names(folder)) - {"zarr.json"}):
            number = name.split(".")[1] if name.startswith("c.") else ""
            job = first_job + int(number) if number.isdecimal() else end_job
            if job >= end_job or name != array.shard_name(job - first_job):
                foreign.append(f"{folder}/{name}")
            else:
                left.setdefault(job, f"{folder}/{name}")
    for job in sorted(left.keys() - markers.jobs(scene.storage, scene.name)):  # now: a worker may have been at it
        yield scene.finding(Cause.NO_MARKER, job, "not a sample yet", left[job])
    yield from (Finding(Cause.FOREIGN_FILE, "left alone", scene.scene_id, file=file) for file in foreign)


def _array_folders(scene: CheckTarget) -> Iterator[tuple[str, int, int, schema.ArraySchema]]:
    arrays = scene.arrays.values()
    return chain.from_iterable(
        ((f"{plan.folder}/{array.name}", plan.first_job, plan.end_job, array) for array in arrays)
        for plan in scene.plans or []
    )
