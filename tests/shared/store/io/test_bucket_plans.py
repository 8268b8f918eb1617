"""Stores in a bucket are joined, plans in it withdrawn, and its specs replaced."""

from pathlib import Path

import numpy as np
import pytest
import store_samples as samples
from bucket_samples import planned

from photonfarm.farm.join import join
from photonfarm.store import SceneReader, Store
from photonfarm.store.check.check import check_store


class KilledError(Exception):
    """Stands for a signal."""


def test_a_folder_is_joined_into_a_bucket_and_goes_on_where_it_was_cut_off(url: str, tmp_path: Path) -> None:
    there = planned(tmp_path / "store", modifications=8)
    there.write_base(*samples.base())
    samples.commit_all(there)
    here = planned(url, modifications=1)
    here.write_base(*samples.base())
    samples.commit_all(here)

    def killed(_scene: str, done: int, _total: int) -> None:
        if done:
            raise KilledError

    with pytest.raises(KilledError):
        join(url, tmp_path / "store", on_progress=killed)
    (told,) = join(url, tmp_path / "store")
    assert told.planned == 0, "the first one has planned them"
    assert told.jobs
    folder, bucket = (SceneReader(place, there.scene_id) for place in (tmp_path / "store", url))
    folder.refresh()
    bucket.refresh()
    first, second = folder.rows_by_key(), bucket.rows_by_key()
    assert first.keys() == second.keys()
    copied = {row: second[key] for key, row in first.items() if second[key] >= 2}  # not this store's own
    assert len(copied) == 7
    for row, copy in copied.items():
        a, b = folder.read(row, guides=True), bucket.read(copy, guides=True)
        assert a.guides is not None
        assert b.guides is not None
        np.testing.assert_array_equal(a.radiance, b.radiance)
        np.testing.assert_array_equal(a.guides.direct, b.guides.direct)
    assert check_store(Store(url), when="now").exit_code == 0
