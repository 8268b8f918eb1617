"""`photonfarm store check` finds damage of plans, base and spec, and `--repair` has it written again."""

import contextlib
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import checked_store as stores
import pytest

from photonfarm.core.errors import CorruptError, StoreError
from photonfarm.farm.dry_run import rehearse
from photonfarm.farm.hold_out_checks import check_hold_out
from photonfarm.farm.submission import submit
from photonfarm.plan.request import Request
from photonfarm.plan.top_up import TopUp
from photonfarm.scene.spec_loading import NamedSpec
from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.format.metadata import seal

scene = stores.scene
samples, commit_all, checked, found = stores.samples, stores.commit_all, stores.checked, stores.found
noted, data, shard, flip = stores.noted, stores.data, stores.shard, stores.flip
marker = stores.marker


# --------------------------------------------------------------------------------------------------- plans and base


@pytest.mark.parametrize("name", ["view", "sample_modification", "sample_key"])
@pytest.mark.parametrize("gone", [False, True], ids=["flipped", "missing"])
def test_damaged_inputs_of_a_plan_are_found_and_what_is_rendered_is_checked_all_the_same(
    store: Store, scene: SceneStore, name: str, gone: bool
) -> None:
    (path,) = (scene.folder / "plans/000000" / name).glob("c.0*")
    path.unlink() if gone else flip(path, path.stat().st_size - 1)
    flip(shard(scene, "depth", 1), 20)
    report = checked(store, repair=True)
    assert found(report) == {"plan-inputs": 1, "checksum": 1}
    assert report.exit_code == 7
    assert report.scenes[0].samples == 10
    assert not marker(scene, 1).exists()
    assert not shard_or_none(scene, "depth", 1)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"jobs": 3', '"jobs": 4'),
        ("radiance_exponent", "radiance_exponenu"),
        ('"seed": 0', '"seed": 1'),
        ('"depth/zarr.json": "', '"depth/zarr.json": "f'),
        ('"checksums"', '"Checksums"'),
    ],
)
def test_changed_metadata_of_a_plan_is_found_and_other_scenes_go_on(
    store: Store, scene: SceneStore, old: str, new: str
) -> None:
    other = store.scene(store.plan(samples.small_spec(points=8), Request(modifications=2)).scene_id)
    change_text(scene.folder / "plans/000000/zarr.json", old, new)
    again = Store(store.root)
    errors = {status.scene_id: status.error for status in samples.statuses(again)}
    assert (errors.pop(other.scene_id), len(errors)) == (None, 1)
    assert ("checksums is missing" if "checksums" in old else "fails its CRC-32C") in str(errors[scene.scene_id])
    assert again.plan(samples.small_spec(points=8), Request(modifications=3)).new == 1
    with pytest.raises(CorruptError):
        SceneReader(store.root, scene.scene_id).refresh()
    before = data(scene)
    report = checked(store, scene_id=scene.scene_id, repair=True)
    assert (found(report), report.exit_code, data(scene) == before) == ({"plan": 1}, 4, True)


@pytest.mark.parametrize("name", ["", "cloud/", "geometry/faces/"])
def test_changed_metadata_of_the_base_is_found_and_set_aside(store: Store, scene: SceneStore, name: str) -> None:
    change_text(scene.folder / f"base/{name}zarr.json", '"attributes"', '"attributes" ')
    with pytest.raises(CorruptError, match="store check --repair"):
        scene.base()
    assert list(found(checked(store))) == ["base"]
    assert checked(store, repair=True).exit_code == 7
    commit_all(scene)
    scene.write_base(*samples.base())
    assert found(checked(store)) == {}


