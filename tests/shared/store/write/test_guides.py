"""Guides come to stores of any age: they arrive job by job, and nothing else in the store is touched."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import store_samples as samples
from click.testing import CliRunner

from photonfarm.shared.cli.main import umbrella
from photonfarm.shared.core.errors import CorruptError, IncompleteError, QueueError, SpecError, StoreError
from photonfarm.shared.core.records import arrays_of
from photonfarm.shared.farm.redis_server import EmbeddedRedis
from photonfarm.shared.farm.submission import submit
from photonfarm.shared.farm.upgrade import upgrade
from photonfarm.shared.plan.request import Request
from photonfarm.shared.plan.top_up import TopUp
from photonfarm.shared.queue import connect, open_queue
from photonfarm.shared.queue.entries import queued_names
from photonfarm.shared.scene.spec import GuideSpec
from photonfarm.shared.scene.spec_loading import NamedSpec
from photonfarm.shared.store import SceneReader, SceneStore, Store, store_status
from photonfarm.shared.store.format.declarations import GUIDES
from photonfarm.shared.store.write.guides import NOISY, rounded

REQUEST = Request(modifications=5, views_per_modification=2)


@pytest.fixture(scope="module")
def older(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An older store: three jobs of 4, 4 and 2 samples, all committed, and the base; nobody has asked for guides."""
    store = Store(tmp_path_factory.mktemp("older") / "store", create=True)
    scene = store.scene(store.plan(samples.small_spec(), REQUEST, shard_rows=4).scene_id)
    samples.commit_all(scene)
    scene.write_base(*samples.base())
    return Path(store.root)


@pytest.fixture
def store(older: Path, tmp_path: Path) -> Store:
    """A copy of it."""
    shutil.copytree(older, tmp_path / "store")
    return Store(tmp_path / "store")


@pytest.fixture
def scene(store: Store) -> SceneStore:
    return store.scenes()[0]


def files(scene: SceneStore) -> dict[str, tuple[bytes, int, int]]:
    """Every file of a scene but its guides': its bytes, and which file it is, and since when."""
    found = [path for path in scene.folder.rglob("*") if path.is_file()]
    below = {str(path.relative_to(scene.folder)): path for path in found}
    return {
        name: (path.read_bytes(), path.stat().st_ino, path.stat().st_mtime_ns)
        for name, path in below.items()
        if not name.startswith("guides/")
    }


def reader_of(scene: SceneStore, **options: bool) -> SceneReader:
    return SceneReader(scene.folder.parent.parent, scene.scene_id, **options)


# --------------------------------------------------------------------------------------------------------- older stores


def test_an_older_store_is_read_as_before_and_lacks_nothing(store: Store, scene: SceneStore) -> None:
    assert scene.guides.settings() is None
    assert (scene.missing_jobs(), scene.is_done(0)) == ([], True)
    reader = reader_of(scene)
    assert reader.refresh().size == 10
    assert reader.read(3).guides is None
    assert reader_of(scene, guides=True).refresh().size == 0
    assert store_status(store)[0].views_guided is None
    assert not (scene.folder / "guides").exists()


def test_its_spec_and_scene_id_do_not_know_of_guides() -> None:
    spec = samples.small_spec()
    other = samples.small_spec(guides={"light_samples": 7})
    assert spec.scene_id == other.scene_id
    assert (spec.guides, other.guides) == (GuideSpec(), GuideSpec(light_samples=7))


def test_rows_appear_as_their_guides_arrive_and_no_other_file_is_touched(scene: SceneStore) -> None:
    before, reader = files(scene), reader_of(scene, guides=True)
    assert scene.guides.want(GuideSpec())
    assert scene.missing_jobs() == [0, 1, 2]
    assert reader.refresh().size == 0
    for job, rows in ((1, [4, 5, 6, 7]), (0, [0, 1, 2, 3]), (2, [8, 9])):
        assert samples.commit_guides(scene, job)
        assert reader.refresh().tolist() == rows
        assert job not in scene.missing_jobs()
    for row in range(10):
        known = reader.read(row).guides
        assert known is not None
        for name, values in arrays_of(samples.guides(scene.spec, reader.view_row(row))).items():
            expected = rounded(values) if name in NOISY else values
            np.testing.assert_array_equal(getattr(known, name), expected, err_msg=name)
            assert name not in NOISY or (rounded(values) != values).any()
    assert files(scene) == before


