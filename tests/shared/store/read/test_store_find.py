"""`photonfarm store find` finds samples by what they are, and says where they lie."""

import json
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import store_samples as samples
import zarr
from click.testing import CliRunner

from photonfarm.cli.main import umbrella
from photonfarm.core.errors import SpecError, StoreError
from photonfarm.core.records import arrays_of
from photonfarm.plan.request import Request
from photonfarm.scene.arrangement import Arrangement, Shot
from photonfarm.scene.modification import Modification
from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.read.find import Matches, Query, find_samples, scene_named


@pytest.fixture
def scene(store: Store) -> SceneStore:
    """6 modifications with 2 views of 2 passes each: jobs 0 to 5 of plan 0 are pass 0, those of plan 1 pass 1."""
    views = Request(modifications=6, views_per_modification=2)
    scene = store.scene(store.plan(samples.small_spec(), views, shard_rows=4).scene_id)
    scene.plan(views.model_copy(update={"passes": 2}))
    for job in (0, 1, 3):
        given = samples.outputs(scene, job)
        if job == 1:
            given.radiance[5][0, 0, 0, 0] = 1e9
        samples.commit(scene, job, given)
    return scene


def find(store: Store, limit: int = 100, **query: Any) -> Matches:
    return find_samples(store, store.scene_ids(), Query.of(**query), limit=limit)


def rows(matches: Matches) -> list[int]:
    return [sample.row for sample in matches.samples]


def shown(scene: SceneStore, row: int) -> Shot:
    """What stands where in a modification's row, by names."""
    modification = Modification.from_vector(scene.plans()[0].rows.modification[row])
    return Shot.of(**Arrangement.from_modification(scene.spec, modification).model_dump())


def present(scene: SceneStore) -> int:
    """A modification row whose object is there."""
    vectors = scene.plans()[0].rows.modification
    return int(np.flatnonzero(vectors[:, 0, 3] == 1)[-1])


def test_a_modification_is_found_by_what_stands_where_with_all_its_views_and_passes(
    store: Store, scene: SceneStore
) -> None:
    row = present(scene)
    matches = find(store, asked=shown(scene, row), tolerance=0)
    assert {s.modification_row for s in matches.samples} == {row}
    assert sorted({(s.view_row, s.pass_) for s in matches.samples}) == sorted(
        (view, pass_) for view in {s.view_row for s in matches.samples} for pass_ in (0, 1)
    )
    assert matches.count == 4
    assert all(s.distance == 0 for s in matches.samples)


def test_a_rounded_place_finds_within_the_tolerance_and_the_nearest_comes_first(
    store: Store, scene: SceneStore
) -> None:
    row = present(scene)
    ((name, (x, y, z)),) = shown(scene, row).place.items()
    asked = Shot.of(place={name: (x + 0.25, y, z)})
    assert find(store, asked=asked).count == 0
    assert find(store, asked=asked).nearest <= 0.25 + 1e-6
    matches = find(store, asked=asked, tolerance=10)
    distances = [s.distance for s in matches.samples]
    assert distances == sorted(distances)
    assert matches.samples[0].distance == pytest.approx(matches.nearest)
    assert row in {s.modification_row for s in matches.samples if s.distance <= 0.25 + 1e-6}


def test_a_removed_object_is_never_near_one_that_is_there_and_one_that_is_not_named_is_anywhere(
    store: Store, scene: SceneStore
) -> None:
    (name,) = shown(scene, present(scene)).place
    vectors = scene.plans()[0].rows.modification
    for asked, there in ((Shot.of(without=[name]), 0), (Shot.of(move={name: (0, 0, 0)}), 1)):
        matches = find(store, asked=asked, tolerance=100)
        assert {s.modification[0][3] for s in matches.samples} <= {there}
        assert matches.count == 4 * int((vectors[:, 0, 3] == there).sum())
    assert find(store, asked=Shot()).count == 24
    with pytest.raises(SpecError, match=f"nearest: {name}"):
        find(store, asked=Shot.of(without=[f"{name}s"]))


def test_samples_are_found_by_each_of_their_keys(store: Store, scene: SceneStore) -> None:
    reader = SceneReader(store.root, scene.scene_id)
    for row in reader.refresh()[[1, 5, 9]].tolist():
        (sample,) = find(store, row=row).samples
        assert sample.modification_key == reader.modification_key(row).hex()
        assert sample.view_key == reader.view_key(row).hex()
        assert rows(find(store, like=sample.key)) == [row]
        assert row in rows(find(store, like=sample.modification_key))
        of_view = find(store, like=sample.view_key)
        assert {(s.view_row, s.pass_) for s in of_view.samples} == {(sample.view_row, 0), (sample.view_row, 1)}
    assert find(store, like="0" * 32).count == 0


