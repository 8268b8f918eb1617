"""How many samples a job has: seconds of work, and several jobs for every worker."""

import pytest
import store_samples as samples
from click.testing import CliRunner

from photonfarm.cli.main import umbrella
from photonfarm.farm import submission
from photonfarm.farm.devices import DEVICE_VARIABLE
from photonfarm.farm.submission import CARD_ROWS, choose_rows_per_job, estimate_sample_seconds
from photonfarm.plan.request import SHARD_ROWS, Request
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import NamedSpec
from photonfarm.store import Store
from photonfarm.store.read.find import scene_named


def spec_of(side: int, half_spp: int) -> SceneSpec:
    return samples.small_spec(film={"width": side, "height": side}, transport={"half_spp": half_spp})


def test_thirty_two_costly_samples_give_every_worker_several_jobs() -> None:
    spec = spec_of(256, 64)
    assert estimate_sample_seconds(spec) > submission.MOST_S
    assert choose_rows_per_job(spec, Request(modifications=32), workers=2) == 1


def test_jobs_of_a_large_plan_take_some_seconds() -> None:
    for side, half_spp in ((64, 4), (128, 8), (256, 16), (512, 64)):
        spec = spec_of(side, half_spp)
        rows = choose_rows_per_job(spec, Request(modifications=100_000), workers=8)
        assert rows == 1 or rows * estimate_sample_seconds(spec) <= 1.5 * submission.MOST_S
        assert rows in (1, SHARD_ROWS) or rows * estimate_sample_seconds(spec) >= submission.LEAST_S


def test_jobs_for_a_card_have_more_samples_and_take_some_seconds_of_it() -> None:
    request = Request(modifications=100_000)
    for side, half_spp, most in ((64, 4, CARD_ROWS), (256, 4, CARD_ROWS), (256, 16, CARD_ROWS), (512, 64, 10)):
        spec = spec_of(side, half_spp)
        rows = choose_rows_per_job(spec, request, workers=1, on_card=True)
        seconds = rows * estimate_sample_seconds(spec, on_card=True)
        assert choose_rows_per_job(spec, request, workers=1) < rows <= most
        assert submission.LEAST_S <= seconds <= 1.5 * submission.MOST_S


def test_submit_sizes_jobs_for_the_device_that_it_is_told(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether or not this machine has it."""
    rows = []
    for name, device in (("room", "cuda"), ("cornell", "cpu")):
        monkeypatch.setenv(DEVICE_VARIABLE, device)
        command = ["submit", name, "--store", str(store.root), "--no-queue", "--modifications", "1000"]
        done = CliRunner().invoke(umbrella, command)
        assert done.exit_code == 0, done.output
        rows.append(Store(store.root).scene(scene_named(store, name)).plans()[0].shard_rows)
    assert SHARD_ROWS < rows[0] <= CARD_ROWS
    assert rows[1] <= SHARD_ROWS


def test_a_configuration_is_not_split_over_jobs_if_one_holds_it() -> None:
    request = Request(modifications=1000, views_per_modification=3, passes=2)
    assert choose_rows_per_job(spec_of(64, 4), request, workers=2) % 6 == 0


def test_the_first_plan_fixes_the_size_and_a_later_one_asks_for_no_other(store: Store) -> None:
    spec = spec_of(256, 64)
    named = NamedSpec("small", spec, None)
    submission.submit(named, store.root, None, Request(modifications=4), workers=2)
    scene = Store(store.root).scene(spec.scene_id)
    assert scene.plans()[0].shard_rows == 1
    submission.submit(named, store.root, None, Request(modifications=9), workers=64)
    assert [plan.shard_rows for plan in scene.plans()] == [1, 1]


@pytest.mark.parametrize("shard_rows", [1, 5, 32])
def test_what_a_user_asks_for_comes_first_and_names_the_same_samples(store: Store, shard_rows: int) -> None:
    named = NamedSpec("small", spec_of(8, 1), None)
    request = Request(modifications=7, views_per_modification=2)
    submission.submit(named, store.root, None, request, shard_rows=shard_rows)
    (plan,) = Store(store.root).scene(named.spec.scene_id).plans()
    assert plan.shard_rows == shard_rows
    other = Store(f"{store.root}-2", create=True)
    (usual,) = other.scene(other.plan(named.spec, request).scene_id).plans()
    keys = [each.rows.sample_key[each.rows.sample_pass >= 0].tolist() for each in (plan, usual)]
    assert keys[0] == keys[1]
