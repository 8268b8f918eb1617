"""`photonfarm store check` looks at pictures and views: repeated seeds, and halves that differ."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import checked_store as stores
import numpy as np
import pytest

from photonfarm.core.records import ViewBuffers
from photonfarm.plan.request import Request
from photonfarm.scene.view import Camera
from photonfarm.store import JobWriter, SceneReader, SceneStore, Store
from photonfarm.store.check import job_check
from photonfarm.store.check.check import StoreReport
from photonfarm.store.format import markers

scene = stores.scene
samples, outputs, checked, found = stores.samples, stores.outputs, stores.checked, stores.found
noted, shard, marker, recommitted = stores.noted, stores.shard, stores.marker, stores.recommitted


def test_equal_halves_are_found_and_a_black_or_constant_image_is_no_repeated_seed(
    store: Store, scene: SceneStore
) -> None:
    def change(given: Any) -> None:
        given.radiance[0][1] = given.radiance[0][0]
        given.radiance[1][...] = 0
        given.radiance[2][...] = 0
        given.radiance[3][...] = 0.5

    recommitted(scene, 0, change)
    report = checked(store)
    assert found(report) == {"equal-halves": 1}
    assert noted(report)["black"] == 2


def test_a_black_half_is_noted_and_no_repeated_seed(store: Store, scene: SceneStore) -> None:
    """Two of them are equal to each other, and there may be hardly any light."""

    def change(given: Any) -> None:
        given.radiance[0][1] = 0
        given.radiance[3][0] = 0

    recommitted(scene, 0, change)
    report = checked(store)
    assert (noted(report), report.exit_code) == ({"black-half": 2}, 0)
    (group,) = report.scenes[0].groups
    assert [(f.row, f.detail.partition(" ")[0]) for f in group.first] == [(0, "B"), (3, "A")]


def test_equal_halves_that_come_out_equal_when_they_are_rendered_again_are_noted_and_left_alone(
    store: Store, scene: SceneStore
) -> None:
    """Pictures without noise: of a light that fills its pixels, say, with one bounce. Else they are set aside for ever.

    Rows 0 and 1 have equal halves each; rows 2 and 3 have them in common.
    """

    def change(given: Any) -> None:
        for row, of in ((0, 0), (1, 1), (2, 2), (3, 2)):
            given.radiance[row][:] = outputs(scene, 0).radiance[of][0]

    recommitted(scene, 0, change)
    report = checked(store, repair=True)
    assert (found(report), report.exit_code) == ({"equal-halves": 4, "equal-samples": 2}, 7)
    given = outputs(scene, 0)
    change(given)
    assert samples.commit(scene, 0, given)
    report = checked(store, repair=True)
    assert (noted(report), report.exit_code, report.scenes[0].set_aside) == ({"same-again": 6}, 0, ())


def test_a_row_that_a_late_writer_needs_float32_for_and_another_does_not_is_noted_and_left_alone(
    store: Store, scene: SceneStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two renders of a job give such rows where machines differ. The late one commits first, with both arrays there."""
    place = markers.place_marker

    def sleeping(*given: Any) -> bool:
        monkeypatch.setattr(markers, "place_marker", place)
        wide = outputs(scene, 0)
        wide.radiance[2][0, 0, 0, 0] = 1e9
        assert samples.commit(scene, 0, wide)
        return place(*given)

    for name in scene.marker(0)["files"]:
        (scene.folder / name).unlink()
    marker(scene, 0).unlink()
    monkeypatch.setattr(markers, "place_marker", sleeping)
    assert not samples.commit(scene, 0, outputs(scene, 0))
    report = checked(store, repair=True)
    assert (noted(report), report.exit_code, scene.missing_jobs()) == ({"twice": 1}, 0, [])
    reader = SceneReader(store.root, scene.scene_id)
    reader.refresh()
    np.testing.assert_array_equal(reader.read(2).radiance, outputs(scene, 0).radiance[2])


def test_samples_that_share_a_half_are_found_across_jobs(store: Store, scene: SceneStore) -> None:
    def change(given: Any) -> None:
        given.radiance[8][0] = outputs(scene, 0).radiance[2][1]

    recommitted(scene, 2, change)
    report = checked(store)
    assert found(report) == {"equal-samples": 2}
    (group,) = [g for g in report.scenes[0].groups if g.cause.label == "equal-samples"]
    assert {(f.row, f.job) for f in group.first} == {(2, 0), (8, 2)}


