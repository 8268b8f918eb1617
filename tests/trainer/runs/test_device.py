"""Which device a name stands for, and training on CUDA where there is one."""

import os

import numpy as np
import pytest
import torch
from held_out_errors import held_out_errors

from photonfarm.core.errors import SpecError
from photonfarm.trainer.runs import checkpoint
from photonfarm.trainer.runs.devices import (
    choose_preset,
    compute_deterministically,
    describe_device,
    round_convolutions,
    usable_device,
)
from photonfarm.trainer.runs.run_folder import CHECKPOINT
from photonfarm.trainer.runs.settings import NetworkSettings, TrainSettings
from photonfarm.trainer.training.loop import train

HAS_CUDA = torch.cuda.is_available()


def test_without_a_name_it_is_cuda_where_there_is_one() -> None:
    assert TrainSettings().device == "auto"
    assert usable_device("auto").type == ("cuda" if HAS_CUDA else "cpu")
    assert describe_device(usable_device("cpu")) == "cpu"


def test_the_preset_of_a_device_is_known_without_touching_a_card(monkeypatch: pytest.MonkeyPatch) -> None:
    for there in (True, False):
        monkeypatch.setattr(torch.cuda, "is_available", lambda there=there: there)
        named = "auto", "cpu", "cuda", "cuda:99"
        assert [choose_preset(device) for device in named] == ["card" if there else "small", "small", "card", "card"]


def test_a_name_that_is_no_device_of_ours_is_refused_with_those_that_are() -> None:
    with pytest.raises(SpecError, match="auto, cpu, cuda or cuda:N"):
        usable_device("meta")


@pytest.mark.parametrize("has", [True, False])
def test_a_cpu_without_bfloat16_is_said_to_be_slow_at_it(has: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.ops.mkldnn, "_is_mkldnn_bf16_supported", lambda: has)
    said = describe_device(torch.device("cpu"), "bfloat16")
    assert ("precision = float32" in said) is not has
    assert describe_device(torch.device("cpu"), "float32") == "cpu"


def test_a_cpu_is_said_to_have_no_tf32_and_its_setting_stays_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "in float32 instead" in describe_device(torch.device("cpu"), "tf32")
    for before in (True, False):
        monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", before)
        round_convolutions(torch.device("cpu"), "tf32")
        assert torch.backends.cudnn.allow_tf32 is before
        for precision in ("tf32", "float32", "bfloat16"):
            round_convolutions(torch.device("cuda"), precision)
            assert torch.backends.cudnn.allow_tf32 is (precision != "float32")


@pytest.mark.skipif(not HAS_CUDA, reason="there is no CUDA device, and only such have TF32")
def test_on_cuda_tf32_is_that_of_the_network_that_makes_the_image_and_of_its_gradient(make_source, tiny, run) -> None:
    for precision in ("tf32", "float32", "bfloat16"):
        network = NetworkSettings(width=4, precision=precision)
        train(make_source(24), tiny(network=network, device="cuda"), run / precision)
        assert torch.backends.cudnn.allow_tf32 is (precision != "float32")


def test_only_a_card_is_told_to_keep_to_an_order(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.backends.cudnn, "benchmark", True)
    monkeypatch.setenv("CUBLAS_WORKSPACE_CONFIG", "")
    try:
        compute_deterministically(torch.device("cpu"))
        assert not torch.are_deterministic_algorithms_enabled()
        compute_deterministically(torch.device("cuda"))
        assert torch.are_deterministic_algorithms_enabled()
        assert not torch.backends.cudnn.benchmark
        assert os.environ["CUBLAS_WORKSPACE_CONFIG"] == ":4096:8"
    finally:
        torch.use_deterministic_algorithms(mode=False)


@pytest.mark.parametrize("architecture", ["light_transport_photons", "guided_transport_photons"])
def test_a_run_that_goes_on_is_the_same_to_the_bit_on_a_card_too_if_told_so(
    make_source, tiny, run, tmp_path, architecture: str
) -> None:
    """On a processor the setting changes nothing, and the first run is without it."""
    network = NetworkSettings(width=4, architecture=architecture)
    try:
        train(make_source(24, photons=16), tiny(network=network, deterministic=HAS_CUDA), run)
        for steps in (5, 12):
            resumed = tiny(network=network, deterministic=True, max_steps=steps)
            train(make_source(24, photons=16), resumed, tmp_path / "resumed")
        weights = [checkpoint.load(folder / CHECKPOINT)["network"] for folder in (run, tmp_path / "resumed")]
        assert [name for name, weight in weights[0].items() if not torch.equal(weight, weights[1][name])] == []
        assert torch.are_deterministic_algorithms_enabled() is HAS_CUDA
    finally:
        torch.use_deterministic_algorithms(mode=False)


@pytest.mark.skipif(HAS_CUDA, reason="there is a CUDA device")
def test_cuda_that_is_not_there_is_refused() -> None:
    with pytest.raises(SpecError):
        usable_device("cuda")


@pytest.mark.skipif(not HAS_CUDA, reason="there is no CUDA device")
@pytest.mark.parametrize("architecture", ["light_transport_photons", "denoise_4"])
def test_on_cuda_a_run_steps_goes_on_and_is_the_cpus_but_for_rounding(
    make_source, tiny, run, tmp_path, architecture: str
) -> None:
    """float32 means float32: of TF32's 10 bits the weights would be some 1e-3 of their way apart after a few steps."""
    network = NetworkSettings(width=4, architecture=architecture)
    for stop in (3, 6):
        train(make_source(24, photons=16), tiny(network=network, max_steps=stop), run)
    train(make_source(24, photons=16), tiny(network=network, max_steps=6, device="cpu"), tmp_path / "cpu")
    ends = [checkpoint.load(folder / CHECKPOINT) for folder in (run, tmp_path / "cpu")]
    assert ends[0]["step"] == ends[1]["step"] == 6
    assert ends[0]["last_error"] == pytest.approx(ends[1]["last_error"], rel=1e-3)
    assert np.isfinite(held_out_errors(lambda: make_source(24, photons=16), run).last)
    assert not torch.backends.cudnn.allow_tf32
    assert describe_device(usable_device("auto")).startswith("cuda (")