def test_a_top_up_without_new_views_needs_no_guides(scene: SceneStore) -> None:
    scene.guides.want(GuideSpec())
    for job in range(3):
        samples.commit_guides(scene, job)
    scene.plan(TopUp.of("+16", ()))
    assert scene.missing_jobs() == list(range(3, scene.jobs()))
    samples.commit_all(scene)
    assert scene.missing_jobs() == []
    reader = reader_of(scene, guides=True)
    assert reader.refresh().size == scene.progress().planned_samples > 10
    late = reader.read(int(reader.rows[-1]))
    assert late.guides is not None
    assert late.pass_ > 0


def test_a_new_job_whose_guides_are_there_and_whose_samples_are_not_is_missing(scene: SceneStore) -> None:
    """A worker renders the guides first, and may die then."""
    scene.guides.want(GuideSpec())
    for job in range(3):
        samples.commit_guides(scene, job)
    scene.plan(Request(modifications=6, views_per_modification=2))
    assert scene.missing_jobs() == [3]
    samples.commit_guides(scene, 3)
    reader = reader_of(scene, guides=True)
    assert (scene.missing_jobs(), scene.is_done(3), reader.refresh().size) == ([3], False, 10)
    samples.commit(scene, 3, samples.outputs(scene, 3))
    assert (scene.missing_jobs(), scene.is_done(3), reader.refresh().tolist()) == ([], True, [12, 13])


def test_samples_that_show_views_of_other_jobs_wait_for_the_guides_of_those(scene: SceneStore) -> None:
    scene.guides.want(GuideSpec())
    scene.plan(Request(modifications=5, views_per_modification=2, passes=2))
    for job in range(3, scene.jobs()):
        samples.commit(scene, job, samples.outputs(scene, job))
    samples.commit_guides(scene, 0)
    reader = reader_of(scene, guides=True)
    rows = reader.refresh()
    assert {reader.view_row(row) for row in rows.tolist()} == set(range(4))
    assert rows.size == 8


def test_guides_in_a_bucket_are_those_of_a_folder(url: str) -> None:
    store = Store(url, create=True)
    scene = store.scene(store.plan(samples.small_spec(), Request(modifications=2), shard_rows=2).scene_id)
    samples.commit_all(scene)
    (about,) = upgrade(url, None).scenes
    assert (about.asked, about.views_lacking, about.jobs_lacking) == (True, 2, 1)
    samples.commit_guides(scene, 0)
    reader = SceneReader(url, scene.scene_id, guides=True)
    assert reader.refresh().tolist() == [0, 1]
    known = reader.read(1).guides
    assert known is not None
    np.testing.assert_array_equal(known.emission, samples.guides(scene.spec, 1).emission)


# ------------------------------------------------------------------------------------------------------------- settings


def test_settings_are_fixed_by_whoever_asks_first(scene: SceneStore) -> None:
    assert scene.guides.want(GuideSpec(light_samples=2))
    assert not scene.guides.want(GuideSpec(light_samples=2))
    again = Store(scene.folder.parent.parent).scene(scene.scene_id).guides
    assert not again.ask(GuideSpec(light_samples=5))
    assert again.settings() == GuideSpec(light_samples=2)
    with pytest.raises(SpecError):
        again.want(GuideSpec(light_samples=5))


