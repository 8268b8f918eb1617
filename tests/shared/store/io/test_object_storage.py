"""A store in a bucket behaves like one in a folder."""

from dataclasses import replace
from pathlib import Path

import bucket_samples
import numpy as np
import obstore
import pytest
import store_samples as samples

from photonfarm.core.errors import CorruptError
from photonfarm.plan.request import Request
from photonfarm.store import SceneReader, Store

planned, at_once = bucket_samples.planned, bucket_samples.at_once


@pytest.fixture(params=["folder", "bucket"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> str | Path:
    """A place where a store may be made."""
    return request.getfixturevalue("url") if request.param == "bucket" else tmp_path / "store"


def test_what_is_committed_reads_back_and_is_counted(place: str | Path) -> None:
    scene = planned(place, modifications=2)
    scene.write_base(*samples.base())
    geometry, cloud = samples.base()
    scene.write_base(replace(geometry, vertices=geometry.vertices + 1), cloud)
    given = samples.outputs(scene, 0)
    given.radiance[1][0, 0, 0, 0] = 1e9
    assert samples.commit(scene, 0, given)
    assert not samples.commit(scene, 0, samples.outputs(scene, 0))

    reader = SceneReader(place, scene.scene_id)
    assert reader.refresh().tolist() == [0, 1]
    for row in (0, 1):
        np.testing.assert_array_equal(reader.read(row).radiance, given.radiance[row])
        np.testing.assert_array_equal(reader.read(row).buffers.normal, given.buffers[row].normal)
        np.testing.assert_array_equal(reader.read_photons(row).power, given.photons[row].power)
    np.testing.assert_array_equal(reader.base()[0].vertices, geometry.vertices)
    (status,) = samples.statuses(Store(place))
    assert (status.samples_planned, status.samples_complete, status.jobs_committed) == (2, 2, 1)
    assert status.size_bytes == sum(scene.storage.size(f"{scene.name}/{name}") for name in scene.marker(0)["files"])


def test_racing_submitters_plan_every_sample_once(place: str | Path) -> None:
    """Three requests overlap; whoever comes late plans what is left."""
    scene = planned(place)
    requests = [Request(modifications=count, views_per_modification=views) for count, views in ((2, 2), (3, 1), (2, 3))]
    results = at_once(*(lambda wanted=wanted: Store(place).plan(samples.small_spec(), wanted) for wanted in requests))
    plans = scene.plans()
    assert [result.plan for result in results if result.plan is not None] == [
        result.plan for result in results if result.new
    ]
    keys = [key.tobytes() for plan in plans for key in plan.rows.sample_key[plan.rows.sample_modification >= 0]]
    assert len(keys) == len(set(keys)) == 2 * 3 + 1
    assert [plan.number for plan in plans] == list(range(len(plans)))
    assert [plan.first_job for plan in plans] == [0, *(plan.end_job for plan in plans[:-1])]
    for wanted in requests:
        assert Store(place).plan(samples.small_spec(), wanted).new == 0


def test_racing_writers_leave_one_commit_that_its_marker_describes(place: str | Path) -> None:
    scene = planned(place, modifications=2)
    first = samples.outputs(scene, 0)
    second = replace(first, radiance={row: values + 1 for row, values in first.radiance.items()})
    won = at_once(
        *(lambda given=given: samples.commit(Store(place).scene(scene.scene_id), 0, given) for given in (first, second))
    )
    assert won.count(True) == 1
    reader = SceneReader(place, scene.scene_id)
    assert reader.refresh().tolist() == [0, 1]
    stored = {row: reader.read(row).radiance for row in (0, 1)}
    assert any(all(np.array_equal(stored[row], given.radiance[row]) for row in stored) for given in (first, second))
    for name, about in scene.marker(0)["files"].items():
        assert scene.storage.size(f"{scene.name}/{name}") == about["size"]


def test_files_and_folders_can_be_set_aside_and_written_anew(place: str | Path) -> None:
    scene = planned(place)
    scene.write_base(*samples.base())
    samples.commit(scene, 0, samples.outputs(scene, 0))
    storage, marker = scene.storage, f"{scene.name}/committed/000000000000.json"
    was = storage.read(marker)
    storage.move(marker, "quarantine/marker.json")
    assert (storage.exists(marker), storage.read("quarantine/marker.json")) == (False, was)
    with pytest.raises(FileNotFoundError):
        storage.move(marker, "quarantine/again.json")
    with pytest.raises(FileExistsError):
        storage.move("photonfarm.json", "quarantine/marker.json")
    storage.move_folder(f"{scene.name}/base", "quarantine/base")
    assert not scene.has_base()
    assert "geometry" in storage.names("quarantine/base")
    geometry, cloud = samples.base()
    scene.write_base(replace(geometry, vertices=geometry.vertices + 1), cloud)
    np.testing.assert_array_equal(SceneReader(place, scene.scene_id).base()[0].vertices, geometry.vertices + 1)
    assert samples.commit(scene, 0, samples.outputs(scene, 0))


# ---------------------------------------------------------------------------------------------------------- the bucket


def test_a_bucket_that_has_lost_the_store_s_document_or_a_spec_is_refused_and_told(url: str) -> None:
    store = Store(url, create=True)
    scene = store.scene(store.plan(samples.small_spec(), Request()).scene_id)
    objects_ = store.storage._objects
    obstore.put(objects_, "scenes/nothex/plans/000000/zarr.json", b"{}")
    obstore.delete(objects_, f"{scene.name}/spec.json")
    assert store.scene_ids() == [scene.scene_id]
    (about,) = samples.statuses(Store(url))
    assert "spec.json" in str(about.error)
    obstore.delete(objects_, "photonfarm.json")
    with pytest.raises(CorruptError):
        Store(url, create=True)
