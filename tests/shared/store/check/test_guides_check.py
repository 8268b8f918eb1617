"""`photonfarm store check` reads guides as it reads samples, and sets their damage aside without touching these."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import checked_store as stores
import numpy as np
import pytest
from click.testing import CliRunner

from photonfarm.shared.cli.main import umbrella
from photonfarm.shared.core.records import Guides
from photonfarm.shared.farm.upgrade import upgrade
from photonfarm.shared.plan.request import Request
from photonfarm.shared.scene.spec import GuideSpec
from photonfarm.shared.store import SceneReader, SceneStore, Store
from photonfarm.shared.store.format.declarations import GUIDES
from photonfarm.shared.store.write.commit import RowWriter
from photonfarm.shared.store.write.guides import GuideWriter

samples, checked, found, noted, flip = stores.samples, stores.checked, stores.found, stores.noted, stores.flip


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of three jobs of 4, 4 and 2 samples with their guides."""
    store = Store(tmp_path_factory.mktemp("whole") / "store", create=True)
    request = Request(modifications=5, views_per_modification=2)
    scene = store.scene(store.plan(samples.small_spec(), request, shard_rows=4).scene_id)
    stores.commit_all(scene)
    scene.write_base(*samples.base())
    scene.guides.want(GuideSpec())
    for job in range(3):
        samples.commit_guides(scene, job)
    return Path(store.root)


@pytest.fixture
def store(whole: Path, tmp_path: Path) -> Store:
    """A copy of it."""
    shutil.copytree(whole, tmp_path / "store")
    return Store(tmp_path / "store")


@pytest.fixture
def scene(store: Store) -> SceneStore:
    return store.scenes()[0]


def shard(scene: SceneStore, name: str, job: int = 0) -> Path:
    (path,) = (scene.folder / "guides/plans/000000" / name).glob(f"c.{job}.*")
    return path


def marker(scene: SceneStore, job: int) -> Path:
    return scene.folder / f"guides/committed/{job:012d}.json"


def files(scene: SceneStore, *, guides: bool) -> dict[str, bytes]:
    """The bytes of every file of the guides but their markers, or of all else."""
    below = {str(path.relative_to(scene.folder)): path for path in scene.folder.rglob("*") if path.is_file()}
    of_guides = {name: path for name, path in below.items() if name.startswith("guides/")}
    chosen = of_guides if guides else {name: path for name, path in below.items() if name not in of_guides}
    return {name: path.read_bytes() for name, path in chosen.items() if not name.startswith("guides/committed")}


def render_missing(scene: SceneStore) -> None:
    """What workers would."""
    for job in scene.missing_jobs():
        assert scene.is_committed(job)
        samples.commit_guides(scene, job)


# ------------------------------------------------------------------------------------------------------------- finding


def test_a_clean_store_with_guides_is_clean_and_all_of_it_is_read(store: Store, scene: SceneStore) -> None:
    report = checked(store)
    (about,) = report.scenes
    assert (report.exit_code, noted(report), about.jobs, about.guide_jobs, about.samples) == (0, {}, 3, 3, 10)
    read = [each.marker(job)["files"].values() for job in range(3) for each in (scene, scene.guides)]
    assert about.size_bytes == sum(file["size"] for files in read for file in files)


def test_a_store_that_lacks_some_guides_is_not_damaged(store: Store, scene: SceneStore) -> None:
    for name in scene.guides.marker(1)["files"]:
        (scene.folder / "guides" / name).unlink()
    marker(scene, 1).unlink()
    assert (noted(checked(store)), checked(store).scenes[0].guide_jobs) == ({}, 2)