def test_a_refused_submission_changes_nothing(store: Store, scene: SceneStore) -> None:
    def everything() -> dict[Path, int]:
        return {path: path.stat().st_mtime_ns for path in Path(store.root).rglob("*") if path.is_file()}

    before = everything()
    named, more = NamedSpec("small", scene.spec, None), Request(modifications=6)
    with pytest.raises(SpecError, match="shard_rows = 8"):
        submit(named, store.root, None, more, shard_rows=8)
    assert everything() == before
    scene.guides.ask(GuideSpec(light_samples=2))
    before = everything()
    with pytest.raises(SpecError, match="light_samples"):
        submit(named, store.root, None, more)
    assert everything() == before


def test_settings_of_a_later_program_are_read(scene: SceneStore) -> None:
    scene.guides.want(GuideSpec())
    file = scene.folder / "guides/settings.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "bounces": 2}))
    assert Store(scene.folder.parent.parent).scene(scene.scene_id).guides.settings() == GuideSpec()


@pytest.mark.parametrize("content", ["", "{", "3", '{"light_samples": -1}', "[" * 100_000])
def test_damaged_settings_are_an_error_that_says_what_helps(scene: SceneStore, content: str) -> None:
    (scene.folder / "guides").mkdir()
    (scene.folder / "guides/settings.json").write_text(content)
    with pytest.raises(CorruptError, match="store check --repair"):
        scene.missing_jobs()
    reader = reader_of(scene)
    assert reader.refresh().size == 10, "samples are read nevertheless"


# -------------------------------------------------------------------------------------------------------------- writing


def test_guides_are_committed_once_by_whoever_comes_first(scene: SceneStore) -> None:
    scene.guides.want(GuideSpec())
    with scene.guide_writer(0) as one, scene.guide_writer(0) as other:
        for row in range(4):
            one.guides(row, samples.guides(scene.spec, row))
            other.guides(row, samples.guides(scene.spec, row))
        assert other.commit(samples.FIGURES)
        kept = {path: path.stat().st_ino for path in (scene.folder / "guides").rglob("c.0.*")}
        assert not one.commit(samples.FIGURES)
    assert {path: path.stat().st_ino for path in (scene.folder / "guides").rglob("c.0.*")} == kept
    assert len(kept) == len(GUIDES)


def test_what_is_no_guide_of_the_job_is_refused_and_leaves_nothing(scene: SceneStore) -> None:
    scene.guides.want(GuideSpec())
    good = samples.guides(scene.spec, 0)
    large = samples.guides(scene.spec.model_copy(update={"film": scene.spec.film.model_copy(update={"width": 16})}), 0)
    with scene.guide_writer(0) as out:
        with pytest.raises(IncompleteError):
            out.guides(4, good)
        good.roughness[0, 0] = np.nan
        for row, refused, named in ((0, large, "emission"), (1, good, "roughness")):
            with pytest.raises(IncompleteError, match=named):
                out.guides(row, refused)
        with pytest.raises(IncompleteError):
            out.commit(samples.FIGURES)
    assert scene.guides.committed_jobs() == set()
    assert list(scene.storage.local("tmp").iterdir()) == []


def test_direct_light_is_rounded_to_8_significant_bits_to_the_nearest_and_ties_to_even() -> None:
    exact = np.array([0, 1, -1, 255, 256, 0.5**20, 2.0**127, 1.0078125], np.float32)
    np.testing.assert_array_equal(rounded(exact), exact)
    unit = np.float32(2.0**-7)  # between numbers of 8 bits from 1 on
    between = np.array([1 + unit / 2, 1 + 3 * unit / 2, 1 + 0.51 * unit, 1 + 1.49 * unit], np.float32)
    np.testing.assert_array_equal(rounded(between), np.array([1, 1 + 2 * unit, 1 + unit, 1 + unit], np.float32))
    many = np.random.default_rng(1).gamma(0.5, 3.0, 100_000).astype(np.float32)
    error = rounded(many) / many.astype(np.float64) - 1
    assert np.abs(error).max() <= 2.0**-8
    assert abs(error.mean()) < 4 * 2.0**-8 / np.sqrt(3 * len(many)), "as many up as down"
    assert not (rounded(many).view(np.uint32) & 0xFFFF).any()


