"""Markers: a job is committed when its marker is there. The marker names the job's files, their sizes and checksums."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from photonfarm.shared.errors import CorruptError, StoreError
from photonfarm.shared.store.storage import Storage, put_json, store_errors

COMMITTED = "committed"
_DIGITS = 12


def name_of(scene: str, job: int) -> str:
    """Where a job's marker lies; `scene` is the scene's folder."""
    return f"{scene}/{COMMITTED}/{job:0{_DIGITS}d}.json"


def place(
    storage: Storage, scene: str, job: int, files: Mapping[str, Mapping[str, Any]], figures: Mapping[str, Any]
) -> bool:
    """Announce a job, whose files have settled; False if it has been announced already."""
    below = {name.removeprefix(f"{scene}/"): about for name, about in files.items()}
    return put_json(storage, {"job": job, "files": below, "figures": figures}, name_of(scene, job))


def read(storage: Storage, scene: str, job: int) -> dict[str, Any]:
    """The marker of a committed job: its files, by path below the scene's folder, and its figures."""
    name = name_of(scene, job)
    try:
        document: dict[str, Any] = json.loads(storage.read(name))
    except OSError as error:
        raise StoreError(f"{storage.where}/{name}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise CorruptError(f"{storage.where}/{name}: is not a marker: {error}") from error
    return document


def jobs(storage: Storage, scene: str) -> set[int]:
    """The jobs of a scene that have their marker; costs one listing."""
    with store_errors("list the markers", f"{storage.where}/{scene}"):
        names = storage.names(f"{scene}/{COMMITTED}")
    return {int(name[:_DIGITS]) for name in names if name.endswith(".json")}
