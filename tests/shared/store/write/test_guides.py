"""Guides come to stores of any age: they arrive job by job, and nothing else in the store is touched."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import store_samples as samples
from older_store import files

from photonfarm.shared.core.errors import CorruptError, IncompleteError, SpecError
from photonfarm.shared.core.records import arrays_of
from photonfarm.shared.farm.submission import submit
from photonfarm.shared.farm.upgrade import upgrade
from photonfarm.shared.plan.request import Request
from photonfarm.shared.plan.top_up import TopUp
from photonfarm.shared.scene.spec import GuideSpec
from photonfarm.shared.scene.spec_loading import NamedSpec
from photonfarm.shared.store import SceneReader, SceneStore, Store, store_status
from photonfarm.shared.store.format.declarations import GUIDES
from photonfarm.shared.store.write.guides import NOISY, rounded


@pytest.fixture
def store(older: Path, tmp_path: Path) -> Store:
    """A copy of it."""
    shutil.copytree(older, tmp_path / "store")
    return Store(tmp_path / "store")


@pytest.fixture
def scene(store: Store) -> SceneStore:
    return store.scenes()[0]


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
