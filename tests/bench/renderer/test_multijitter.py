"""`path` with the stratified sampler is a peer: the same camera, unbiased, and images that are independent."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from photonfarm.renderer.scene import backend

mi = backend.load(threads=1)
from bench.renderer.peers.methods import MitsubaMethod, integrator, multijittered  # noqa: E402
from tests.stability.scenes.hard_scenes import HARD_SCENES  # noqa: E402 - after the variant is set

SEEDS = 16
SPP = 16


def images(method: MitsubaMethod) -> Any:
    return np.stack([method.render(seed, SPP).image for seed in range(1, SEEDS + 1)]).astype(np.float64)


@pytest.fixture(scope="module")
def both() -> tuple[Any, Any]:
    """Cornell's box by `path`, [K, H, W, 3] with independent and with multijittered samples."""
    scene, path = mi.load_dict(HARD_SCENES["cornell"](32), optimize=False), integrator("path", 6, {})
    return images(MitsubaMethod(scene, path)), images(MitsubaMethod(scene, path, multijittered(scene)))


@pytest.mark.parametrize("name", ["cornell", "cove"])
def test_the_camera_built_anew_sees_the_same(name: str) -> None:
    scene, path = mi.load_dict(HARD_SCENES[name](32), optimize=False), integrator("path", 3, {})
    as_it_is = MitsubaMethod(scene, path).render(1, 4).image
    anew = np.array(mi.render(scene, sensor=multijittered(scene, "independent"), integrator=path, spp=4, seed=1))
    np.testing.assert_allclose(anew[..., :3], as_it_is, rtol=1e-4, atol=1e-6)


# Cornell's box at 16 spp: 0.62 of the variance was measured. Equal variance would mean that the sampler is not used.
def test_multijittered_samples_have_less_variance(both: tuple[Any, Any]) -> None:
    independent, stratified = both
    assert stratified.var(axis=0, ddof=1).mean() < 0.8 * independent.var(axis=0, ddof=1).mean()


# If images of different seeds shared points, averages of two would have more than half the variance of one.
# 8 averages of 3072 values: the ratio is known to about 2 % of itself.
def test_multijittered_images_of_different_seeds_are_independent(both: tuple[Any, Any]) -> None:
    stratified = both[1]
    pairs = stratified.reshape(SEEDS // 2, 2, *stratified.shape[1:]).mean(axis=1)
    ratio = pairs.var(axis=0, ddof=1).mean() / stratified.var(axis=0, ddof=1).mean()
    assert ratio == pytest.approx(0.5, rel=0.15)


@pytest.mark.parametrize(("asked", "given"), [(0.2, 1), (7.0, 4), (9.0, 16), (50.0, 64), (140.0, 256)])
def test_multijittered_samples_come_in_powers_of_four(asked: float, given: int) -> None:
    scene = mi.load_dict(HARD_SCENES["cornell"](8), optimize=False)
    method = MitsubaMethod(scene, integrator("path", 2, {}), multijittered(scene))
    assert method.possible(asked) == given
    method.render(1, given)
    assert method.stratified_camera.sampler().sample_count() == given
    assert MitsubaMethod(scene, integrator("path", 2, {})).possible(asked) == max(1, round(asked))
