"""Checkpoints: written whole or not at all, and enough to continue bit for bit."""

from __future__ import annotations

import io
import os
import pickle
import struct
from pathlib import Path
from typing import Any

import torch

from photonfarm.shared.errors import SpecError, StoreError
from photonfarm.shared.store import store_errors
from photonfarm.shared.store.local import sync

FORMAT = 1

UNREADABLE = (OSError, RuntimeError, ValueError, EOFError, LookupError, TypeError, AttributeError, struct.error,
              pickle.UnpicklingError)  # fmt: skip
"""What torch raises on bytes that it did not write."""


def save(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint: to a temporary name, synced, renamed, and the rename synced. StoreError where that fails."""
    content = io.BytesIO()  # torch writing to the file itself would hide why it failed
    torch.save({"format": FORMAT, **state}, content)
    partial = path.with_suffix(".partial")
    with store_errors("write the checkpoint", path):
        with partial.open("wb") as file:
            file.write(content.getbuffer())
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
        sync(path.parent)


def load(path: Path) -> dict[str, Any]:
    """A checkpoint's content, on the CPU. Raises StoreError if it cannot be read; nothing in it is executed."""
    try:
        state: Any = torch.load(path, map_location="cpu", weights_only=True)
    except UNREADABLE as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise StoreError(f"{path}: is not a readable checkpoint: {reason}") from error
    found = state.get("format") if isinstance(state, dict) else None
    if found != FORMAT:
        raise StoreError(f"{path}: has format {found!r}; this version reads {FORMAT}")
    return dict(state)


def check_continues(path: Path, state: dict[str, Any], **expected: Any) -> None:
    """Raise SpecError if the checkpoint is of another scene, network or seed than is asked for now."""
    for key, wanted in expected.items():
        if state[key] != wanted:
            raise SpecError(
                f"{path}: was trained with {key} = {state[key]!r}, and {wanted!r} is asked for now; "
                f"use another run directory, or the same {key}"
            )
