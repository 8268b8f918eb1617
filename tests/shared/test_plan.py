"""Requests become rows and jobs; what is planned stays, and is not planned again."""

import importlib.util
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from photonfarm.shared.errors import SpecError
from photonfarm.shared.plan import MAX_SAMPLES, UNUSED, Request
from photonfarm.shared.store import SceneStore, Store

_spec = importlib.util.spec_from_file_location("store_samples", Path(__file__).with_name("store_samples.py"))
samples = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(samples)

Triple = tuple[bytes, bytes, int]


def planned(scene: SceneStore) -> list[Triple]:
    """Modification vector, view vector and pass of every planned sample."""
    rows = [s for job in range(scene.jobs()) for s in scene.job_rows(job).samples]
    jobs = {job: scene.job_rows(job) for job in range(scene.jobs())}
    j = scene.plans()[0].shard_rows
    return [
        (
            jobs[s.row // j].modifications[s.modification_row].vector.tobytes(),
            jobs[s.row // j].views[s.view_row].vector.tobytes(),
            s.pass_,
        )
        for s in rows
    ]


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store", create=True)


def test_a_request_is_every_combination_of_modification_view_and_pass(store: Store) -> None:
    result = store.plan(samples.small_spec(), Request(modifications=5, views_per_modification=3, passes=2))
    scene = store.scene(result.scene_id)
    found = planned(scene)
    assert (result.plan, result.new, result.known, result.jobs) == (0, 30, 0, 1)
    assert len(set(found)) == 30
    assert {pass_ for *_, pass_ in found} == {0, 1}


def test_what_a_job_renders_is_ordered_so_that_the_scene_is_edited_least(store: Store) -> None:
    result = store.plan(
        samples.small_spec(), Request(modifications=4, views_per_modification=3, passes=2), shard_rows=5
    )
    scene = store.scene(result.scene_id)
    for job in range(scene.jobs()):
        order = [(s.modification_row, s.view_row, s.pass_) for s in scene.job_rows(job).samples]
        assert order == sorted(order)


def test_every_view_and_modification_is_rendered_by_exactly_one_job_which_is_the_first_to_need_it(store: Store) -> None:
    result = store.plan(
        samples.small_spec(), Request(modifications=7, views_per_modification=3, passes=2), shard_rows=4
    )
    scene = store.scene(result.scene_id)
    rows = [scene.job_rows(job) for job in range(scene.jobs())]
    for new, used in (("new_views", "views"), ("new_modifications", "modifications")):
        made = [row for r in rows for row in getattr(r, new)]
        assert len(made) == len(set(made))
        for row in {row for r in rows for row in getattr(r, used)}:
            first = min(r.job for r in rows if row in getattr(r, used))
            assert row // 4 == first
            assert row in getattr(rows[first], new)


@pytest.mark.parametrize(
    "larger",
    [
        Request(modifications=9, views_per_modification=2, passes=2),
        Request(modifications=6, views_per_modification=5, passes=2),
        Request(modifications=6, views_per_modification=2, passes=4),
    ],
)
def test_a_grown_request_plans_only_what_is_new_and_refers_to_the_rest(store: Store, larger: Request) -> None:
    spec = samples.small_spec()
    scene = store.scene(store.plan(spec, Request(modifications=6, views_per_modification=2, passes=2)).scene_id)
    before = planned(scene)
    result = store.plan(spec, larger)
    after = planned(scene)
    assert (result.new, result.known) == (larger.samples - 24, 24)
    assert after[:24] == before
    assert len(set(after)) == larger.samples
    rows = [scene.job_rows(job) for job in range(scene.jobs())]
    views = {(r.modifications[s.modification_row].vector.tobytes(), r.views[s.view_row].vector.tobytes()): s.view_row
             for r in rows for s in r.samples}  # fmt: skip
    assert sum(len(r.new_views) for r in rows) == len(views)
    assert set(views.values()) == {row for r in rows for row in r.new_views}


def test_the_same_request_again_plans_nothing(store: Store) -> None:
    request = Request(modifications=3, views_per_modification=2)
    store.plan(samples.small_spec(), request)
    again = store.plan(samples.small_spec(), request)
    assert (again.plan, again.new, again.known) == (None, 0, 6)


def test_another_seed_plans_other_samples(store: Store) -> None:
    store.plan(samples.small_spec(), Request(modifications=3, seed=0))
    assert store.plan(samples.small_spec(), Request(modifications=3, seed=1)).new >= 2


def test_a_static_scene_has_one_modification_and_as_many_views_as_were_asked_for(store: Store) -> None:
    result = store.plan(
        samples.small_spec(objects=[]), Request(modifications=20, views_per_modification=3), shard_rows=8
    )
    scene = store.scene(result.scene_id)
    rows = [scene.job_rows(job) for job in range(scene.jobs())]
    assert result.new == 60
    assert len({view for _, view, _ in planned(scene)}) == 60
    assert [row for r in rows for row in r.new_modifications] == [0]
    assert store.plan(samples.small_spec(objects=[]), Request(modifications=30, views_per_modification=2)).new == 0


def test_equal_configurations_are_one_modification_with_more_views_in_their_share(store: Store) -> None:
    """30 % of the configurations have the object removed; binomial, 400 draws: 0.30 ± 0.07 at 3 sigma."""
    scene = store.scene(store.plan(samples.small_spec(), Request(modifications=400, views_per_modification=2)).scene_id)
    found = planned(scene)
    removed = [view for modification, view, _ in found if np.frombuffer(modification, np.float32)[3] == 0]
    assert len(set(found)) == 800
    assert 0.23 < len(removed) / 800 < 0.37
    assert len(set(removed)) == len(removed)
    assert len({row for job in range(scene.jobs()) for row in scene.job_rows(job).new_modifications}) < 400


def test_the_rows_per_job_are_fixed_by_the_first_plan(store: Store) -> None:
    spec = samples.small_spec()
    store.plan(spec, Request(modifications=3), shard_rows=8)
    assert store.plan(spec, Request(modifications=12)).jobs == 2
    with pytest.raises(SpecError, match=r"shard_rows = 16: scene .* has 8 samples per job"):
        store.plan(spec, Request(modifications=13), shard_rows=16)


def test_unused_rows_of_a_last_job_are_marked_and_never_asked_for(store: Store) -> None:
    scene = store.scene(store.plan(samples.small_spec(), Request(modifications=5), shard_rows=4).scene_id)
    (plan,) = scene.plans()
    assert plan.samples == 5
    assert (plan.rows.sample_modification[5:] == UNUSED).all()
    assert len(scene.job_rows(1).samples) == 1


def test_a_dry_run_counts_and_writes_nothing(store: Store) -> None:
    result = store.plan(samples.small_spec(), Request(modifications=5), dry_run=True)
    assert (result.plan, result.new) == (None, 5)
    assert store.scene_ids() == []


@pytest.mark.parametrize("wrong", [{"modifications": 0}, {"passes": 0}, {"seed": -1}, {"views_per_modification": 1.5}])
def test_a_request_out_of_its_limits_is_refused_in_a_sentence_with_key_and_value(wrong: dict[str, int]) -> None:
    ((key, value),) = wrong.items()
    with pytest.raises(SpecError, match=f"{key} = {value}"):
        Request.of(**wrong)


def test_a_request_larger_than_memory_should_hold_is_refused() -> None:
    with pytest.raises(SpecError, match=str(MAX_SAMPLES)):
        Request.of(modifications=10_000, views_per_modification=10_000)


def test_racing_submitters_plan_every_sample_exactly_once(store: Store) -> None:
    code = """
import importlib.util, sys
from photonfarm.shared.plan import Request
from photonfarm.shared.store import Store
spec = importlib.util.spec_from_file_location("store_samples", sys.argv[1])
samples = importlib.util.module_from_spec(spec)
spec.loader.exec_module(samples)
store = Store(sys.argv[2])
sys.stdin.readline()
for modifications in range(1, 13):
    store.plan(samples.small_spec(), Request(modifications=modifications, views_per_modification=2), shard_rows=4)
"""
    helper = str(Path(__file__).with_name("store_samples.py"))
    racers = [
        subprocess.Popen([sys.executable, "-c", code, helper, str(store.root)], stdin=subprocess.PIPE) for _ in range(2)
    ]
    for racer in racers:
        racer.stdin.write(b"go\n")
        racer.stdin.flush()
    assert [racer.wait(60) for racer in racers] == [0, 0]
    for racer in racers:
        racer.stdin.close()
    (scene,) = store.scenes()
    found = planned(scene)
    assert len(found) == len(set(found)) == 24
    plans = scene.plans()
    assert [plan.number for plan in plans] == list(range(len(plans)))
    assert all(a.first_job + a.jobs == b.first_job for a, b in pairwise(plans))
    assert not list(scene.storage.local("tmp").iterdir())