@pytest.mark.parametrize("name", ["direct", "roughness"])
def test_a_flipped_bit_of_guides_is_found_and_named_as_theirs(store: Store, scene: SceneStore, name: str) -> None:
    path = shard(scene, name, 1)
    whole = path.read_bytes()
    for place in (20, len(whole) // 2, len(whole) - 1):
        flip(path, place)
        (group,) = checked(store).scenes[0].groups
        assert group.cause.label == "checksum", place
        assert (group.first[0].job, group.first[0].guides) == (1, True)
        assert group.first[0].file == f"{scene.name}/guides/plans/000000/{name}/{path.name}"
        path.write_bytes(whole)
    assert found(checked(store)) == {}


@pytest.mark.parametrize(
    ("harm", "cause"),
    [
        (lambda path: path.write_bytes(path.read_bytes()[:-3]), "size"),
        (lambda path: path.write_bytes(b""), "size"),
        (lambda path: path.unlink(), "missing-file"),
    ],
    ids=["cut", "emptied", "removed"],
)
def test_a_file_of_guides_that_is_not_as_committed_is_found(
    store: Store, scene: SceneStore, harm: Callable[[Path], object], cause: str
) -> None:
    harm(shard(scene, "mean_depth"))
    assert found(checked(store)) == {cause: 1}


def test_a_marker_of_guides_that_is_none_or_names_files_of_samples_is_found(store: Store, scene: SceneStore) -> None:
    marker(scene, 0).write_text("{}")
    marker(scene, 1).write_bytes((scene.folder / "committed/000000000001.json").read_bytes())
    before = files(scene, guides=False)
    report = checked(store, repair=True)
    assert found(report)["marker"] >= 1
    assert set(report.scenes[0].set_aside) == {"guides of job 0", "guides of job 1"}
    assert files(scene, guides=False) == before


def test_values_that_are_not_finite_and_rows_that_are_not_the_plans_are_found(
    store: Store, scene: SceneStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No writer of ours stores them. The last job has rows 8 and 9."""
    monkeypatch.setattr("photonfarm.shared.store.write.commit.stays_finite", lambda *_: True)
    monkeypatch.setattr(RowWriter, "_claim", lambda *_: None)
    monkeypatch.setattr(RowWriter, "_check_complete", lambda _: None)
    monkeypatch.setattr(GuideWriter, "_check_readable", lambda _: None)
    for name in scene.guides.marker(2)["files"]:
        (scene.folder / "guides" / name).unlink()
    marker(scene, 2).unlink()
    poisoned: Guides = samples.guides(scene.spec, 8)
    poisoned.mean_normal[0, 0, 0] = np.nan
    poisoned.beyond_depth[0, 0] = np.inf
    with scene.guide_writer(2) as out:
        out.guides(8, poisoned)
        out.guides(10, samples.guides(scene.spec, 10))
        assert out.commit(samples.FIGURES)
    report = checked(store, repair=True)
    assert found(report) == {"not-finite": 2, "missing-row": len(GUIDES), "unused-row": len(GUIDES)}
    assert report.scenes[0].set_aside == ("guides of job 2",)


def test_files_without_a_marker_and_foreign_ones_are_noted_and_left_alone(store: Store, scene: SceneStore) -> None:
    marker(scene, 1).unlink()
    (scene.folder / "guides/committed/notes.json").write_text("{}")
    (scene.folder / "guides/plans/000000/direct/c.9.0.0.0").write_text("?")
    report = checked(store, repair=True)
    assert (report.exit_code, report.quarantine, noted(report)) == (0, None, {"no-marker": 1, "foreign-file": 2})
    assert shard(scene, "direct", 1).exists()


def test_a_marker_may_name_arrays_of_a_later_program(store: Store, scene: SceneStore) -> None:
    about = json.loads(marker(scene, 0).read_text())
    about["files"]["plans/000000/motion/c.0.0"] = {"size": 1, "crc32c": "00000000"}
    marker(scene, 0).write_text(json.dumps(about))
    assert found(checked(store)) == {}


def test_guides_of_a_job_whose_plan_is_lost_stay_and_the_plan_is_named(store: Store, scene: SceneStore) -> None:
    """They are good again once the plan is put back."""
    scene.plan(Request(modifications=6, views_per_modification=2))
    samples.commit_guides(scene, 3)
    kept = scene.folder.with_name("plan")
    (scene.folder / "plans/000001").rename(kept)
    report = checked(store, repair=True)
    (group,) = [group for group in report.scenes[0].groups if group.cause.label == "plan"]
    assert group.first[0].file == f"{scene.name}/plans/000001/zarr.json"
    assert (report.exit_code, report.scenes[0].set_aside, marker(scene, 3).exists()) == (4, (), True)
    kept.rename(scene.folder / "plans/000001")
    assert found(checked(store)) == {}


# -------------------------------------------------------------------------------------------------------------- repair

GROUP = '{"zarr_format": 3, "node_type": "group", "attributes": {}}'


def test_repair_sets_a_jobs_guides_aside_alone_and_rendering_them_again_gives_the_clean_bytes(
    store: Store, scene: SceneStore
) -> None:
    clean, others = files(scene, guides=True), files(scene, guides=False)
    placed = marker(scene, 1).read_bytes()
    damaged = shard(scene, "emission", 1)
    flip(damaged, 20)
    kept = damaged.read_bytes()
    report = checked(store, repair=True)
    assert (report.exit_code, report.scenes[0].set_aside) == (7, ("guides of job 1",))
    assert (scene.missing_jobs(), scene.is_committed(1), scene.is_done(1)) == ([1], True, False)
    assert list(scene.folder.glob("guides/**/c.1.*")) == []
    assert files(scene, guides=False) == others

    quarantine = Path(store.root) / str(report.quarantine)
    record = json.loads((quarantine / f"job-{scene.scene_id}-guides-1.json").read_text())
    assert record["why"][0]["cause"] == "checksum"
    assert len(record["moved"]) == 1 + len(GUIDES)
    assert (quarantine / damaged.relative_to(store.root)).read_bytes() == kept
    assert (quarantine / marker(scene, 1).relative_to(store.root)).read_bytes() == placed

    render_missing(scene)
    assert (files(scene, guides=True), files(scene, guides=False)) == (clean, others)
    assert found(checked(store)) == {}


def test_samples_and_guides_of_one_job_of_two_scenes_have_records_of_their_own(store: Store, scene: SceneStore) -> None:
    other = store.scene(store.plan(samples.small_spec(points=7), Request(modifications=2), shard_rows=4).scene_id)
    samples.commit_all(other)
    other.write_base(*samples.base())
    other.guides.want(GuideSpec())
    samples.commit_guides(other, 0)
    for each in (scene, other):
        flip(shard(each, "direct"), 20)
        flip(next(each.folder.glob("plans/000000/depth/c.0.*")), 20)
    report = checked(store, repair=True)
    assert [about.set_aside for about in report.scenes] == [("job 0", "guides of job 0")] * 2
    names = {path.name for path in (Path(store.root) / str(report.quarantine)).glob("job-*.json")}
    ids = (scene.scene_id, other.scene_id)
    assert names == {f"job-{each}-0.json" for each in ids} | {f"job-{each}-guides-0.json" for each in ids}


def test_a_reader_goes_on_through_a_repair_of_guides_and_sees_them_come_back(store: Store, scene: SceneStore) -> None:
    with_guides, without = (SceneReader(store.root, scene.scene_id, guides=wanted) for wanted in (True, False))
    assert with_guides.refresh().size == without.refresh().size == 10
    flip(shard(scene, "mean_normal", 1), 20)
    checked(store, repair=True)
    assert with_guides.refresh().size == 0
    assert with_guides.taken_back.tolist() == [4, 5, 6, 7]
    assert (without.refresh().size, without.taken_back.size) == (0, 0)
    render_missing(scene)
    assert with_guides.refresh().tolist() == [4, 5, 6, 7]
    assert with_guides.read(4).guides is not None


def test_damaged_guides_stay_where_they_are_until_the_plan_is_whole(store: Store, scene: SceneStore) -> None:
    about = scene.folder / "plans/000000/zarr.json"
    whole = about.read_bytes()
    document = json.loads(whole)
    del document["attributes"]["request"]
    about.write_text(json.dumps(document))
    flip(shard(scene, "direct", 1), 20)
    report = checked(store, repair=True)
    assert (found(report), report.scenes[0].set_aside) == ({"checksum": 1, "plan": 1, "left-in-place": 1}, ())
    about.write_bytes(whole)
    assert checked(store, repair=True).scenes[0].set_aside == ("guides of job 1",)


@pytest.mark.parametrize("content", [None, "", "[1]", '{"light_samples": "many"}'])
def test_settings_that_are_lost_or_damaged_are_set_aside_and_asked_for_again(
    store: Store, scene: SceneStore, content: str | None
) -> None:
    settings = scene.folder / "guides/settings.json"
    clean, asked = files(scene, guides=True), settings.read_bytes()
    if content is None:
        settings.unlink()
    else:
        settings.write_text(content)
    report = checked(store, repair=True)
    assert (found(report), report.exit_code) == ({"guide-settings": 1}, 7)
    assert report.scenes[0].set_aside == (() if content is None else ("settings of the guides",))
    assert found(checked(store)) == {"guide-settings": 1}, "until somebody asks"
    assert SceneReader(store.root, scene.scene_id, guides=True).refresh().size == 10, "what is there stays"
    assert upgrade(store.root, None).scenes[0].asked
    assert (found(checked(store)), files(scene, guides=True), settings.read_bytes()) == ({}, clean, asked)


@pytest.mark.parametrize(
    ("file", "content"),
    [("zarr.json", None), ("zarr.json", GROUP), ("direct/zarr.json", "{"), ("direct/zarr.json", GROUP), ("all", "{")],
)
def test_damaged_declarations_of_guides_are_written_again_at_once(
    store: Store, scene: SceneStore, file: str, content: str | None
) -> None:
    folder, before = scene.folder / "guides/plans/000000", files(scene, guides=False)
    clean = files(scene, guides=True)
    harmed = [*folder.rglob("zarr.json")] if file == "all" else [folder / file]
    for path in harmed:
        if content is None:
            path.unlink()
        else:
            path.write_text(content)
    report = checked(store, repair=True)
    assert set(found(report)) == {"plan-inputs"}
    assert report.exit_code == 7
    assert report.scenes[0].set_aside == ("guides of plan 0, declared again",)
    assert found(checked(store)) == {}
    assert (files(scene, guides=True), files(scene, guides=False)) == (clean, before)


def test_a_repair_of_guides_killed_in_the_middle_is_completed_by_the_next(store: Store, scene: SceneStore) -> None:
    """Their marker is gone by then, and some of their files are."""
    clean = files(scene, guides=True)
    flip(shard(scene, "direct"), 20)
    harmed = shard(scene, "direct").read_bytes()
    marker(scene, 0).unlink()
    shard(scene, "emission").unlink()
    assert (scene.missing_jobs(), noted(checked(store))) == ([0], {"no-marker": 1})
    render_missing(scene)
    assert shard(scene, "direct").read_bytes() != harmed
    assert (files(scene, guides=True), found(checked(store))) == (clean, {})


# -------------------------------------------------------------------------------------------------------- command line


def test_the_command_tells_guides_from_samples(store: Store, scene: SceneStore) -> None:
    def run(*arguments: str) -> Any:
        return CliRunner().invoke(umbrella, ["store", "check", "--store", str(store.root), *arguments])

    assert "3 jobs, 10 samples, guides of 3 jobs" in run().stdout
    flip(shard(scene, "specular", 2), 20)
    assert "guides of job 2, row 8, " in run().stdout
    (about,) = json.loads(run("--json").stdout)["scenes"]
    (group,) = about["groups"]
    assert (group["first"][0]["job"], group["first"][0]["guides"], about["guide_jobs"]) == (2, True, 3)
    assert "set aside: guides of job 2" in run("--repair").stdout
