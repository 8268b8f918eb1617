"""Samples that have a half in common: a seed was used twice.

Seeds have 32 bits, so that among many samples some have one in common by chance. Such samples would be equal again when
rendered again, so they are distinguished from those that a fault has made.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import CorruptError
from photonfarm.core.keys import seed_of
from photonfarm.store.check.content_check import CheckTotals, is_constant
from photonfarm.store.check.job_check import CheckTarget
from photonfarm.store.format import schema
from photonfarm.store.format.shards import Shard
from photonfarm.store.model import plans
from photonfarm.store.model.findings import Cause, Finding

DRAWN = 4
"""The number of seeds that a renderer may draw for a half: three are tried, and one may be the other half's."""


def equal_samples(scene: CheckTarget, totals: CheckTotals) -> Iterator[Finding]:
    """Samples that have a half in common. Constant halves may rightly be equal: there is no noise in them."""
    for rows in totals.fingerprints.suspects():
        read = ((row, halves) for row in rows if (halves := _halves(scene, row)) is not None)
        first, reference = next(read, (0, None))
        if reference is None or any(is_constant(half) for half in reference):
            continue
        causes = {
            row: Cause.SAME_SEED if _seeds(scene, row) & _seeds(scene, first) else Cause.EQUAL_SAMPLES
            for row, halves in read
            if any(np.array_equal(a, b) for a in reference for b in halves)
        }
        for row, cause in causes.items():
            yield _report_shared(scene, cause, row, first)
        for cause in dict.fromkeys(causes.values()):
            yield _report_shared(scene, cause, first, max(row for row in causes if causes[row] is cause))


def _report_shared(scene: CheckTarget, cause: Cause, row: int, other: int) -> Finding:
    detail = f"has a half in common with row {other}"
    return Finding(cause, detail, scene.scene_id, row // scene.shard_rows, row)


def _seeds(scene: CheckTarget, row: int) -> set[int]:
    """The seeds that the halves of a sample may have been rendered with, by its key; none without a plan."""
    sample = plans.sample_at(scene.plans, row) if scene.plans else None
    if sample is None:
        return set()
    purposes = [f"half {half}{again}" for half in "AB" for again in ("", *(f", attempt {n}" for n in range(1, DRAWN)))]
    return {seed_of(sample.key, purpose) for purpose in purposes}


def _halves(scene: CheckTarget, row: int) -> NDArray[np.floating] | None:
    """The stored halves of a row; None if they cannot be read (any more)."""
    job, i = divmod(row, scene.shard_rows)
    arrays, files = schema.output_arrays(scene.spec), scene.files_of(job)
    for name in ("radiance", "radiance_wide"):
        if name in files and scene.storage.exists(files[name]):
            try:
                halves = Shard(scene.storage.local(files[name]), arrays[name], scene.shard_rows).read(i)
            except CorruptError:  # found already, or set aside in the meantime
                return None
            if halves is not None:
                return halves
    return None
