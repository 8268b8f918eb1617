"""What is committed comes back, whole or not at all, while the store grows."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import store_samples as samples

from photonfarm.core.errors import IncompleteError, StoreError
from photonfarm.core.records import ViewBuffers, Visibility, arrays_of
from photonfarm.plan.request import Request
from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.format.shards import NOISY_GUIDES, round_to_8_bits

scene, reader_of = samples.scene, samples.reader_of


def test_every_committed_sample_reads_back_as_it_was_rendered(scene: SceneStore) -> None:
    samples.commit_all(scene)
    reader = reader_of(scene)
    assert reader.rows.tolist() == list(range(10))
    for job in range(3):
        given, rows = samples.outputs(scene, job), scene.job_rows(job)
        for s in rows.samples:
            assert reader.read(s.row).guides is None, "not asked for"
            read = reader.read(s.row, guides=True)
            np.testing.assert_array_equal(read.radiance, given.radiance[s.row])
            assert read.radiance.dtype == np.float32
            np.testing.assert_array_equal(read.modification.vector, rows.modifications[s.modification_row].vector)
            np.testing.assert_array_equal(read.view.vector, rows.views[s.view_row].vector)
            assert reader.modification_key(s.row) == read.modification.key(scene.spec.radiance_id)
            for name, array in arrays_of(given.buffers[s.view_row]).items():
                np.testing.assert_array_equal(getattr(read.buffers, name), array)
            for name, array in arrays_of(given.guides[s.view_row]).items():
                expected = round_to_8_bits(array) if name in NOISY_GUIDES else array
                np.testing.assert_array_equal(getattr(read.guides, name), expected, err_msg=name)
                assert (expected != array).any() == (name in NOISY_GUIDES)
            for name, array in arrays_of(given.visibility[s.view_row]).items():
                np.testing.assert_array_equal(getattr(read.visibility, name), array)
            photons = samples.photons(scene.spec, s.modification_row)
            for name, array in arrays_of(reader.read_photons(s.row)).items():
                np.testing.assert_array_equal(array, getattr(photons, name))


def test_noisy_guides_are_rounded_to_8_significant_bits_to_the_nearest_and_ties_to_even() -> None:
    exact = np.array([0, 1, -1, 255, 256, 0.5**20, 2.0**127, 1.0078125], np.float32)
    np.testing.assert_array_equal(round_to_8_bits(exact), exact)
    unit = np.float32(2.0**-7)  # between numbers of 8 bits from 1 on
    between = np.array([1 + unit / 2, 1 + 3 * unit / 2, 1 + 0.51 * unit, 1 + 1.49 * unit], np.float32)
    np.testing.assert_array_equal(round_to_8_bits(between), np.array([1, 1 + 2 * unit, 1 + unit, 1 + unit], np.float32))
    many = np.random.default_rng(1).gamma(0.5, 3.0, 100_000).astype(np.float32)
    error = round_to_8_bits(many) / many.astype(np.float64) - 1
    assert np.abs(error).max() <= 2.0**-8
    assert abs(error.mean()) < 4 * 2.0**-8 / np.sqrt(3 * len(many)), "as many up as down"
    assert not (round_to_8_bits(many).view(np.uint32) & 0xFFFF).any()


def test_radiance_is_scaled_by_the_power_of_two_nearest_to_the_exposure(store: Store) -> None:
    """2^-20 is subnormal in float16 and would lose bits; times 2^10 it is exact."""
    spec = samples.small_spec(exposure=1000.0)
    scene = store.scene(store.plan(spec, Request()).scene_id)
    given = samples.outputs(scene, 0)
    given.radiance[0] *= np.float32(2.0**-12)
    samples.commit(scene, 0, given)
    np.testing.assert_array_equal(reader_of(scene).read(0).radiance, given.radiance[0])


@pytest.mark.parametrize("bright", [1e9, 3e38, 65520.0, 65519.998, 65504.0, 65503.0, -70000.0])
def test_no_value_is_clamped_and_none_becomes_infinite(scene: SceneStore, bright: float) -> None:
    """float16 ends at 65504; from 65520 on it rounds to infinity, and the sample is kept in float32."""
    given = samples.outputs(scene, 0)
    given.radiance[2][1, 3, 4, 0] = bright
    samples.commit(scene, 0, given)
    read = reader_of(scene).read(2).radiance
    fits = abs(np.float32(bright)) < 65520
    assert read[1, 3, 4, 0] == (65504.0 if fits else np.float32(bright))
    rest = np.ones(read.shape, bool)
    rest[1, 3, 4, 0] = False
    np.testing.assert_array_equal(read[rest], given.radiance[2][rest])
    assert (scene.folder / "plans/000000/radiance_wide/c.0.0.0.0.0").exists() == (not fits)
    np.testing.assert_array_equal(reader_of(scene).read(3).radiance, given.radiance[3])


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("where", ["radiance", "depth", "direct", "roughness"])
def test_a_value_that_is_not_finite_is_refused_and_nothing_is_committed(
    scene: SceneStore, where: str, value: float
) -> None:
    given = samples.outputs(scene, 0)
    rendered = arrays_of(given.buffers[1]) | arrays_of(given.guides[1]) | {"radiance": given.radiance[1]}
    target = rendered[where]
    target.flat[5] = value
    with pytest.raises(IncompleteError, match=f"{where}.* of row 1"):
        samples.commit(scene, 0, given)
    assert scene.missing_jobs() == [0, 1, 2]


def test_outputs_that_are_not_exactly_the_jobs_are_refused(scene: SceneStore) -> None:
    given = samples.outputs(scene, 0)
    lacking = {row: halves for row, halves in given.radiance.items() if row != 3}
    wrong = {**given.buffers, 0: ViewBuffers(*(np.zeros((4, 4), np.float32),) * 3)}
    wide = samples.small_spec(film={"width": 16, "height": 8})
    fewer = {**given.visibility, 0: replace(given.visibility[0], points=np.ones(15, np.bool_))}
    for named, changes in {
        "sample 3": {"radiance": lacking},
        "depth": {"buffers": wrong},
        "emission": {"guides": {**given.guides, 0: samples.guides(wide, 0)}},
        "point_seen": {"visibility": fewer},
    }.items():
        with pytest.raises(IncompleteError, match=named):
            samples.commit(scene, 0, replace(given, **changes))


@pytest.mark.parametrize(("points", "paths"), [(1, 1), (8, 0), (13, 5), (16, 4), (4097, 3)])
def test_what_a_view_sees_is_stored_as_bits_the_least_significant_first(store: Store, points: int, paths: int) -> None:
    spec = samples.small_spec(points=points, photons={"paths": paths, "depth": 1})
    scene = store.scene(store.plan(spec, Request(), shard_rows=1).scene_id)
    given = samples.outputs(scene, 0)
    seen = np.random.default_rng(points).random(points) < 0.5
    seen[-1] = True
    samples.commit(scene, 0, replace(given, visibility={0: Visibility(seen, np.ones(paths, np.bool_))}))
    read = reader_of(scene)
    visibility = read.read(0).visibility
    np.testing.assert_array_equal(visibility.points, seen)
    np.testing.assert_array_equal(visibility.photons, np.ones(paths, np.bool_))
    assert (visibility.points.dtype, visibility.photons.dtype) == (np.bool_, np.bool_)
    stored = {name: bits for name, bits in read.read_batch([0]).of_view.items() if "seen" in name}
    assert set(stored) == ({"point_seen", "photon_seen"} if paths else {"point_seen"})
    as_documented = [int(stored["point_seen"][0, i // 8]) >> i % 8 & 1 for i in range(points)]
    assert as_documented == seen.tolist()
    assert int(stored["point_seen"][0, -1]) < 1 << (points - 1) % 8 + 1


def test_a_job_is_committed_once_and_the_first_one_stays(scene: SceneStore) -> None:
    first = samples.outputs(scene, 0)
    assert samples.commit(scene, 0, first)
    before = {p: p.read_bytes() for p in scene.folder.rglob("*") if p.is_file()}
    other = replace(first, radiance={row: values + 1 for row, values in first.radiance.items()})
    assert not samples.commit(scene, 0, other)
    assert {p: p.read_bytes() for p in scene.folder.rglob("*") if p.is_file()} == before


def test_files_that_a_dead_writer_left_without_a_row_are_replaced(scene: SceneStore) -> None:
    """Its row 1 was to lie in radiance_wide; rendered again, it fits float16."""
    theirs, ours = samples.outputs(scene, 0), samples.outputs(scene, 0)
    theirs.radiance[1][0, 0, 0, 0] = 1e9
    samples.commit(scene, 0, theirs)
    (scene.folder / "committed/000000000000.json").unlink()
    (scene.folder / "plans/000000/radiance_wide/c.0.0.0.0.0").unlink()
    assert samples.commit(scene, 0, ours)
    for row in range(4):
        np.testing.assert_array_equal(reader_of(scene).read(row).radiance, ours.radiance[row])


def test_a_whole_render_that_a_dead_writer_left_is_kept_and_described(scene: SceneStore) -> None:
    theirs = samples.outputs(scene, 0)
    theirs.radiance[1][0, 0, 0, 0] = 1e9
    samples.commit(scene, 0, theirs)
    files = scene.marker(0)["files"]
    (scene.folder / "committed/000000000000.json").unlink()
    assert samples.commit(scene, 0, samples.outputs(scene, 0))
    assert scene.marker(0)["files"] == files
    assert reader_of(scene).read(1).radiance[0, 0, 0, 0] == np.float32(1e9)


def test_a_marker_tells_the_files_and_the_figures(scene: SceneStore) -> None:
    samples.commit(scene, 0, samples.outputs(scene, 0))
    marker = scene.marker(0)
    assert marker["figures"]["core_s"] == 2.0
    about_rendering = {"versions", "device", "driver", "strategy", "taken_over", "counts"}
    assert set(marker["figures"]) == {"core_s", "wall_s", "redrawn", "worker", *about_rendering}
    for name, about in marker["files"].items():
        assert (scene.folder / name).stat().st_size == about["size"]
        assert re.fullmatch("[0-9a-f]{8}", about["crc32c"])
    assert {Path(name).parent.name for name in marker["files"]} >= {"radiance", "depth", "direct", "photon_power"}


def test_a_sample_is_complete_only_with_its_views_and_modifications_job(scene: SceneStore) -> None:
    """Passes of a second plan refer to rows of the first plan's jobs."""
    scene.plan(Request(modifications=5, views_per_modification=2, passes=2))
    later = [job for job in scene.missing_jobs() if job >= 3]
    for job in later:
        samples.commit(scene, job, samples.outputs(scene, job))
    reader = reader_of(scene)
    assert reader.rows.size == 0
    samples.commit(scene, 0, samples.outputs(scene, 0))
    seen = reader.refresh()
    assert {reader.read(int(row)).pass_number for row in seen} == {0, 1}
    assert all(reader.modification_row(int(row)) < 4 for row in seen)
    assert reader.refresh().size == 0
    samples.commit_all(scene)
    assert sorted([*seen, *reader.refresh()]) == reader.rows.tolist()
    assert reader.rows.size == 20