def test_samples_whose_keys_give_one_seed_are_noted_and_not_rendered_again(
    store: Store, scene: SceneStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seeds have 32 bits; rendered again, these samples would come out the same. Here all keys give one."""
    purposes = set()
    monkeypatch.setattr(job_check, "seed_of", lambda _, purpose: purposes.add(purpose) or 7)

    def change(given: Any) -> None:
        given.radiance[8][0] = outputs(scene, 0).radiance[2][1]

    recommitted(scene, 2, change)
    report = checked(store, repair=True)
    assert (noted(report), report.exit_code, report.scenes[0].set_aside) == ({"same-seed": 2}, 0, ())
    attempts = ("", ", attempt 1", ", attempt 2", ", attempt 3")
    assert purposes == {f"half {half}{attempt}" for half in "AB" for attempt in attempts}


def many(tmp_path: Path, change: Callable[[np.ndarray], None], samples_: int = 256) -> StoreReport:
    """The check of a store of noisy samples; heavy tails, as light transport has them."""
    store = Store(tmp_path / "many", create=True)
    scene = store.scene(store.plan(samples.small_spec(photons={"paths": 0}), Request(modifications=samples_)).scene_id)
    for job in scene.missing_jobs():
        given = samples.outputs(scene, job)
        for row, halves in given.radiance.items():
            halves[...] = np.random.default_rng(row).pareto(2.0, halves.shape)
            change(halves)
        samples.commit(scene, job, given)
    scene.write_base(*samples.base())
    return checked(store)


def test_halves_of_heavy_tailed_noise_do_not_differ(tmp_path: Path) -> None:
    report = many(tmp_path, lambda _: None)
    assert found(report) == {}
    assert report.scenes[0].halves.in_words.startswith("no difference beyond chance: |S| = ")


@pytest.mark.parametrize(("count", "tells"), [(37, False), (38, True)])
def test_samples_too_few_for_the_halves_to_differ_are_said_to_be_too_few(
    tmp_path: Path, count: int, tells: bool
) -> None:
    """Half B is always black here: the greatest difference that can be."""
    report = many(tmp_path, lambda halves: halves[1].fill(0), count)
    assert noted(report)["black-half"] == count
    assert found(report) == ({"halves-differ": 1} if tells else {})
    few = "too few samples to tell, 38 are needed at least: |S| = 6.08"
    assert report.scenes[0].halves.in_words.startswith("they differ by more than chance: |S| = 6.16" if tells else few)


def test_a_half_that_is_biased_somewhere_is_found(tmp_path: Path) -> None:
    """B is a third too dark in one eighth of the image."""

    def darken(halves: np.ndarray) -> None:
        halves[1, 2:3] *= 2 / 3

    report = many(tmp_path, darken)
    assert found(report) == {"halves-differ": 1}
    assert report.exit_code == 4
    assert report.scenes[0].halves.statistic > report.scenes[0].halves.limit


@pytest.mark.parametrize("name", ["point_seen", "photon_seen"])
def test_a_bit_of_a_point_or_photon_that_the_scene_does_not_have_is_found(
    store: Store, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """13 points and 5 photons, and a writer that sets the bit above them in one view of two."""
    spec = samples.small_spec(points=13, photons={"paths": 5, "depth": 1})
    scene = store.scene(store.plan(spec, Request(views_per_modification=2), shard_rows=2).scene_id)
    put = JobWriter._put

    def with_one_more(self: JobWriter, row: int, array: str, values: np.ndarray) -> None:
        if (row, array) == (1, name):
            values[-1] |= 1 << (13 if name == "point_seen" else 5) % 8
        put(self, row, array, values)

    monkeypatch.setattr(JobWriter, "_put", with_one_more)
    stores.commit_all(scene)
    scene.write_base(*samples.base())
    report = checked(store)
    assert found(report) == {"unused-bit": 1}
    (group,) = [group for group in report.scenes[0].groups if group.cause.label == "unused-bit"]
    assert (group.first[0].row, group.first[0].detail.partition(" ")[0]) == (1, name)


def test_views_of_nothing_and_views_from_behind_are_noted_and_are_no_error(store: Store, scene: SceneStore) -> None:
    """Normals along the rays are seen from behind; against them, from the front."""

    def change(given: Any) -> None:
        size = (scene.spec.film.height, scene.spec.film.width)
        rays = {row: Camera.of(view, scene.spec).rays() for row, view in scene.job_rows(0).views.items()}
        given.buffers[0] = ViewBuffers(*(np.zeros((*size, *c), np.float32) for c in ((), (3,), (3,))))
        given.buffers[1] = ViewBuffers(np.ones(size, np.float32), rays[1], rays[1])
        given.buffers[2] = ViewBuffers(np.ones(size, np.float32), rays[2], -rays[2])
        given.buffers[3] = ViewBuffers(np.ones(size, np.float32), rays[3], -rays[3])

    recommitted(scene, 0, change)
    for job in (1, 2):
        marker(scene, job).unlink()
    report = checked(store)
    assert report.exit_code == 0
    assert {name: count for name, count in noted(report).items() if name != "no-marker"} == {
        "empty-view": 1,
        "back-facing": 1,
    }
