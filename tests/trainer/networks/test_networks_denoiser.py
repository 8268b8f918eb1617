"""What a denoiser sees of a noisy image, what it is trained on, and its error without the noise. Limits are 3 σ."""

import numpy as np
import pytest
import torch
from read_batches import batch_of

from photonfarm.core.statistics import Estimate, clean_error, clean_error_having_seen_a
from photonfarm.trainer.data.batch import choose_kept_pixels
from photonfarm.trainer.networks import ARCHITECTURES, build
from photonfarm.trainer.networks.inputs import SceneFrame
from photonfarm.trainer.runs.settings import NetworkSettings

DENOISERS = {"denoise_1": 1, "denoise_4": 4, "denoise_16": 16, "denoise_32": 32, "denoise_64": 64}


@pytest.mark.parametrize(("architecture", "of"), DENOISERS.items())
def test_exactly_so_many_pixels_are_kept_and_the_rest_is_zero(make_source, architecture: str, of: int) -> None:
    source = make_source(4)
    batch = batch_of(source, (0, 1, 2, 3), ARCHITECTURES[architecture].needs)
    noisy = batch.inputs.noisy
    assert noisy.kept.sum(dim=(1, 2)).tolist() == [256 // of] * 4
    assert torch.equal(noisy.colour, batch.target[:, 0] * noisy.kept[..., None])


@pytest.mark.parametrize("architecture", DENOISERS)
def test_a_denoiser_sees_the_kept_pixels_of_half_a_and_nothing_else_of_the_image(
    make_source, architecture: str
) -> None:
    source = make_source(1)
    settings = NetworkSettings(width=4, architecture=architecture)
    network = build(settings, SceneFrame.of(source.spec, *source.base(), settings), 0)
    sample = source.read(0)
    kept = choose_kept_pixels(sample.key, source.spec, DENOISERS[architecture])

    def image() -> torch.Tensor:
        with torch.no_grad():
            return network(batch_of(source, (0,), ARCHITECTURES[architecture].needs).inputs)

    source.read = lambda _: sample
    before = image()
    sample.radiance[1] = 1e3
    sample.radiance[0][~kept] = 1e3
    assert torch.equal(image(), before)
    sample.radiance[0][np.argwhere(kept)[0][0], np.argwhere(kept)[0][1]] += 1
    assert not torch.equal(image(), before)


def test_the_pixels_kept_follow_from_what_the_sample_is(make_source) -> None:
    source, again = make_source(3), make_source(3)
    kept = [choose_kept_pixels(source.read(row).key, source.spec, 4) for row in range(3)]
    assert all(np.array_equal(kept[row], choose_kept_pixels(again.read(row).key, again.spec, 4)) for row in range(3))
    assert not np.array_equal(kept[0], kept[1])
    fewer = choose_kept_pixels(source.read(0).key, source.spec, 16)
    assert not (fewer & ~kept[0]).any()


def test_pixels_are_kept_uniformly(make_source) -> None:
    """Binomial over 400 samples, the largest of 256 pixels: |z| < 4.5 has a chance of 0.998."""
    source = make_source(400)
    times = sum(choose_kept_pixels(source.read(row).key, source.spec, 4).astype(int) for row in range(400))
    assert np.abs(times - 100).max() < 4.5 * np.sqrt(400 * 3 / 16)


def test_a_denoiser_is_trained_from_a_to_b_and_from_b_to_a(make_source) -> None:
    source = make_source(2)
    plain = batch_of(source, (0, 1), ARCHITECTURES["denoise_4"].needs)
    pairs = plain.for_training()
    assert pairs.rows == (0, 1, 0, 1)
    assert pairs.target.shape == (4, 1, 16, 16, 3)
    kept = plain.inputs.noisy.kept[..., None]
    for inputs, target, places in ((0, 1, slice(0, 2)), (1, 0, slice(2, 4))):
        assert torch.equal(pairs.inputs.noisy.colour[places], plain.target[:, inputs] * kept)
        assert torch.equal(pairs.target[places, 0], plain.target[:, target])
        assert torch.equal(pairs.inputs.albedo[places], plain.inputs.albedo)
    assert batch_of(source, (0, 1), ARCHITECTURES["cnn"].needs).for_training().target.shape == (2, 2, 16, 16, 3)


def test_the_error_of_a_prediction_made_from_a_has_the_noise_removed() -> None:
    """A blur of A, against the clean image; the error for predictions that saw neither half is far off."""
    rng = np.random.default_rng(0)
    clean = rng.random((16, 16, 3), np.float32)
    found, naive, truth = [], [], []
    for _ in range(1500):
        a, b = (clean * rng.gamma(0.5, 2, (2, 16, 16, 3))).astype(np.float32)
        blurred = 0.5 * a + 0.25 * (np.roll(a, 1, axis=0) + np.roll(a, -1, axis=0))
        found.append(clean_error_having_seen_a(blurred, a, b) - float(np.mean((blurred - clean) ** 2)))
        naive.append(clean_error(blurred, a, b) - float(np.mean((blurred - clean) ** 2)))
        truth.append(float(np.mean((blurred - clean) ** 2)))
    difference = Estimate.of(np.array(found))
    assert abs(difference.mean) < 3 * difference.standard_error
    assert difference.standard_error < 0.02 * np.mean(truth)
    assert abs(np.mean(naive)) > 0.2 * np.mean(truth)
