"""Which views are poor: by what is stored of them, as jobs, checks and trainers see it."""

from typing import Any

import numpy as np
import pytest
import store_samples as samples
from click.testing import CliRunner

from photonfarm.cli.main import umbrella
from photonfarm.scene.poor_views import describe_counts, find_poor, hand_of
from photonfarm.store import SceneStore, Store
from photonfarm.store.check.check import check_store

scene = samples.scene

HAND = 3**0.5 / 64  # of `small_spec`, whose cameras and look-at points are in the unit cube


def view(*, depth: float = 1.0, near_share: float = 0.0, **lit: float) -> dict[str, Any]:
    """What is stored of a view: a wall at a depth, of which a share is nearer than a hand, and lights in one pixel."""
    buffer = np.full((8, 8), depth, np.float16)
    buffer.ravel()[: round(64 * near_share)] = 0.9 * HAND
    images: dict[str, Any] = {name: np.zeros((8, 8, 3), np.float16) for name in ("emission", "direct", "gloss")}
    for name, value in lit.items():
        images[name][3, 4, 1] = value
    return {"depth": buffer, **images}


@pytest.mark.parametrize(
    ("of_view", "kinds"),
    [
        (view(direct=0.1), []),
        (view(emission=1e-3), []),
        (view(gloss=-0.1), []),  # noise may make gloss negative
        (view(), ["unlit"]),
        ({**view(), "photon_seen": np.array([0, 4], np.uint8)}, []),
        ({**view(), "photon_seen": np.zeros(2, np.uint8)}, ["unlit"]),
        (view(near_share=0.5, direct=1), ["near"]),
        (view(near_share=0.4, direct=1), []),
        (view(depth=0, direct=1), []),  # nothing is met
        (view(depth=0.5 * HAND), ["unlit", "near"]),
    ],
)
def test_a_view_is_poor_by_its_light_and_by_what_is_close(of_view: dict[str, Any], kinds: list[str]) -> None:
    assert hand_of(samples.small_spec()) == pytest.approx(HAND)
    assert find_poor(samples.small_spec(), of_view) == kinds


def test_jobs_count_poor_views_and_status_and_check_say_what_share_they_are(store: Store, scene: SceneStore) -> None:
    for job in range(3):
        given = samples.outputs(scene, job)
        for row in list(given.buffers)[: 1 if job == 0 else 0]:
            given.buffers[row].depth[:] = 0.5 * HAND
            for name in ("emission", "direct", "gloss"):
                getattr(given.guides[row], name)[:] = 0
            given.visibility[row].photons[:] = False
        assert samples.commit(scene, job, given)
    counts = {"all": 10, "unlit": 1, "near": 1}
    (status,) = samples.statuses(store)
    (report,) = check_store(Store(store.root), when="now").scenes
    assert status.views == report.views == counts
    for verb in (["status", "--redis", "unix:///none"], ["store", "check"]):
        assert describe_counts(counts) in CliRunner().invoke(umbrella, [*verb, "--store", str(store.root)]).output
    assert describe_counts(counts).startswith("of 10 views 1 (10 %) show")
    assert describe_counts({"all": 3}) == describe_counts({}) == ""
