"""Samples that have a half in common: a seed was used twice."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.errors import CorruptError
from photonfarm.shared.store import schema
from photonfarm.shared.store.content_check import Tally, is_constant
from photonfarm.shared.store.findings import Cause, Finding
from photonfarm.shared.store.job_check import Checked
from photonfarm.shared.store.shards import Shard


def equal_samples(scene: Checked, tally: Tally) -> Iterator[Finding]:
    """Samples that have a half in common. Constant halves may rightly be equal: there is no noise in them."""
    for rows in tally.fingerprints.suspects():
        read = ((row, halves) for row in rows if (halves := _halves(scene, row)) is not None)
        first, reference = next(read, (0, None))
        if reference is None or any(is_constant(half) for half in reference):
            continue
        other = None
        for row, halves in read:
            if any(np.array_equal(a, b) for a in reference for b in halves):
                other = row
                yield _shared(scene, row, first)
        if other is not None:
            yield _shared(scene, first, other)


def _shared(scene: Checked, row: int, other: int) -> Finding:
    detail = f"has a half in common with row {other}"
    return Finding(Cause.EQUAL_SAMPLES, detail, scene.scene_id, row // scene.shard_rows, row)


def _halves(scene: Checked, row: int) -> NDArray[np.floating] | None:
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
