"""What training minimises, and what it refuses to: messages, their figures, demodulation, optimisers."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
from fireflies import held_at, least
from held_out_errors import held_out_errors
from read_batches import batch_of

from photonfarm.core.errors import SpecError
from photonfarm.trainer.networks import build
from photonfarm.trainer.networks.inputs import Needs, SceneFrame
from photonfarm.trainer.predictors.evaluation import make_network_predictor
from photonfarm.trainer.runs import settings
from photonfarm.trainer.runs.settings import NetworkSettings, TrainSettings, make_settings
from photonfarm.trainer.training.learner import build_optimiser, compute_rate
from photonfarm.trainer.training.loop import train

# ------------------------------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("key", "value", "reason"),
    [
        ("loss", "l1", settings.L1),
        ("loss", "L1", settings.L1),
        ("loss", "log", settings.LOG),
        ("loss", "smape", settings.TARGET_WEIGHT),
        ("loss", "srgb", settings.DISPLAY),
        ("loss", "ssim", settings.STRUCTURE),
        ("gradient_clip", 1.0, settings.CLIPPED_GRADIENT),
        ("max_grad_norm", 5, settings.CLIPPED_GRADIENT),
        ("firefly_clamp", 10, settings.CLAMPED),
        ("tone_mapping", "aces", settings.DISPLAY),
    ],
)
def test_what_biases_under_noisy_targets_is_refused_with_the_reason(key: str, value: object, reason: str) -> None:
    with pytest.raises(SpecError, match=f"{key} = {value!r}: .*{re.escape(reason)}"):
        make_settings("small", {key: value})


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"loss": "squared"}, "loss = 'squared': .*'linear', 'relative' or 'paired', or MODULE:NAME"),
        ({"loss": 3}, "loss = 3"),
        ({"optimiser": "sgd"}, "optimiser = 'sgd': .*'adam' or 'rmsprop'"),
        ({"gradient": 1}, "gradient: "),
        ({"demodulation": 0.0}, r"demodulation = 0\.0"),
        ({"loss": "paired", "architecture": "denoise_4"}, "loss = 'paired'"),
    ],
)
def test_other_values_get_the_ordinary_message(changes: dict[str, object], named: str) -> None:
    with pytest.raises(SpecError, match=named) as error:
        make_settings("small", changes)
    assert "bias" not in str(error.value)


def test_every_fault_is_named_at_once() -> None:
    with pytest.raises(SpecError, match=r"max_grad_norm = 1.*loss = 'l1'"):
        make_settings("small", {"loss": "l1", "max_grad_norm": 1})


def test_the_figures_of_the_messages_are_measured() -> None:
    found = {name: tuple(round(value, 2) for value in values) for name, values in least().items()}
    said = {
        "absolute error (L1)": settings.L1,
        "squared error of log(1 + x)": settings.LOG,
        "squared error after clip to 1 and gamma 2.2": settings.DISPLAY,
        "squared error, targets clamped at 1": settings.CLAMPED,
        "relative, weight from the noisy target": settings.TARGET_WEIGHT,
        "relative, weight from the prediction, not detached": settings.UNDETACHED,
        "squared error, gradient of each step clipped at 1 (Huber)": settings.CLIPPED_GRADIENT,
    }
    for name, bias in said.items():
        assert ", ".join(f"{value:.2f}" for value in found[name]) in bias
    unbiased = found["squared error; relative with detached weight"]
    assert unbiased == pytest.approx((0.9, 0.9, 0.9), abs=0.03)  # 4 σ of the mean of so many targets


# ----------------------------------------------------------------------------------------------------------- optimisers


def test_adam_darkens_a_pixel_under_rare_fireflies_and_a_longer_memory_does_so_less() -> None:
    """1e-4 × 3000 on 0.6: mean 0.9. Means over 256 pixels and the last of 20 000 steps vary by 0.003 between seeds."""
    short, long = (held_at(TrainSettings(beta2=b), steps=20_000, pixels=256) for b in (0.999, 0.99999))
    assert short == pytest.approx([0.618, 0.786, 0.895], abs=0.02)
    assert short[1] + 0.03 < long[1] < 0.91
    assert long[2] == pytest.approx(0.9, abs=0.01)


def test_both_optimisers_take_their_settings() -> None:
    weight = [torch.nn.Parameter(torch.zeros(1))]
    adam = build_optimiser(weight, TrainSettings(beta1=0.8, beta2=0.9999, learning_rate=1e-4))
    assert isinstance(adam, torch.optim.Adam)
    assert adam.param_groups[0]["betas"] == (0.8, 0.9999)
    rmsprop = build_optimiser(weight, TrainSettings(optimiser="rmsprop", alpha=0.95, learning_rate=1e-4))
    assert isinstance(rmsprop, torch.optim.RMSprop)
    assert rmsprop.param_groups[0]["alpha"] == 0.95
    assert {o.param_groups[0]["lr"] for o in (adam, rmsprop)} == {1e-4}


def test_the_rate_falls_with_every_epoch_of_samples_whatever_the_batch() -> None:
    for batch in (1, 5, 10):
        settings = TrainSettings(batch=batch, epoch_samples=100, learning_rate=1e-3, decay=0.5)
        assert [compute_rate(samples // batch, settings) for samples in (0, 90, 100, 250)] == [1e-3, 1e-3, 5e-4, 2.5e-4]


# --------------------------------------------------------------------------------------------------------- demodulation


@pytest.mark.parametrize("architecture", ["cnn", "light_transport"])
def test_a_demodulated_network_is_the_same_network_times_the_albedo(make_source, architecture: str) -> None:
    source = make_source(1)
    batch = batch_of(source, (0,), Needs())
    plain, demodulated = (
        build(settings, SceneFrame.of(source.spec, *source.base(), settings), 0)
        for settings in (NetworkSettings(architecture=architecture, width=4, demodulation=e) for e in (None, 0.05))
    )
    assert list(plain.state_dict()) == list(demodulated.state_dict())
    factor = batch.inputs.albedo.numpy() + np.float32(0.05)
    np.testing.assert_array_equal(
        make_network_predictor(demodulated)(batch), make_network_predictor(plain)(batch) * factor
    )


def test_a_demodulated_network_is_trained_and_evaluated_on_its_images(make_source, tiny, run) -> None:
    settings = tiny(network=NetworkSettings(width=4, demodulation=0.1), max_steps=60, learning_rate=5e-3)
    outcome = train(make_source(24), settings, run)
    found = held_out_errors(lambda: make_source(24), run)
    assert outcome.last_error == pytest.approx(found.last, rel=1e-5)
    assert found.last < 0.7 * found.first
