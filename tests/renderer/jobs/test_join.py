"""Two stores of one room become one: `photonfarm store join`."""

import signal
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from click.testing import CliRunner
from store_samples import reader_of

from photonfarm.cli.store_verbs import join as verb
from photonfarm.core.errors import CorruptError, SpecError
from photonfarm.core.records import arrays_of
from photonfarm.farm.join import join
from photonfarm.plan.request import Request
from photonfarm.plan.top_up import TopUp
from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.scene.spec import SceneSpec
from photonfarm.store import SceneStore, Store
from photonfarm.store.check.check import check_store


def rendered(store: Store, spec: SceneSpec, analytic: ModuleType, *requests: Request | TopUp) -> SceneStore:
    scene = store.add(spec)
    for request in requests:
        scene.plan(request, shard_rows=None if scene.plans() else 3)
    analytic.render_missing(store, spec.scene_id)
    return scene


def check_holds(scene: SceneStore, *others: SceneStore) -> None:
    """Every complete sample of the others is there once, bit for bit, and nothing else is complete."""
    here = reader_of(scene)
    rows = here.rows_by_key()
    assert len(rows) == len(here.rows)
    assert rows.keys() == {key for other in others for key in reader_of(other).rows_by_key()}
    for other in others:
        there = reader_of(other)
        for key, row in there.rows_by_key().items():
            a, b = there.read(row, guides=True), here.read(rows[key], guides=True)
            np.testing.assert_array_equal(a.radiance, b.radiance)
            assert a.guides is not None
            assert b.guides is not None
            for one, two in ((a.buffers, b.buffers), (a.guides, b.guides), (a.visibility, b.visibility)):
                for name, values in arrays_of(one).items():
                    np.testing.assert_array_equal(values, getattr(two, name))
            if scene.spec.photons.paths:
                for name, values in arrays_of(there.read_photons(row)).items():
                    np.testing.assert_array_equal(values, getattr(here.read_photons(rows[key]), name))
    report = check_store(Store(scene.storage.where), when="now")
    assert report.exit_code == 0, report


@pytest.fixture
def stores(tmp_path: Path, analytic: ModuleType) -> tuple[SceneStore, SceneStore]:
    """Two stores of one scene: samples of two seeds, of which some are in both; one was topped up."""
    spec = analytic.small_spec()
    first = rendered(Store(tmp_path / "a", create=True), spec, analytic, Request(modifications=3, passes=2))
    requests = Request(modifications=2, views_per_modification=2), Request(modifications=2, seed=1), TopUp.of("+16")
    return first, rendered(Store(tmp_path / "b", create=True), spec, analytic, *requests)


def test_a_store_is_joined_with_another(stores: tuple[SceneStore, SceneStore], tmp_path: Path) -> None:
    here, there = stores
    alone = SceneStore(Store(tmp_path / "a").storage, here.scene_id)
    before = reader_of(alone).rows_by_key()
    (told,) = join(tmp_path / "a", tmp_path / "b")
    assert told.there == len(reader_of(there).rows)
    assert 0 < told.planned < told.there
    check_holds(here, there, *([] if before.keys() <= reader_of(there).rows_by_key().keys() else [here]))
    assert before.items() <= reader_of(here).rows_by_key().items(), "what was there stays in its rows"
    (again,) = join(tmp_path / "a", tmp_path / "b")
    assert (again.planned, again.jobs) == (0, 0)


def test_a_new_store_becomes_one_with_all_samples(stores: tuple[SceneStore, SceneStore], tmp_path: Path) -> None:
    for other in "ab":
        join(tmp_path / "c", tmp_path / other)
    scene = Store(tmp_path / "c").scene(stores[0].scene_id)
    check_holds(scene, *stores)
    figures = [scene.marker(job)["figures"] for job in sorted(scene.committed_jobs())]
    assert {each["worker"] for each in figures} == {"test"}
    assert sum(each["taken_over"] for each in figures) == len(reader_of(scene).rows)
    assert {plan.request.kind for plan in scene.plans()} == {"join"}
    densities = np.concatenate([plan.rows.view_density for plan in scene.plans()])
    assert set(densities[~np.isnan(densities)]) == {1}


def test_what_is_planned_and_not_rendered_is_filled_in(
    stores: tuple[SceneStore, SceneStore], tmp_path: Path, analytic: ModuleType
) -> None:
    store = Store(tmp_path / "c", create=True)
    scene = store.add(analytic.small_spec())
    scene.plan(Request(modifications=3, passes=2), shard_rows=2)
    (told,) = join(tmp_path / "c", tmp_path / "a")
    assert (told.planned, told.jobs) == (0, 3)
    check_holds(scene, stores[0])


