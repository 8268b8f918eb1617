"""Withdrawn jobs of a plan: a small file beside it names them, and their rows count as unused."""

from __future__ import annotations

import json
from collections.abc import Set

from photonfarm.shared.core.errors import CorruptError
from photonfarm.shared.store.io.storage import Storage, put_json


def name_of(plan: str) -> str:
    """The file of a plan, given its folder."""
    return f"{plan}.withdrawn.json"


def read(storage: Storage, plan: str) -> frozenset[int]:
    """The withdrawn jobs of a plan whose file is there; raises CorruptError if it names none."""
    name = name_of(plan)
    try:
        return frozenset(int(job) for job in json.loads(storage.read(name))["jobs"])
    except (ValueError, KeyError, TypeError) as error:
        raise CorruptError(f"{storage.where}/{name}: names no jobs: {error}; put it back from a copy") from error


def write(storage: Storage, plan: str, jobs: Set[int]) -> None:
    """Name the withdrawn jobs of a plan, in place of those named before."""
    put_json(storage, {"jobs": sorted(jobs)}, name_of(plan), replace=True)
