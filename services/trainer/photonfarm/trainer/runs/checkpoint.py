"""Checkpoints: safetensors with the rest of the state as JSON inside; written atomically; enough to resume exactly.

Tensors in the file are named by their place in the state, `network.image_synthesis.out.weight`. The rest of the state
is the JSON under `photonfarm` in the file's metadata, with {"tensor": NAME} in place of each tensor, and a digest of
their bytes.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as to_bytes
from torch import Tensor

from photonfarm.core.errors import SpecError, StoreError, store_errors
from photonfarm.core.models import Changes, differing
from photonfarm.farm.training import METADATA
from photonfarm.store.io.local import sync
from photonfarm.trainer.runs.run_folder import GOOD, check_version
from photonfarm.trainer.runs.settings import EARLIER

FORMAT = 5
ANEW = "remove it, and the run begins anew"
TENSOR = "tensor"
DENOISER = "mitsuba-oidn"  # which filters what some networks are given

LASTING = ("scene_id", "exposure", "network", "batch", "hold_out", "optimiser", "loss", "seed", "start_from")
"""The settings that a run keeps for ever. The others may change when it is resumed."""

UNREADABLE = (SafetensorError, OSError, RuntimeError, ValueError, LookupError, TypeError, AttributeError)
"""The errors of reading bytes that were not written here."""


def save(path: Path, state: Mapping[str, Any]) -> None:
    """Write a checkpoint: to a temporary name, synced, renamed, and the rename synced. StoreError if that fails.

    A state consists of dictionaries by string, lists, tensors, and the other types of JSON.
    """
    tensors: dict[str, Tensor] = {}
    described = _take_apart(state, "", tensors)
    document = json.dumps({"format": FORMAT, "sha256": _hash_tensors(tensors), **described})
    content = to_bytes(tensors, {METADATA: document})  # safetensors writing to the file itself would not sync it
    partial = path.with_suffix(".partial")
    with store_errors("write the checkpoint", path):
        with partial.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
        sync(path.parent)


def load(path: Path, *, without: str = "") -> dict[str, Any]:
    """A checkpoint's content, on the CPU; nothing in it is executed.

    Raises StoreError if it cannot be read; the message ends with `without`, which states what removing the file does,
    or else with where a good one lies.
    """
    try:
        document, tensors = _read(path)
    except _DamagedError as error:
        raise StoreError(f"{path}: {error}; {without or _find_remedy(path)}") from error.__cause__
    if (stored := document.get("format")) != FORMAT:
        raise StoreError(
            f"{path}: has format {stored!r}, but this version reads format {FORMAT}; train anew in another folder"
        )
    state = dict(_put_together(document, tensors))
    if "settings" in state:
        state["settings"]["network"] = {**EARLIER, **state["settings"]["network"]}
    return state


class _DamagedError(Exception):
    """What is wrong with a checkpoint's bytes."""


def _find_remedy(path: Path) -> str:
    """What to do about a damaged checkpoint: go on from the good one beside it, if there is one, or begin anew."""
    good = path.with_name(GOOD)
    try:
        document, _ = _read(good)
    except (_DamagedError, StoreError):
        document = {}
    if document.get("format") != FORMAT or "store" not in document or good == path:
        return ANEW
    return f"{GOOD} beside it is whole, of step {document['step']}: `mv {good} {path}`, and the run goes on from there"


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The JSON document, and the tensors by their names, of one file, also while a trainer replaces it by the next.

    Raises _DamagedError for bytes that were not written so.
    """
    before = _identify(path)
    try:
        with safe_open(path, framework="pt") as file:
            document = dict(json.loads((file.metadata() or {}).get(METADATA, "{}")))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if document.get("format") == FORMAT and document.get("sha256") != _hash_tensors(tensors):
            raise _DamagedError("is damaged, as its numbers do not match its checksum")
    except FileNotFoundError as error:
        raise StoreError(
            f"{path}: there is no checkpoint yet; a run leaves one every 500 steps (--set checkpoint_every=N), and at "
            "its end"
        ) from error
    except (*UNREADABLE, _DamagedError) as error:
        if _identify(path) != before:
            return _read(path)
        if isinstance(error, _DamagedError):
            raise
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise _DamagedError(f"is not a readable checkpoint: {reason}") from error
    return document, tensors


def _identify(path: Path) -> tuple[int, int] | None:
    return (path.stat().st_ino, path.stat().st_mtime_ns) if path.exists() else None


def _hash_tensors(tensors: Mapping[str, Tensor]) -> str:
    """The digest of the tensors' names and bytes."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        digest.update(name.encode())
        digest.update(tensors[name].numpy().tobytes())
    return digest.hexdigest()


def _take_apart(value: Any, name: str, tensors: dict[str, Tensor]) -> Any:
    """The value with a reference in place of each tensor; the tensors are put into `tensors`, by their names."""
    if isinstance(value, Tensor):
        tensors[name] = value.detach().cpu().clone(memory_format=torch.contiguous_format)  # none share memory
        return {TENSOR: name}
    if isinstance(value, Mapping):
        return {key: _take_apart(member, f"{name}.{key}".lstrip("."), tensors) for key, member in value.items()}
    if isinstance(value, list):
        return [_take_apart(member, f"{name}.{place}", tensors) for place, member in enumerate(value)]
    return value


def _put_together(value: Any, tensors: Mapping[str, Tensor]) -> Any:
    """The value with a tensor in place of each reference."""
    if isinstance(value, dict):
        if value.keys() == {TENSOR}:
            return tensors[value[TENSOR]]
        return {key: _put_together(member, tensors) for key, member in value.items()}
    return [_put_together(member, tensors) for member in value] if isinstance(value, list) else value


def list_versions() -> dict[str, str]:
    """The versions of the packages that a run's arithmetic depends on."""
    others = {"python": platform.python_version(), "torch": torch.__version__, "numpy": np.__version__}
    with suppress(PackageNotFoundError):
        others[DENOISER] = version(DENOISER)
    return {"photonfarm": version("photonfarm"), **others}


def check_continues(path: Path, state: Mapping[str, Any], identity: Mapping[str, Any]) -> Changes:
    """Raise SpecError if the checkpoint is of another scene or exposure, or has other `LASTING` settings.

    Returns the other settings that have changed. Both arguments have `scene_id` and `settings`, and perhaps `exposure`.
    """
    kept = [name for name in ("scene_id", "exposure") if name in state and name in identity]
    then, now = ({**{name: one[name] for name in kept}, **one["settings"]} for one in (state, identity))
    check_version(path, then["network"])
    changed = differing(then, now)
    lasting = {key: values for key, values in changed.items() if key.split(".")[0] in LASTING}
    if lasting:
        differences = "; ".join(
            f"{key.removeprefix('network.')} = {then!r}, and {now!r} is asked for now"
            for key, (then, now) in lasting.items()
        )
        raise SpecError(f"{path}: was trained with {differences}; use another run folder, or the same values")
    return changed


def check_same_store(path: Path, state: Mapping[str, Any], plans: Sequence[Mapping[str, Any]]) -> None:
    """Raise SpecError unless the store's plans begin with those of the checkpoint, which number the rows.

    Raises StoreError for a checkpoint that holds only weights, such as that of a run that has not begun.
    """
    if "store" not in state:
        raise StoreError(f"{path}: holds only weights, and not the state of a run; {ANEW}")
    before = state["store"]["plans"]
    if list(plans[: len(before)]) != before:
        raise SpecError(
            f"{path}: was trained on samples of another store, or of other plans; use another run folder (--run), or "
            "the store that it was trained on (--store)"
        )