def change_text(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert text.count(old) == 1
    file.write_text(text.replace(old, new))


def shard_or_none(scene: SceneStore, name: str, job: int) -> list[Path]:
    return list((scene.folder / "plans/000000" / name).glob(f"c.{job}.*"))


def test_a_plan_whose_keys_are_not_those_of_its_content_is_found(store: Store, scene: SceneStore) -> None:
    """Whole by every checksum: another scene's plan."""
    other = Store(Path(store.root).with_name("other"), create=True)
    request = Request(modifications=5, views_per_modification=2, seed=1)
    theirs = other.scene(other.plan(samples.small_spec(), request, shard_rows=4).scene_id)
    for name in ("view", "sample_key"):
        shutil.rmtree(scene.folder / "plans/000000" / name)
        shutil.copytree(theirs.folder / "plans/000000" / name, scene.folder / "plans/000000" / name)
    assert found(checked(store)) == {"plan": 1}


@pytest.mark.parametrize(("gone", "what"), [("000000", "zarr.json"), ("000001", "folder"), ("000002", "zarr.json")])
def test_a_plan_that_is_lost_is_told_and_none_of_its_jobs_is_set_aside(
    store: Store, scene: SceneStore, gone: str, what: str
) -> None:
    """The jobs cannot be rendered again without it; once it is put back, nothing is wrong."""
    for n in (6, 7):
        scene.plan(Request(modifications=n, views_per_modification=2))
    commit_all(scene)
    path, aside = scene.folder / "plans" / gone, Path(store.root).with_name("aside")
    path = path if what == "folder" else path / "zarr.json"
    path.rename(aside)
    report = checked(store, repair=True)
    assert (found(report), report.scenes[0].set_aside) == ({"plan": 1}, ())
    (group,) = report.scenes[0].groups
    assert group.first[0].file == f"{scene.name}/plans/{gone}/zarr.json"
    aside.rename(path)
    assert noted(checked(store)) == {}


def test_a_plan_that_is_claimed_and_not_written_yet_is_no_finding(store: Store, scene: SceneStore) -> None:
    (scene.folder / "plans/000001/view").mkdir(parents=True)
    (scene.folder / "plans/000001.claim").write_bytes(b"")
    assert noted(checked(store)) == {}


def test_a_lost_last_plan_can_be_given_up_by_moving_its_markers_and_its_folder_away(
    store: Store, scene: SceneStore
) -> None:
    """These are the steps that docs/store-check.md gives."""
    scene.plan(Request(modifications=7, views_per_modification=2))
    commit_all(scene)
    clean, aside = data(scene), Path(store.root) / "quarantine/by-hand"
    (scene.folder / "plans/000001/zarr.json").unlink()
    assert found(checked(store)) == {"plan": 1}
    aside.mkdir(parents=True)
    (scene.folder / "plans/000001").rename(aside / "000001")
    with pytest.raises(CorruptError):
        Store(store.root).plan(samples.small_spec(), Request(modifications=7, views_per_modification=2))
    assert samples.statuses(Store(store.root))[0].markers_without_plan == 1
    marker(scene, 3).rename(aside / marker(scene, 3).name)
    again = Store(store.root).scene(scene.scene_id)
    assert (found(checked(store)), again.missing_jobs()) == ({}, [])
    assert again.plan(Request(modifications=7, views_per_modification=2)).plan == 1
    commit_all(again)
    assert (found(checked(store)), data(scene)) == ({}, clean)


@pytest.mark.parametrize("version", [4, 6, None])
def test_a_plan_of_another_version_is_refused_in_a_sentence_by_all_who_load_it(
    store: Store, scene: SceneStore, version: int | None
) -> None:
    about = scene.folder / "plans/000000/zarr.json"
    document = json.loads(about.read_text())
    document["attributes"]["version"] = version
    about.write_text(json.dumps(document))
    said = f"version {version}"
    for look in (
        lambda: Store(store.root).scene(scene.scene_id).plans(),
        lambda: Store(store.root).plan(samples.small_spec(), Request(modifications=9)),
        SceneReader(store.root, scene.scene_id).refresh,
    ):
        with pytest.raises(StoreError):
            look()
    assert said in str(samples.statuses(Store(store.root))[0].error)
    report = checked(store, repair=True)
    assert (found(report), report.exit_code) == ({"plan": 1}, 4)
    assert said in report.scenes[0].groups[0].first[0].detail


@pytest.mark.parametrize("harm", ["flip", "chunk", "marker", "index", "removed"])
def test_a_damaged_base_is_set_aside_and_the_next_job_writes_it(store: Store, scene: SceneStore, harm: str) -> None:
    clean = data(scene)
    file = scene.folder / "base/cloud/position/c.0.0"
    if harm == "flip":
        flip(file, 20)
    elif harm == "chunk":
        file.unlink()
    elif harm == "marker":
        (scene.folder / "base/zarr.json").unlink()
    elif harm == "removed":
        shutil.rmtree(scene.folder / "base")
    else:
        geometry, cloud = samples.base()
        shutil.rmtree(scene.folder / "base")
        scene.write_base(replace(geometry, faces=geometry.faces + 1), cloud)
    assert found(checked(store)) == {"base": 1}
    report = checked(store, repair=True)
    assert report.exit_code == 7
    assert scene.missing_jobs() == [2]  # whole, but no other job is left to write the base
    moved = () if harm == "removed" else ("base",)
    assert report.scenes[0].set_aside == (*moved, "job 2 (whole; rendered again, as a job writes the base)")
    again = checked(store, repair=True)
    assert (noted(again), again.exit_code, again.scenes[0].set_aside) == ({"base-to-come": 1}, 0, ())
    commit_all(scene)
    scene.write_base(*samples.base())
    assert data(scene) == clean
    assert found(checked(store)) == {}


@pytest.mark.parametrize("gone", [False, True], ids=["flipped", "missing"])
def test_a_damaged_spec_is_set_aside_and_the_next_submission_writes_it(
    store: Store, scene: SceneStore, gone: bool
) -> None:
    clean = data(scene)
    file = scene.folder / "spec.json"
    whole = file.read_bytes()
    named, request = NamedSpec("small", samples.small_spec(), None), Request(modifications=5, views_per_modification=2)
    if gone:
        file.unlink()
    else:
        flip(file, 30)
        for dry_run in (False, True):
            with pytest.raises(CorruptError, match="store check --repair"):
                Store(store.root).plan(named.spec, request, dry_run=dry_run)
        assert checked(store, repair=True).exit_code == 7
    with pytest.raises(CorruptError, match="photonfarm submit"):
        Store(store.root).scene(scene.scene_id)
    assert checked(store).exit_code == 4  # its plans are there without it
    assert rehearse(named, store.root, request, measure=False, log=print).planned_before == 10
    check_hold_out(named.spec, store.root, 0.5, request)
    assert not file.exists()
    assert submit(named, store.root, None, request).planned_before == 10
    assert file.read_bytes() == whole
    assert (found(checked(store)), data(scene)) == ({}, clean)


# ---------------------------------------------------------------------------------------------------- plans, repaired

INPUTS = ("modification", "view", "sample_modification", "sample_view", "sample_pass", "sample_key")


@pytest.fixture
def planned_thrice(store: Store, tmp_path_factory: pytest.TempPathFactory) -> SceneStore:
    """A plan, one that adds to it, and a top-up."""

    def make(scene: SceneStore) -> None:
        scene.write_base(*samples.base())
        scene.plan(Request(modifications=7, views_per_modification=3))
        scene.plan(TopUp.of("+40", ["views=first:4"]))
        commit_all(scene)

    return stores.copied("planned thrice", make, store, tmp_path_factory)


@pytest.mark.parametrize(
    ("name", "gone", "number"),
    [
        *((name, number == 1, number) for number, name in enumerate(INPUTS[:3])),
        *((name, number != 1, number) for number, name in enumerate(INPUTS[3:])),
        ("view/zarr.json", False, 0),
        ("sample_key/zarr.json", True, 1),
        ("depth/zarr.json", False, 2),
    ],
)
def test_a_damaged_file_of_a_plan_is_written_again_from_the_request(
    store: Store, planned_thrice: SceneStore, name: str, gone: bool, number: int
) -> None:
    scene, clean = planned_thrice, data(planned_thrice)
    (path,) = (scene.folder / f"plans/{number:06d}").glob(name if "/" in name else f"{name}/c.0*")
    whole = path.read_bytes()
    path.unlink() if gone else path.write_bytes(whole.replace(b'"chunk', b'"chunc') if "/" in name else flipped(whole))
    with contextlib.suppress(CorruptError):
        if SceneReader(store.root, scene.scene_id).refresh().size:
            assert name == "depth/zarr.json"  # which we do not read
    damaged = None if gone else path.read_bytes()
    report = checked(store)
    assert (found(report), report.exit_code) == ({"plan-inputs": 1}, 4)
    report = checked(store, repair=True)
    assert (found(report), report.exit_code) == ({"plan-inputs": 1}, 7)
    assert report.scenes[0].set_aside == (f"plan {number}, written again",)
    assert data(scene) == clean
    quarantine = Path(store.root) / report.quarantine
    aside = quarantine / path.relative_to(store.root)
    assert (aside.read_bytes() if aside.exists() else None) == damaged
    (record,) = [json.loads(p.read_text()) for p in quarantine.glob("plan-*.json")]
    assert record["why"][0]["cause"] == "plan-inputs"
    assert found(checked(store)) == {}
    assert SceneReader(store.root, scene.scene_id).refresh().size == sum(plan.samples for plan in scene.plans())


def flipped(content: bytes) -> bytes:
    return content[:-1] + bytes([content[-1] ^ 1])


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (lambda plan: change(plan, seed=1), "its request gives another modification than is there"),
        (lambda plan: change(plan, modifications=40), "its request does not give its 3 jobs"),
        (lambda plan: change(plan, modifications=0), "is not a readable plan"),
        (lambda plan: flip(plan / "sample_key/c.0.0", 30), "too little of it can be read"),
    ],
)
def test_a_plan_is_not_written_again_where_its_request_may_be_another(
    store: Store, scene: SceneStore, harm: Callable[[Path], None], said: str
) -> None:
    flip(scene.folder / "plans/000000/view/c.0.0", 30)
    harm(scene.folder / "plans/000000")
    before = data(scene)
    report = checked(store, repair=True)
    assert (report.exit_code, report.scenes[0].set_aside, data(scene) == before) == (4, (), True)
    (group,) = [group for group in report.scenes[0].groups if group.cause.label == "plan"]
    assert said in group.first[0].detail
    assert "back from a copy" in group.first[0].detail


def change(plan: Path, **request: int) -> None:
    about = json.loads((plan / "zarr.json").read_text())
    about["attributes"]["request"].update(request)
    (plan / "zarr.json").write_text(json.dumps(about))
    seal(plan)