def test_a_plan_is_refused_while_guides_are_there_of_a_job_that_no_plan_has(scene: SceneStore) -> None:
    """Its plan is lost, and a new one would take the number of its jobs."""
    scene.guides.want(GuideSpec())
    samples.commit_guides(scene, 0)
    folder = scene.folder / "guides/committed"
    (folder / "000000000003.json").write_bytes((folder / "000000000000.json").read_bytes())
    with pytest.raises(CorruptError, match=r"guides/committed/000000000003\.json"):
        scene.plan(Request(modifications=9))
    assert store_status(Store(scene.folder.parent.parent))[0].markers_without_plan == 1


# -------------------------------------------------------------------------------------------------------------- upgrade


def run(store: Store, *arguments: str, verb: tuple[str, ...] = ("store", "upgrade", "--no-queue")) -> Any:
    return CliRunner().invoke(umbrella, [*verb, "--store", str(store.root), *arguments], prog_name="photonfarm")


def told(store: Store, *arguments: str) -> dict[str, Any]:
    """What `store upgrade --json` says."""
    result = run(store, "--json", *arguments)
    assert result.exit_code == 0, result.output
    return dict(json.loads(result.stdout))


def test_an_upgrade_asks_once_and_says_how_far_it_is_whenever_it_is_repeated(store: Store, scene: SceneStore) -> None:
    before = files(scene)
    said = run(store).stdout
    assert scene.scene_id in said
    assert "10 of 10 views" in said
    assert "3 jobs" in said
    assert f"photonfarm work --until-complete --store {store.root}" in said
    samples.commit_guides(scene, 1)
    (again,) = told(store)["scenes"]
    assert (again["asked"], again["views_lacking"], again["views"], again["jobs_lacking"]) == (False, 6, 10, 2)
    for job in (0, 2):
        samples.commit_guides(scene, job)
    assert run(store).stdout.count("0 of 10 views lack them: 0 jobs to render") == 1
    assert "go on with" not in run(store).stdout
    assert files(scene) == before


def test_the_bytes_that_are_told_are_those_that_are_stored_and_a_bound(store: Store, scene: SceneStore) -> None:
    (before,) = told(store)["scenes"]
    assert before["bytes_per_sample"] == sum(p.stat().st_size for p in scene.folder.glob("plans/*/*/c.*.0*")
                                             if p.parent.name not in INPUTS) / 10  # fmt: skip
    for job in range(3):
        samples.commit_guides(scene, job)
    (after,) = told(store)["scenes"]
    assert {**before, "asked": False, "views_lacking": 0, "jobs_lacking": 0} == after
    status = store_status(store)[0]
    assert 0.4 * after["guide_bytes_per_sample"] < status.guide_bytes / 10 <= after["guide_bytes_per_sample"]
    noise = np.random.default_rng(0).standard_normal(8 * 8 * 3)  # does not compress
    assert len(noise) * 4 < after["guide_bytes_per_sample"]


INPUTS = ("modification", "view", "sample_modification", "sample_view", "sample_pass", "sample_key")


def test_a_dry_run_says_the_same_and_writes_nothing(store: Store, scene: SceneStore) -> None:
    before = set(Path(store.root).rglob("*"))
    said = run(store, "--dry-run", "--light-samples", "5").stdout
    assert "guides would be asked for, with 5 light samples" in said
    assert "10 of 10 views lack them: 3 jobs to render" in said
    assert set(Path(store.root).rglob("*")) == before
    (dry,) = told(store, "--dry-run")["scenes"]
    (done,) = told(store)["scenes"]
    assert dry == done


def test_settings_that_are_there_win(store: Store, scene: SceneStore) -> None:
    scene.guides.want(GuideSpec(light_samples=1))
    (about,) = told(store, "--light-samples", "9")["scenes"]
    assert (about["asked"], about["light_samples"]) == (False, 1)
    assert scene.guides.settings() == GuideSpec(light_samples=1)


