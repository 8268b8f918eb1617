"""Checkpoints: written whole or not at all, and enough to continue bit for bit."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch

from photonfarm.shared.errors import SpecError, StoreError

FORMAT = 1


def save(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint: to a temporary name, synced, renamed, and the rename synced."""
    partial = path.with_suffix(".partial")
    with partial.open("wb") as file:
        torch.save({"format": FORMAT, **state}, file)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def load(path: Path) -> dict[str, Any]:
    """A checkpoint's content, on the CPU. Raises StoreError if it cannot be read; nothing in it is executed."""
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, ValueError, EOFError) as error:
        raise StoreError(f"{path}: is not a readable checkpoint: {error}") from error
    if state.get("format") != FORMAT:
        raise StoreError(f"{path}: has format {state.get('format')!r}; this version reads {FORMAT}")
    return state


def check_continues(path: Path, state: dict[str, Any], **expected: Any) -> None:
    """Raise SpecError if the checkpoint is of another scene, network or seed than is asked for now."""
    for key, wanted in expected.items():
        if state[key] != wanted:
            raise SpecError(
                f"{path}: was trained with {key} = {state[key]!r}, and {wanted!r} is asked for now; "
                f"use another run directory, or the same {key}"
            )
