"""Which views are poor, as jobs, checks and trainers see it."""

from typing import Any

import numpy as np
import pytest
import store_samples as samples
from click.testing import CliRunner

from photonfarm.cli.main import umbrella
from photonfarm.core.records import Photons
from photonfarm.scene.poor_views import are_near, describe_counts, hand_of, is_unlit
from photonfarm.store import SceneStore, Store
from photonfarm.store.check.check import check_store
from photonfarm.store.model.store import scene_status

scene = samples.scene

HAND = 3**0.5 / 64  # of `small_spec`, whose cameras and look-at points are in the unit cube


@pytest.mark.parametrize(
    ("depth", "near_share", "is_near"), [(1, 0.5, True), (1, 0.4, False), (0, 0, False), (0.5 * HAND, 0, True)]
)
def test_a_view_is_near_if_half_of_it_is_within_a_hand(depth: float, near_share: float, is_near: bool) -> None:
    buffer = np.full((8, 8), depth, np.float16)
    buffer.ravel()[: round(64 * near_share)] = 0.9 * HAND
    assert hand_of(samples.small_spec()) == pytest.approx(HAND)
    assert are_near(HAND, np.stack([buffer, buffer])).tolist() == [is_near] * 2


def photon(*, above: bool) -> Photons:
    """One on a floor at height 0, whose normal points up, from above or from below."""
    travels = np.array([[0.6, -0.8 if above else 0.8, 0]], np.float32)
    up = np.array([[0, 1, 0]], np.float32)
    return Photons(np.zeros((1, 3), np.float32), travels, up, up, np.zeros(1, np.int8))


@pytest.mark.parametrize(
    ("eye", "seen", "light", "unlit"),
    [
        ((0, 1, 0), True, {}, False),  # it landed where the eye is
        ((0, -1, 0), True, {}, True),  # on the other side
        ((0, 1, 0), False, {}, True),  # behind something
        ((0, -1, 0), True, {"direct": 0.1}, False),
        ((0, -1, 0), True, {"emission": 1e-3}, False),
        ((0, -1, 0), True, {"gloss": -0.1}, False),  # noise may make gloss negative
    ],
)
@pytest.mark.parametrize("above", [True, False])
def test_a_view_is_unlit_if_neither_guides_nor_photons_light_what_it_shows(
    eye: tuple[float, ...], seen: bool, light: dict[str, float], unlit: bool, above: bool
) -> None:
    images: dict[str, Any] = {name: np.zeros((8, 8, 3), np.float16) for name in ("emission", "direct", "gloss")}
    for name, value in light.items():
        images[name][3, 4, 1] = value
    at = np.array(eye, np.float32) * (1 if above else -1)
    assert is_unlit(images, at, np.array([seen]), lambda: photon(above=above)) == unlit
    assert not is_unlit(images, at, np.zeros(0, bool), lambda: photon(above=above))  # of a scene without photons


def test_jobs_count_poor_views_and_status_and_check_say_what_share_they_are(store: Store, scene: SceneStore) -> None:
    for job in range(3):
        given = samples.outputs(scene, job)
        if job == 1:
            given.buffers[4].depth[:] = 0.5 * HAND
            given.radiance[4][:] = given.radiance[5][:] = given.radiance[6][0] = 0
        assert samples.commit(scene, job, given)
    counts = {"samples": 10, "black": 2, "views": 10, "near": 1}
    (status,) = samples.statuses(store)
    (report,) = check_store(Store(store.root), when="now").scenes
    assert status.counts == report.counts == scene_status(scene).counts == counts
    for verb in (["status", "--redis", "unix:///none"], ["store", "check"]):
        assert describe_counts(counts) in CliRunner().invoke(umbrella, [*verb, "--store", str(store.root)]).output
    assert describe_counts(counts).startswith("2 of 10 samples (20 %) are black; 1 of 10 views (10 %)")
    assert describe_counts({**counts, "black": 0, "near": 0}) == describe_counts({}) == ""
