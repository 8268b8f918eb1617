"""What a worker reads of a plan is what its job needs, however large the plan is."""

from collections import Counter

import numpy as np
import pytest
import store_samples as samples

from photonfarm.shared.core.errors import CorruptError
from photonfarm.shared.plan.request import Request
from photonfarm.shared.store import SceneStore, Store
from photonfarm.shared.store.format import schema
from photonfarm.shared.store.io.local import LocalStorage
from photonfarm.shared.store.write import plans

CHUNK = 8


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Inputs are stored in chunks of a few rows, so that a small plan has many."""
    monkeypatch.setattr(schema, "INPUT_ROWS_PER_CHUNK", CHUNK)


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often each file of a store was read."""
    counts, plain = Counter[str](), LocalStorage.read

    def reading(storage: LocalStorage, name: str) -> bytes:
        counts[name] += 1
        return plain(storage, name)

    monkeypatch.setattr(LocalStorage, "read", reading)
    return counts


def planned(store: Store, modifications: int, shard_rows: int = 3, **spec: int) -> SceneStore:
    request = Request(modifications=modifications, views_per_modification=2)
    return store.scene(store.plan(samples.small_spec(**spec), request, shard_rows=shard_rows).scene_id)


def again(scene: SceneStore) -> SceneStore:
    """The same scene, as another process opens it."""
    return Store(scene.folder.parents[1]).scene(scene.scene_id)


def test_a_job_costs_as_many_files_of_a_large_plan_as_of_a_small_one(store: Store, read: Counter[str]) -> None:
    costs = []
    for modifications in (20, 320):
        scene = again(planned(store, modifications, points=modifications))
        read.clear()
        assert scene.jobs() == -(-2 * modifications // 3)
        assert not scene.is_done(4)
        assert len(scene.job_rows(4).samples) == 3
        costs.append(read.total())
    assert costs[0] == costs[1] <= 2 + 6 * 3, "zarr.json of plan and inputs, and the two chunks that the job lies in"


def test_jobs_in_turn_read_each_chunk_once(store: Store, read: Counter[str]) -> None:
    scene = again(planned(store, 40))
    read.clear()
    for job in range(scene.jobs()):
        scene.job_rows(job)
    assert set(read.values()) == {1}
    assert 6 * 9 < sum("/c." in name for name in read) <= 6 * 11, "81 rows lie in 11 chunks"


def test_what_is_read_by_chunks_is_what_is_read_whole(store: Store) -> None:
    planned(store, 20)
    scene = planned(store, 50)  # a second plan, some of whose samples refer to the first
    scene.plan(Request(modifications=50, views_per_modification=3), shard_rows=3)
    lazy, whole = again(scene), again(scene)
    held = whole.plans()
    for job in range(lazy.jobs()):
        found, wanted = lazy.job_rows(job), plans.job_rows(held, job)
        assert (found.samples, found.new_views) == (wanted.samples, wanted.new_views)
        assert found.modifications.keys() == wanted.modifications.keys()
        assert all(np.array_equal(view.vector, wanted.views[row].vector) for row, view in found.views.items())
    for plan, loaded in zip(lazy._declared(), held, strict=True):
        assert not hasattr(plan.rows, "_all") or plan.rows._all is None, "nothing has been read whole"
        rows = np.random.default_rng(0).integers(0, plan.jobs * 3, 40)
        for name in plans.INPUTS:
            assert np.array_equal(plan.rows.some(name, rows), getattr(loaded.rows, name)[rows], equal_nan=True)
        assert len(plan.rows.some("view", np.zeros(0, np.int64))) == 0


def test_damage_keeps_the_jobs_from_being_queued_whose_inputs_it_is_in(store: Store) -> None:
    scene = planned(store, 40)
    chunk = scene.folder / "plans/000000/view/c.5.0"  # of rows 40 to 47
    chunk.write_bytes(chunk.read_bytes()[:-1] + b"\0")
    assert len(again(scene).job_rows(0).samples) == 3
    with pytest.raises(CorruptError, match="view"):
        again(scene).job_rows(14)
    with pytest.raises(CorruptError, match="view"):
        again(scene).missing_jobs()
    with pytest.raises(CorruptError, match="view"):
        again(scene).plans()


def test_progress_is_followed_without_what_it_does_not_need(store: Store, read: Counter[str]) -> None:
    scene = planned(store, 40)
    lazy = again(scene)
    read.clear()
    assert lazy.progress(followed=True).planned_samples == 80
    assert {name.split("/")[-2] for name in read if "/c." in name} == {"sample_modification", "sample_view"}
    samples.commit(scene, 0, samples.outputs(scene, 0))
    read.clear()
    progress = lazy.progress(followed=True)
    assert not any("/c." in name for name in read)
    assert progress == scene.progress()
    assert progress.committed_samples == 3


def test_what_guides_lack_is_found_without_the_whole_plan(store: Store, read: Counter[str]) -> None:
    scene = planned(store, 40)
    scene.guides.want(scene.spec.guides)
    for job in (3, 4):
        samples.commit(scene, job, samples.outputs(scene, job))
    samples.commit_guides(scene, 3)
    lazy = again(scene)
    assert lazy.guides.lacks(lazy._declared(), [3, 4]) == [4]
    read.clear()
    assert [job for job in again(scene).missing_jobs() if job < 6] == [0, 1, 2, 4, 5]
