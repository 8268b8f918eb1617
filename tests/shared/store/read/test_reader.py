"""Batches in reused memory are the samples that were committed, from any number of threads and with few open files."""

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import store_samples as samples

from photonfarm.core.errors import CorruptError, IncompleteError
from photonfarm.core.records import arrays_of
from photonfarm.plan.request import Request
from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.format import shards
from photonfarm.store.read.batch import Batch

WIDE = (5, 6)  # rows with a value beyond float16
BRIGHT = np.float32(1e9)


@pytest.fixture
def scene(tmp_path: Path) -> SceneStore:
    """Eight samples in four jobs: two views of two modifications, two passes each."""
    store = Store(tmp_path / "store", create=True)
    request = Request(modifications=2, views_per_modification=2, passes=2)
    scene = store.scene(store.plan(samples.small_spec(exposure=4.0), request, shard_rows=2).scene_id)
    for job in scene.missing_jobs():
        given = samples.outputs(scene, job)
        for row in given.radiance.keys() & set(WIDE):
            given.radiance[row][0, 0, 0, 0] = BRIGHT
        samples.commit(scene, job, given)
    return scene


@pytest.fixture
def source(scene: SceneStore) -> SceneReader:
    source = SceneReader(scene.storage.where, scene.scene_id)
    assert source.refresh().tolist() == list(range(8))
    return source


def check(batch: Batch, source: SceneReader, rows: list[int]) -> None:
    """Compare with the samples read one by one."""
    assert batch.rows.tolist() == rows
    for place, row in enumerate(rows):
        guides = batch.guides(place)
        sample = source.read(row, guides=guides is not None)
        np.testing.assert_array_equal(batch.linear(place), sample.radiance)
        pairs = [(batch.buffers(place), sample.buffers), (batch.visibility(place), sample.visibility)]
        for stored, read in [*pairs, *([] if guides is None else [(guides, sample.guides)])]:
            for name, values in arrays_of(read).items():
                np.testing.assert_array_equal(getattr(stored, name), values)
        assert batch.modification_rows[place] == source.modification_row(row)


def test_batches_in_any_order_and_with_repeats_are_the_samples_read_one_by_one(source: SceneReader) -> None:
    rng = np.random.default_rng(0)
    memory = Batch.empty(source.spec, 6, guides=True)
    for _ in range(20):
        rows = rng.integers(0, 8, rng.integers(1, 7)).tolist()
        check(source.read_batch(rows, memory), source, rows)
        check(source.read_batch(np.array(rows)), source, rows)


def test_a_batch_is_in_the_memory_that_was_given_and_in_the_types_that_are_stored(source: SceneReader) -> None:
    memory = Batch.empty(source.spec, 4)
    batch = source.read_batch([3, 1], memory)
    assert len(batch) == 2
    assert np.shares_memory(batch.radiance, memory.radiance)
    assert all(np.shares_memory(values, memory.of_view[name]) for name, values in batch.of_view.items())
    types = {name: values.dtype.name for name, values in batch.of_view.items() if "seen" not in name}
    assert types == {"depth": "float32", "albedo": "float16", "normal": "float16"}
    expected = source.read(3).radiance * 2.0**source.spec.radiance_exponent
    assert batch.radiance.dtype == np.float16
    np.testing.assert_array_equal(batch.radiance[0], expected)


def test_a_sample_that_float16_cannot_hold_comes_in_float32_and_is_nan_for_whoever_forgets_it(
    source: SceneReader,
) -> None:
    memory = Batch.empty(source.spec, 3)
    batch = source.read_batch([0, 5, 6], memory)
    assert set(batch.wide) == {1, 2}
    assert np.isnan(batch.radiance[1:]).all()
    assert batch.wide[1].dtype == np.float32
    assert batch.linear(1)[0, 0, 0, 0] == BRIGHT
    assert np.isfinite(batch.linear(1)).all()
    assert not source.read_batch([1, 2], memory).wide  # nothing is left of the batch before


@pytest.mark.parametrize("gone", ["depth", "direct"])
def test_what_a_batch_has_no_memory_for_is_not_read(scene: SceneStore, source: SceneReader, gone: str) -> None:
    for file in scene.folder.glob(f"plans/*/{gone}/c.*"):
        file.unlink()
    buffers, guides = gone != "depth", gone != "direct"
    batch = source.read_batch([0, 1], Batch.empty(source.spec, 2, buffers=buffers, guides=guides))
    assert [name in batch.of_view for name in ("depth", "point_seen", "direct")] == [buffers, buffers, guides]
    with pytest.raises(CorruptError):
        source.read_batch([0, 1], Batch.empty(source.spec, 2, guides=True))


@pytest.mark.parametrize("row", [-1, 8, 10**12])
def test_rows_that_are_not_complete_are_refused_before_anything_is_read(source: SceneReader, row: int) -> None:
    memory = Batch.empty(source.spec, 2)
    memory.radiance[:] = 7
    with pytest.raises(IncompleteError):
        source.read_batch([0, row], memory)
    assert (memory.radiance == 7).all()


def test_no_more_files_stay_open_than_are_allowed(source: SceneReader, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shards, "OPEN_SHARDS", 3)
    descriptors = Path("/proc/self/fd")
    before = len(list(descriptors.iterdir()))
    memory = Batch.empty(source.spec, 8)
    for _ in range(5):
        source.read_batch(range(8), memory)
        assert len(list(descriptors.iterdir())) <= before + 3
    del source


def test_threads_that_read_at_once_each_get_their_own_samples(
    source: SceneReader, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Few shards stay open, so that they are closed by one thread while another one reads."""
    expected = source.read_batch(range(8))
    monkeypatch.setattr(shards, "OPEN_SHARDS", 3)

    def read(seed: int) -> None:
        rng, memory = np.random.default_rng(seed), Batch.empty(source.spec, 4)
        for _ in range(60):
            rows = rng.integers(0, 8, 4)
            batch = source.read_batch(rows, memory)
            np.testing.assert_array_equal(batch.radiance, expected.radiance[rows])
            np.testing.assert_array_equal(batch.of_view["normal"], expected.of_view["normal"][rows])

    with ThreadPoolExecutor(2 * (os.cpu_count() or 1)) as threads:
        list(threads.map(read, range(6)))