def test_a_reader_may_wait_for_store_scene_plan_and_samples(tmp_path: Path) -> None:
    spec = samples.small_spec()
    reader = SceneReader(tmp_path / "later", spec.scene_id)
    assert reader.refresh().size == 0
    with pytest.raises(StoreError):
        _ = reader.spec
    store = Store(tmp_path / "later", create=True)
    assert reader.refresh().size == 0
    with pytest.raises(StoreError):
        _ = reader.spec
    store.add(spec)
    assert reader.refresh().size == 0
    assert reader.spec.model_copy(update={"stored_exponent": None}) == spec
    with pytest.raises(StoreError):
        reader.base()
    scene = store.scene(store.plan(spec, Request()).scene_id)
    assert reader.refresh().size == 0
    with pytest.raises(IncompleteError, match=r"row 0 .* is not complete; workers render it"):
        reader.read(0)
    samples.commit_all(scene)
    assert reader.refresh().tolist() == [0]


def test_the_base_is_written_once_and_reads_back(scene: SceneStore) -> None:
    geometry, cloud = samples.base()
    scene.write_base(geometry, cloud)
    scene.write_base(replace(geometry, vertices=geometry.vertices + 1), cloud)
    for given, read in zip((geometry, cloud), reader_of(scene).base(), strict=True):
        for name, array in arrays_of(given).items():
            np.testing.assert_array_equal(getattr(read, name), array)
            assert getattr(read, name).dtype == array.dtype


def test_a_scene_without_photons_stores_none(store: Store) -> None:
    scene = store.scene(store.plan(samples.small_spec(photons={"paths": 0}), Request()).scene_id)
    samples.commit_all(scene)
    assert not list(scene.folder.rglob("photon_*"))
    with pytest.raises(StoreError):
        reader_of(scene).read_photons(0)


def test_the_status_counts_samples_jobs_bytes_and_core_seconds(store: Store, scene: SceneStore) -> None:
    samples.commit(scene, 1, samples.outputs(scene, 1))
    (status,) = samples.statuses(store)
    assert (status.samples_planned, status.samples_complete) == (10, 4)
    assert (status.jobs_planned, status.jobs_committed) == (3, 1)
    assert (status.core_s, status.redrawn) == (2.0, 1)
    assert status.size_bytes == sum(p.stat().st_size for p in scene.folder.rglob("c.1.*"))
    assert scene.progress().committed_samples == 4
