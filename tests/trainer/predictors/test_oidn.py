"""The ready denoiser, as a predictor beside the trained ones."""

import os
import subprocess
import sys
from dataclasses import replace
from itertools import combinations
from typing import get_args

import numpy as np
import pytest
import torch

from photonfarm.trainer.data.feed import Feed
from photonfarm.trainer.networks.inputs import Inputs, Needs, NoisyColour, SurfaceInputs
from photonfarm.trainer.predictors.denoisers import OIDN, Oidn, fill_in
from photonfarm.trainer.predictors.evaluation import measure, read_batches
from photonfarm.trainer.predictors.trained import ReadyPredictor
from photonfarm.trainer.runs.settings import OidnQuality

pytest.importorskip("mitsuba_oidn", reason="the extra `oidn` is not installed")


@pytest.fixture(scope="module")
def oidn() -> Oidn:
    return Oidn()


@pytest.mark.parametrize("of", [1, 4])
def test_it_is_measured_on_a_store_like_any_predictor_and_better_than_what_it_is_given(
    make_source, tiny, oidn: Oidn, of: int
) -> None:
    """Its measured error against the one that the clean images give, within 3 σ of the pairs' differences."""
    count = 96
    source = make_source(count, size=32, noise=1.0)
    given_images = {}
    with Feed(source, tiny(), needs=Needs(points=False, kept=of)) as feed:

        def filled(batch):
            return fill_in(batch.inputs.noisy, batch.inputs.albedo).numpy()

        def remembered(batch):
            images = oidn(batch.inputs).numpy()
            given_images.update(zip(batch.rows, images, strict=True))
            return images

        before, after = (measure(p, read_batches(feed, range(count), 3)) for p in (filled, remembered))
    assert after.error.mean < 0.7 * before.error.mean if of == 1 else after.error.mean < before.error.mean
    truth = np.array([np.mean((given_images[row] - source.clean(row)) ** 2) for row in range(count)])
    difference = after.per_sample - truth
    assert abs(difference.mean()) < 3 * difference.std(ddof=1) / np.sqrt(count)


@pytest.mark.parametrize("quality", get_args(OidnQuality))
def test_bright_light_stays_as_bright_as_it_is(quality: OidnQuality) -> None:
    """The package clips at 1 without its flag for HDR."""
    rng = np.random.default_rng(0)
    albedo = np.full((64, 64, 3), 0.5, np.float32)
    normal = np.tile(np.array([0, 0, 1], np.float32), (64, 64, 1))
    colour = (20 * rng.gamma(4, 1 / 4, albedo.shape)).astype(np.float32)
    denoised = Oidn(quality=quality).denoise(*map(torch.from_numpy, (colour, albedo, normal))).numpy()
    assert denoised.mean() == pytest.approx(20, rel=0.05)
    assert np.mean((denoised - 20) ** 2) < 0.05 * np.mean((colour - 20) ** 2)


def test_each_quality_and_what_it_is_fed_have_a_name_and_make_images_of_their_own(make_source, tiny) -> None:
    made = {}
    for denoiser in OIDN:
        ready = ReadyPredictor(denoiser, 1, tiny())
        with Feed(make_source(1, size=32, noise=1.0), tiny(), needs=ready.needs) as feed:
            (batch,) = read_batches(feed, [0], 1)
            if batch.inputs.surface is not None:
                batch.inputs.surface.specular[:, :16] += 0.5
            made[ready.name] = ready.predictor(feed.spec, feed.base, "cpu")(batch)
    fed = ("", "-balanced", "-fast", "-reflectance", "-balanced-reflectance", "-fast-reflectance")
    assert list(made) == [f"oidn{how} 1/1" for how in fed]
    for one, other in combinations(made.values(), 2):
        difference = np.abs(one - other).max()
        assert 1e-4 < difference < 0.5


def test_the_pattern_of_a_metal_stays_where_reflectance_is_given() -> None:
    """A chequered metal, whose diffuse albedo is 0, under noise of twice its light, beside a lamp."""
    rng, shape = np.random.default_rng(0), (1, 64, 64, 3)
    pattern = np.where((np.indices((64, 64)) // 4).sum(axis=0) % 2, 0.9, 0.3).astype(np.float32)[None, ..., None]
    colour = torch.from_numpy((pattern * rng.gamma(0.25, 4, shape)).astype(np.float32))
    black, normal = torch.zeros(shape), torch.tensor([0.0, 0.0, 1.0]).expand(shape)
    metal = torch.from_numpy(np.broadcast_to(pattern, shape).copy())
    inputs = Inputs(
        torch.zeros(1, 3, 4), torch.ones(shape[:3]), black, normal, noisy=NoisyColour(colour, black[..., 0] == 0)
    )
    surface = SurfaceInputs(emission=black, specular=metal, throughput=black, beyond_albedo=black)
    before, after = (
        float((Oidn()(each) - metal).square().mean()) for each in (inputs, replace(inputs, surface=surface))
    )
    assert after < 0.2 * before
    lamp, mirror = black.clone(), black.clone()
    lamp[:, :8], mirror[:, 8:] = 20, 0.5
    seen = SurfaceInputs(emission=lamp, specular=mirror, throughput=mirror, beyond_albedo=metal)
    assert torch.equal(replace(inputs, surface=seen).reflects[:, :8], black[:, :8] + 1)
    assert torch.equal(replace(inputs, surface=seen).reflects[:, 8:], 0.5 * metal[:, 8:])


def test_it_needs_no_mitsuba_and_no_gpu() -> None:
    lines = (
        "import sys, torch",
        "from photonfarm.trainer.predictors.denoisers import Oidn",
        "Oidn()",
        "assert not {'mitsuba', 'drjit'} & set(sys.modules)",
        "assert not torch.cuda.is_initialized()",
    )
    environment = {**os.environ, "CUDA_VISIBLE_DEVICES": ""}
    subprocess.run([sys.executable, "-c", "\n".join(lines)], env=environment, check=True, timeout=60)