def test_jobs_here_that_are_not_whole_there_are_left_to_workers_and_counted(
    stores: tuple[SceneStore, SceneStore], tmp_path: Path, analytic: ModuleType
) -> None:
    store = Store(tmp_path / "c", create=True)
    scene = store.add(analytic.small_spec())
    scene.plan(Request(modifications=4, passes=2), shard_rows=4)
    (told,) = join(tmp_path / "c", tmp_path / "a")
    assert (told.there, told.planned, told.jobs, told.left) == (6, 0, 1, 2)
    said = CliRunner().invoke(verb, [str(tmp_path / "a"), "--store", str(tmp_path / "c")])
    assert "2 are left to workers, as their jobs here are not whole there" in said.output
    analytic.render_missing(store, scene.scene_id)
    assert len(reader_of(scene).rows) == 8


def test_workers_render_what_a_join_that_was_killed_had_planned(
    stores: tuple[SceneStore, SceneStore], tmp_path: Path, analytic: ModuleType
) -> None:
    class StopError(Exception):
        """Stands for a kill, after one job."""

    def stop(_name: str, done: int, _total: int) -> None:
        if done == 1:
            raise StopError

    with pytest.raises(StopError):
        join(tmp_path / "c", tmp_path / "b", on_progress=stop)
    store = Store(tmp_path / "c")
    scene = store.scene(stores[1].scene_id)
    assert scene.committed_jobs() == {0}
    ShardRenderer(store, worker="w", load=analytic.AnalyticScene.load).render(scene.scene_id, 1)
    (told,) = join(tmp_path / "c", tmp_path / "b")
    assert (told.planned, told.jobs) == (0, scene.jobs() - 2)
    check_holds(scene, stores[1])


@pytest.mark.slow
def test_a_join_that_is_killed_again_and_again_goes_on(tmp_path: Path, analytic: ModuleType) -> None:
    request = Request(modifications=60, views_per_modification=2)
    there = rendered(Store(tmp_path / "b", create=True), analytic.small_spec(), analytic, request)
    code = "from photonfarm.cli.store_verbs import join; join()"
    command = [sys.executable, "-c", code, str(tmp_path / "b"), "--store"]
    kills = 0
    for attempt in range(40):
        process = subprocess.Popen([*command, str(tmp_path / "c")], stderr=subprocess.DEVNULL)
        time.sleep(0.6 + 0.05 * attempt)
        if process.poll() is not None:
            assert process.returncode == 0
            break
        process.send_signal(signal.SIGKILL)
        process.wait()
        kills += 1
    assert process.returncode == 0
    assert kills
    check_holds(Store(tmp_path / "c").scene(there.scene_id), there)


def test_damaged_bytes_are_not_copied(stores: tuple[SceneStore, SceneStore], tmp_path: Path) -> None:
    file = next((stores[1].folder / "plans/000000/direct").glob("c.0.*"))
    content = bytearray(file.read_bytes())
    content[40] ^= 1
    file.write_bytes(content)
    with pytest.raises(CorruptError, match="direct"):
        join(tmp_path / "c", tmp_path / "b")
    assert not Store(tmp_path / "c").scene(stores[1].scene_id).committed_jobs()


def test_the_verb_says_what_it_has_copied(stores: tuple[SceneStore, SceneStore], tmp_path: Path) -> None:
    said = CliRunner().invoke(verb, [str(tmp_path / "b"), "--store", str(tmp_path / "c")])
    assert said.exit_code == 0, said.output
    count = len(reader_of(stores[1]).rows)
    assert f"{count} samples there, {count} planned here now, 0 before" in said.output
    with pytest.raises(SpecError, match="is the store that it is to be joined with"):
        join(tmp_path / "b", tmp_path / "b")


@pytest.mark.parametrize("name", ["sample_modification", "sample_key", "view/zarr.json"])
def test_damaged_inputs_of_a_join_are_taken_again_from_the_other_store(
    stores: tuple[SceneStore, SceneStore], tmp_path: Path, analytic: ModuleType, name: str
) -> None:
    """Also where the other store has more samples by now, which the keys of the plan tell."""
    here, there = stores
    join(tmp_path / "a", tmp_path / "b")
    here.plan(TopUp.of("+8"))
    analytic.render_missing(Store(tmp_path / "a"), here.scene_id)
    number = next(plan.number for plan in here.plans() if plan.request.kind == "join")
    (path,) = (here.folder / f"plans/{number:06d}").glob(name if "/" in name else f"{name}/c.0*")
    whole = path.read_bytes()
    path.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    if name != "sample_key":
        there.plan(Request(modifications=4, seed=2))
        analytic.render_missing(Store(tmp_path / "b"), there.scene_id)
    with pytest.raises(CorruptError, match=f"--joined-from OTHER` .* {Store(tmp_path / 'b').store_id}"):
        SceneStore(here.storage, here.scene_id).plans()
    for other in (None, Store(tmp_path / "a")):
        report = check_store(Store(tmp_path / "a"), when="now", repair=True, joined_from=other)
        assert (report.exit_code, path.read_bytes() == whole) == (4, False)
    report = check_store(Store(tmp_path / "a"), when="now", repair=True, joined_from=Store(tmp_path / "b"))
    assert (report.exit_code, path.read_bytes() == whole) == (7, True)
    assert check_store(Store(tmp_path / "a"), when="now").exit_code == 0