def test_one_scene_is_upgraded_by_its_name_and_the_others_are_not(store: Store, scene: SceneStore) -> None:
    other = store.add(samples.small_spec(name="other", points=7))
    (about,) = told(store, "--scene", "other", "--light-samples", "0")["scenes"]
    assert (about["scene_id"], about["bytes_per_sample"], about["views"]) == (other.scene_id, None, 0)
    assert other.guides.settings() == GuideSpec(light_samples=0)
    assert scene.guides.settings() is None


def test_a_damaged_scene_is_told_and_the_others_are_upgraded(store: Store, scene: SceneStore) -> None:
    other = store.add(samples.small_spec(name="other", points=7))
    (other.folder / "spec.json").write_text("{")
    result = run(Store(store.root))
    assert isinstance(result.exception, StoreError)
    assert result.exception.exit_code == 4
    assert other.scene_id in str(result.exception)
    assert Store(store.root).scene(scene.scene_id).guides.settings() == GuideSpec()


def test_a_number_of_light_samples_that_cannot_be_is_refused(store: Store, scene: SceneStore) -> None:
    assert run(store, "--light-samples", "65").exit_code == 2
    with pytest.raises(SpecError):
        upgrade(store.root, None, light_samples=-1)
    assert scene.guides.settings() is None


def test_what_lacks_guides_is_queued_once(store: Store, scene: SceneStore, common_redis: EmbeddedRedis) -> None:
    with connect(common_redis.url) as connection:
        connection.flushall()
        assert upgrade(store.root, common_redis.url).queued == 3
        assert upgrade(store.root, common_redis.url, scene="small").queued == 0
        assert queued_names(open_queue(connection)) == [f"{scene.scene_id}-{job}" for job in range(3)]


def test_without_redis_guides_are_asked_for_and_the_error_says_so(store: Store, scene: SceneStore) -> None:
    with pytest.raises(QueueError, match="--no-queue"):
        upgrade(store.root, "redis://localhost:1/0")
    assert scene.guides.settings() == GuideSpec()


def test_submitting_an_older_scene_again_asks_for_guides_too(store: Store, scene: SceneStore, tmp_path: Path) -> None:
    (tmp_path / "small.json").write_text(samples.small_spec(guides={"light_samples": 4}).model_dump_json())
    result = submit(NamedSpec.load(str(tmp_path / "small.json")), store.root, None, REQUEST)
    assert (result.planned, result.planned_before) == (0, 10)
    assert scene.guides.settings() == GuideSpec(light_samples=4)


def test_status_tells_how_many_views_have_guides_and_counts_what_they_take(store: Store, scene: SceneStore) -> None:
    def of(*arguments: str) -> str:
        result = run(store, "--redis", "redis://localhost:1/0", *arguments, verb=("status",))
        assert result.exit_code == 0, result.output
        return str(result.stdout)

    def about() -> dict[str, Any]:
        (scene_about,) = json.loads(of("--json"))["scenes"]
        return dict(scene_about)

    before = about()
    assert (before["views_planned"], before["views_guided"], before["guide_bytes"]) == (10, None, 0)
    assert "guides" not in of()
    scene.guides.want(GuideSpec())
    samples.commit_guides(scene, 1)
    after = about()
    held = sum(path.stat().st_size for path in (scene.folder / "guides").rglob("c.1.*"))
    assert (after["views_guided"], after["guide_jobs"], after["guide_bytes"]) == (4, 1, held)
    assert after["size_bytes"] == before["size_bytes"] + held
    assert after["core_s"] == before["core_s"] + samples.FIGURES.core_s
    assert re.search(r"small +[0-9a-f]{32} +10/10 +3/3 +4/10 views", of())


def test_the_verb_needs_neither_mitsuba_nor_torch_nor_redis_for_its_help() -> None:
    code = (
        "import sys; from photonfarm.shared.cli.main import main\n"
        "try: main(['store', 'upgrade', '--help'])\n"
        "except SystemExit: pass\n"
        "assert not {'mitsuba', 'drjit', 'torch', 'zarr', 'rq'} & sys.modules.keys(), sys.modules.keys()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "--light-samples" in done.stdout
