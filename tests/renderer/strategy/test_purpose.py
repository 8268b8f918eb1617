"""What noise costs training and images: noise maps on which the two must disagree, and rendered ones."""

from typing import Any

import numpy as np
import pytest

from photonfarm.renderer.scene import backend

mi = backend.load(threads=1)

from photonfarm.core.records import F32  # noqa: E402
from photonfarm.renderer.strategy.candidates import PLAIN, Candidate  # noqa: E402
from photonfarm.renderer.strategy.noise import Purpose, pair_errors, training_weights, view_weights  # noqa: E402
from photonfarm.renderer.strategy.pilot import Choice, choose  # noqa: E402

LIGHT, JOINED = Candidate(0, 1.0), Candidate(1, 1.0)
CANDIDATES = [PLAIN, LIGHT, JOINED]
SHAPE = (32, 32, 3)
DARK, BRIGHT = 0.02, 1.0
VARIANCES = {PLAIN: (1e-3, 0.05), LIGHT: (1e-3, 0.01), JOINED: (1e-4, 0.05)}
"""Of one image, in the dark half and in the bright half."""


def half_dark(scale: float = 1.0) -> Any:
    """Images of which one half is dark, with gamma noise of VARIANCES; all values are multiplied by `scale`."""

    def render(candidate: Candidate, seed: int, spp: int) -> F32:
        rng = np.random.default_rng([seed, CANDIDATES.index(candidate)])
        halves = [
            rng.gamma(mean**2 / variance, variance / mean, (SHAPE[0] // 2, *SHAPE[1:]))
            for mean, variance in zip((DARK, BRIGHT), VARIANCES[candidate], strict=True)
        ]
        return np.asarray(scale * np.concatenate(halves), np.float32)

    return render


def chosen_for(purpose: Purpose, exposure: float, scale: float = 1.0) -> Choice:
    """The choice among candidates that all take a second an image."""
    ticks = iter(range(1_000_000))
    weigh = purpose.weigh(exposure)
    return choose(
        half_dark(scale), CANDIDATES, seconds=600, spp=1, keep=CANDIDATES, weigh=weigh, clock=lambda: float(next(ticks))
    )


def test_noise_in_the_dark_decides_for_images_and_noise_in_the_light_for_training() -> None:
    """Weights of images: 1/(r² + 0.01·0.51²), 333 and 0.997; of training: 1/(r² + 0.05), 19.8 and 0.952.

    Errors for images: light 0.1715, joined 0.0416; for training: light 0.0147, joined 0.0248. Those measured are a
    little less, as the brighter of two noisy references counts.
    """
    images, training = chosen_for(Purpose.IMAGES, 1.0), chosen_for(Purpose.TRAINING, 1.0)
    assert (images.candidate, training.candidate) == (JOINED, LIGHT)
    assert [images.row(c).error for c in (LIGHT, JOINED)] == pytest.approx([0.1715, 0.0416], rel=0.15)
    assert [training.row(c).error for c in (LIGHT, JOINED)] == pytest.approx([0.0147, 0.0248], rel=0.1)


@pytest.mark.parametrize("scale", [1 / 64, 64])
def test_only_exposed_radiance_counts_for_training(scale: float) -> None:
    """A factor on radiance that the exposure takes back changes no figure."""
    one, other = chosen_for(Purpose.TRAINING, 1.0), chosen_for(Purpose.TRAINING, 1 / scale, scale)
    assert [row.error for row in other.measured] == pytest.approx([row.error for row in one.measured], rel=1e-5)


def test_the_brighter_a_scene_is_exposed_the_more_its_dark_noise_counts() -> None:
    assert chosen_for(Purpose.TRAINING, 30.0).candidate == JOINED


def test_a_dark_view_counts_like_others_for_images_and_little_for_training() -> None:
    """Its pixels have the same relative noise, at a hundredth of the radiance."""
    rng = np.random.default_rng(1)
    bright = rng.gamma(4, 0.25, (10, *SHAPE)).astype(np.float32)
    dark = bright / 100
    errors = {}
    for purpose in Purpose:
        for name, images in (("bright", bright), ("dark", dark)):
            weights = purpose.weigh(1.0)(list(images[:8]))
            assert weights is not None
            errors[purpose, name] = pair_errors([(images[8], images[9])], weights)[0][0]
    assert errors[Purpose.IMAGES, "dark"] == pytest.approx(errors[Purpose.IMAGES, "bright"], rel=1e-4)
    assert errors[Purpose.TRAINING, "dark"] < 1e-2 * errors[Purpose.TRAINING, "bright"]


def test_a_black_view_has_no_weights() -> None:
    black = [np.zeros(SHAPE, np.float32)] * 2
    assert view_weights(black) is None
    assert training_weights(black, 1.0) is None
