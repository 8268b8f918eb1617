"""The 36 rows of hard scenes, each against its truth: the quick version of `make stability`."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.stability.report import keep
from tests.stability.rows import REFUSALS, ROWS, SCENES
from tests.stability.runner import message_of, run
from tests.stability.scenes.case import GUIDED, BdptSettings, HardScene, Refusal

SLOW = ("18-mask-veils", "25-hundred-lights-at-once")
FAILURES = Path(os.environ.get("PHOTONFARM_TEST_FAILURES", "test-failures"))
GUIDED_QUICK = ("07-updated-sun", "10-sphere-light", "22-mirrored-mesh-light", "26-narrow-spot")
"""The rows that are rendered with guided light paths in every run of the tests; the others are slow."""
QUICK = [scene for scene in SCENES if scene.quick is not None]


# One right scene fails by chance with probability 4e-6 per settings; the seeds are fixed.
@pytest.mark.parametrize(
    "scene",
    [pytest.param(scene, marks=[pytest.mark.slow] if scene.label in SLOW else [], id=scene.label) for scene in QUICK],
)
def test_a_hard_scene_looks_like_its_truth(scene: HardScene) -> None:
    check(scene)


@pytest.mark.parametrize(
    "scene",
    [
        pytest.param(scene, marks=[] if scene.label in GUIDED_QUICK else [pytest.mark.slow], id=scene.label)
        for scene in QUICK
        if GUIDED in scene.settings
    ],
)
def test_a_hard_scene_looks_like_its_truth_with_guided_light_paths(scene: HardScene) -> None:
    check(scene, GUIDED)


def check(scene: HardScene, *settings: BdptSettings) -> None:
    for outcome in run(scene, quick=True, settings=settings):
        if outcome.result.faults:
            folder = keep(outcome, FAILURES).resolve()
            pytest.fail(
                f"{scene.label} ({outcome.result.settings}), {scene.what_is_hard}; truth: {scene.truth.name}\n"
                f"{'; '.join(outcome.result.faults)}\nmean ratio {outcome.result.mean_ratio} ± "
                f"{outcome.result.mean_ratio_standard_error}\nagain: {outcome.result.command}\nrenders: {folder}"
            )


@pytest.mark.parametrize("refusal", REFUSALS, ids=lambda refusal: refusal.label)
def test_what_would_be_wrong_is_refused_with_the_reason(refusal: Refusal) -> None:
    (outcome,) = run(refusal, quick=True)
    assert outcome.result.faults == ()
    said = message_of(refusal)
    assert said.startswith("bdpt: ")
    assert "because" in said


def test_every_row_has_a_quick_version() -> None:
    found = {*(scene.row for scene in QUICK), *(refusal.row for refusal in REFUSALS)}
    assert found - {None} == set(range(1, ROWS + 1))


def test_labels_are_unique() -> None:
    labels = [*(scene.label for scene in SCENES), *(refusal.label for refusal in REFUSALS)]
    assert len(set(labels)) == len(labels)
