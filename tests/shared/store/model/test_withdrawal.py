"""What is planned and not rendered is withdrawn; what is rendered stays."""

import json
import threading

import numpy as np
import pytest
import store_samples as samples

from photonfarm.core.errors import CorruptError, SpecError
from photonfarm.plan.request import Request
from photonfarm.plan.top_up import TopUp
from photonfarm.store import JobWriter, SceneStore, Store
from photonfarm.store.check.check import check_store
from photonfarm.store.format import markers
from photonfarm.store.model.lease import announce_work
from photonfarm.store.model.store import scene_status
from photonfarm.store.model.withdrawal import withdraw

REQUEST = Request(modifications=8, views_per_modification=1)


@pytest.fixture
def scene(store: Store) -> SceneStore:
    """Four jobs of two samples, each with configurations of its own; the first and the third are committed."""
    scene = store.scene(store.plan(samples.small_spec(**samples.ALWAYS), REQUEST, shard_rows=2).scene_id)
    scene.write_base(*samples.base())
    for job in (0, 2):
        assert samples.commit(scene, job, samples.outputs(scene, job))
    return scene


def fresh(scene: SceneStore) -> SceneStore:
    return SceneStore(scene.storage, scene.scene_id)


def test_what_is_not_rendered_is_forgotten_and_what_is_stays(scene: SceneStore) -> None:
    reader = samples.reader_of(scene)
    before, requests = reader.rows.tolist(), list(reader.plan_requests)
    done = withdraw(fresh(scene))
    assert (done.jobs, done.samples, done.rendered, done.kept) == (2, 4, 4, 0)
    for each in (scene, fresh(scene)):
        assert each.missing_jobs() == []
        progress = each.progress()
        assert (progress.planned_samples, progress.committed_samples) == (4, 4)
        status = scene_status(each)
        assert (status.jobs_planned, status.jobs_committed, status.markers_without_plan) == (2, 2, 0)
    reader.refresh()
    assert reader.rows.tolist() == before
    assert reader.planned == 4
    assert reader.plan_requests == requests, "a run that trained on them goes on"
    assert withdraw(scene).jobs == 0


def test_what_was_forgotten_is_planned_again_and_nothing_is_there_twice(scene: SceneStore) -> None:
    before = samples.reader_of(scene).rows_by_key()
    withdraw(scene)
    planned = scene.plan(REQUEST)
    assert (planned.new, planned.known) == (4, 4)
    for job in scene.missing_jobs():
        assert samples.commit(scene, job, samples.outputs(scene, job))
    after = samples.reader_of(scene).rows_by_key()
    assert before.items() <= after.items()
    assert len(after) == len(samples.reader_of(scene).rows) == 8
    assert check_store(Store(scene.storage.where), when="now").exit_code == 0


def test_a_worker_that_was_at_a_withdrawn_job_throws_it_away(scene: SceneStore) -> None:
    given = samples.outputs(scene, 1)
    with JobWriter(scene, scene.job_rows(1)) as out:
        samples.give(out, given)
        withdraw(fresh(scene))
        assert not out.commit(samples.FIGURES)
    assert scene.committed_jobs() == {0, 2}
    assert not scene.is_to_do(1)


def test_the_job_in_hand_is_waited_for_and_stays(scene: SceneStore) -> None:
    taken, waited = threading.Event(), threading.Event()

    def work() -> None:
        with announce_work(scene.storage, scene.scene_id, "worker w1 at job 1"):
            taken.set()
            assert waited.wait(20)
            assert samples.commit(scene, 1, samples.outputs(scene, 1))

    worker = threading.Thread(target=work)
    worker.start()
    assert taken.wait(20)
    said: list[str] = []
    done = withdraw(fresh(scene), on_wait=lambda sentence: (said.append(sentence), waited.set()))
    worker.join()
    assert (done.jobs, done.rendered) == (1, 6)
    assert "store withdraw waits for worker w1 at job 1" in said[0]
    assert fresh(scene).progress().committed_samples == 6


def test_views_that_rendered_samples_show_stay_planned(store: Store) -> None:
    request = Request(views_per_modification=6)  # one configuration, in the first job
    scene = store.scene(store.plan(samples.small_spec(), request, shard_rows=2).scene_id)
    samples.commit(scene, 1, samples.outputs(scene, 1))
    done = withdraw(scene)
    assert (done.jobs, done.samples, done.rendered, done.kept) == (1, 2, 2, 2)
    assert scene.missing_jobs() == [0]
    samples.commit(scene, 0, samples.outputs(scene, 0))
    assert samples.reader_of(scene).rows.tolist() == [0, 1, 2, 3]


def test_a_later_plan_that_leans_on_it_is_withdrawn_first(scene: SceneStore) -> None:
    scene.plan(TopUp.of("+8", ["rows=2-3"]))
    with pytest.raises(SpecError, match=r"plan 1 has samples of its views or configurations; withdraw plan 1 first"):
        withdraw(scene, 0)
    assert not list(scene.folder.glob("plans/*.withdrawn.json")), "nothing was written"
    assert withdraw(scene, 1).samples == 2
    assert withdraw(scene, 0).jobs == 2
    with pytest.raises(SpecError, match="has no plan 2; the last one is 1"):
        withdraw(scene, 2)


def test_without_a_number_it_is_the_last_plan_that_has_something_to_withdraw(scene: SceneStore) -> None:
    scene.plan(Request(modifications=10))
    assert [withdraw(scene).plan, withdraw(scene).plan] == [1, 0]
    scene.plan(Request(modifications=3))
    scene.plan(Request(modifications=2, views_per_modification=2))
    for job in set(scene.missing_jobs()) & set(range(scene.plans()[3].first_job, scene.jobs())):
        assert samples.commit(scene, job, samples.outputs(scene, job))
    nothing = withdraw(scene, 3)
    assert (nothing.jobs, nothing.left) == (0, "not rendered yet: 1 sample of plan 2")
    done = withdraw(scene)
    assert (done.plan, done.samples, withdraw(scene).left) == (2, 1, "not rendered yet: none")


def test_rows_of_withdrawn_jobs_are_unused(scene: SceneStore) -> None:
    withdraw(scene)
    (plan,) = fresh(scene).plans()
    assert plan.withdrawn == {1, 3}
    unused = plan.rows.sample_modification == -1
    np.testing.assert_array_equal(np.flatnonzero(unused), [2, 3, 6, 7])
    assert np.isnan(plan.rows.view[unused]).all()
    file = scene.folder / "plans/000000.withdrawn.json"
    assert json.loads(file.read_text()) == {"jobs": [1, 3]}
    file.write_text("[]")
    with pytest.raises(CorruptError, match="names no jobs"):
        fresh(scene).plans()


def test_processes_that_follow_see_each_withdrawal_of_a_plan(scene: SceneStore) -> None:
    reader, other = samples.reader_of(scene), fresh(scene)
    other.plans()
    for jobs in ({1}, {1, 3}, {3}):
        markers.write_withdrawn(scene.storage, f"{scene.name}/plans/000000", jobs)
        reader.refresh()
        assert reader.planned == 8 - 2 * len(jobs)
        assert other.missing_jobs() == sorted({1, 3} - jobs)
    assert samples.commit(other, 1, samples.outputs(other, 1))
    assert reader.refresh().tolist() == [2, 3]