def test_a_view_is_found_by_its_camera_and_conditions_narrow_each_other(store: Store, scene: SceneStore) -> None:
    view = scene.plans()[0].rows.view[3]
    asked = Shot.of(camera=view[:3], look_at=view[3:])
    matches = find(store, asked=asked, tolerance=0)
    assert {s.view_row for s in matches.samples} == {3}
    assert matches.count == 2
    job = matches.samples[1].jobs[0]
    assert find(store, asked=asked, job=job).count == 1
    assert rows(find(store, job=2)) == [8, 9, 10, 11]


def test_where_a_sample_lies_is_where_zarr_reads_it(store: Store, scene: SceneStore) -> None:
    reader = SceneReader(store.root, scene.scene_id)
    reader.refresh()
    for row in (2, 5, 13):
        (found,) = find(store, row=row).samples
        places = {place.array: place for place in found.places}
        sample = reader.read(row, guides=True)
        assert sample.guides is not None
        name = "radiance_wide" if row == 5 else "radiance"
        assert ({"radiance", "radiance_wide"} & places.keys()) == {name}
        known = {name: sample.radiance, "depth": sample.buffers.depth, **arrays_of(sample.guides)}
        for array, values in known.items():
            place = places[array]
            stored = zarr.open_array(store.root / Path(place.file).parent, mode="r")
            np.testing.assert_array_equal(stored[place.index].astype(np.float32), values)
            assert place.there
            assert place.chunk == place.index % 4


def test_a_sample_is_complete_with_the_jobs_of_its_row_view_and_modification(store: Store, scene: SceneStore) -> None:
    found = {s.row: s for s in find(store).samples}
    assert found[0].complete
    assert not found[8].complete  # job 2
    assert found[12].jobs == (3, 0, 0)
    assert found[12].complete
    reader = SceneReader(store.root, scene.scene_id)
    assert reader.refresh().tolist() == [row for row in sorted(found) if found[row].complete]


def test_scenes_are_named_by_id_its_beginning_or_their_name(store: Store, scene: SceneStore) -> None:
    for name in (scene.scene_id, scene.scene_id[:6], "small"):
        assert scene_named(store, name) == scene.scene_id
    with pytest.raises(StoreError, match="nearest: small"):
        scene_named(store, "smal")
    other = store.add(samples.small_spec(points=20))
    third = store.add(samples.small_spec(name="third", points=30))
    assert len(store.scene_ids()) == 3
    with pytest.raises(StoreError) as refused:
        scene_named(store, "small")
    named = {each for each in store.scene_ids() if each in str(refused.value)}
    assert named == {scene.scene_id, other.scene_id}, "those that fit, to choose from"
    with pytest.raises(StoreError, match=third.scene_id):
        scene_named(store, "fourth")
    assert find(store).count == 24
    assert find_samples(store, [other.scene_id], Query()).count == 0


def test_what_is_no_key_is_refused() -> None:
    with pytest.raises(SpecError, match="--like"):
        Query.of(like="12")


def test_the_command_prints_what_it_finds_and_what_to_run(store: Store, scene: SceneStore) -> None:
    def run(*arguments: str) -> Any:
        words = ["store", "find", "--store", str(store.root), *arguments]
        return CliRunner().invoke(umbrella, words, prog_name="photonfarm")

    told = run("--row", "8")
    assert told.exit_code == 0
    assert "row 8, pass 0: not complete" in told.stdout
    assert f"photonfarm work --store {store.root} --scene {scene.scene_id} --job 2" in told.stdout
    printed = json.loads(run("--job", "0", "--limit", "2", "--json").stdout)
    assert (printed["count"], [s["row"] for s in printed["samples"]]) == (4, [0, 1])
    assert printed["samples"][0]["complete"]
    assert printed["samples"][0]["pass"] == 0
    assert not [name for name in printed["samples"][0] if name.endswith("_")]
    scene.write_base(*samples.base())
    words = shlex.split(printed["samples"][0]["commands"]["look at it"])[1:]
    looked = subprocess.run([sys.executable, *words], capture_output=True, text=True)
    assert looked.returncode == 0, looked.stderr
    assert looked.stdout.startswith("[[[[")
    (name,) = shown(scene, present(scene)).place
    assert "the nearest is" in run("--place", f"{name}=9,9,9").stderr
    like = run("--like", printed["samples"][0]["key"], "--json")
    words = shlex.split(json.loads(like.stdout)["samples"][0]["shot"])
    assert run(*words, "--tolerance", "0", "--row", "0").stdout.startswith("small ")
