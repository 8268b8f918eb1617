"""Quick versions of the invariances; the long ones run in `make stability`."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import pytest

from photonfarm.renderer.bdpt import launches
from tests.stability.invariances import Invariance, checks
from tests.stability.scenes.hard_scenes import HARD_SCENES

# The oracle's have tests of their own, and more of them: test_oracle.py
SLOW = ("seed-many-lights", "counts-many-lights", "counts-plastics")
QUICK = [
    pytest.param(check, marks=[pytest.mark.slow] if check.name in SLOW else [], id=check.name)
    for check in checks(long=False)
    if not check.name.startswith("weights-")
]


# Each right check fails by chance with probability 4e-6 per comparison; the seeds are fixed.
@pytest.mark.parametrize("check", QUICK)
def test_an_image_does_not_change_with_what_must_not_matter(check: Invariance) -> None:
    faults, figures = check.run()
    assert not faults, f"{check.claim}: {figures}\nagain: {check.command}"


# ------------------------------------------------ Several launches ------------------------------------------------


@pytest.mark.parametrize("light_ratio", [0.3, 1.0])
def test_an_image_in_parts_has_the_mean_of_the_whole(
    light_ratio: float, monkeypatch: pytest.MonkeyPatch, renders: Any, assert_equal_means: Any
) -> None:
    scene = mi.load_dict(HARD_SCENES["plastics"](16), optimize=False)
    bdpt = {"type": "bdpt", "max_depth": 4, "light_ratio": light_ratio}
    whole = renders(scene, bdpt, 32, range(8))
    monkeypatch.setattr(launches, "LAUNCH_PATHS", 5 * 16 * 16)  # 5 samples of 32, the last launch shorter
    assert_equal_means(renders(scene, bdpt, 32, range(100, 108)), whole)
