"""What the columns of modification and view vectors hold, by name; part of the format's version."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from photonfarm.shared.core.records import F32

FIELDS = {
    "modification": (
        {"name": "x", "unit": "scene units", "rest": 0.0, "zero": "where the group was modelled"},
        {"name": "y", "unit": "scene units", "rest": 0.0, "zero": "where the group was modelled"},
        {"name": "z", "unit": "scene units", "rest": 0.0, "zero": "where the group was modelled"},
        {"name": "present", "unit": "1", "rest": 1.0, "zero": "removed"},
    ),
    "view": tuple(
        {"name": f"{point}_{axis}", "unit": "scene units", "rest": 0.0, "zero": "the origin of world coordinates"}
        for point in ("origin", "look_at")
        for axis in "xyz"
    ),
}
"""What the columns of `modification`, for each group, and of `view` hold. More may follow; a plan names those it has.

A field that a plan lacks is at `rest` in all of its rows. `zero` says what 0 means.
"""


def attributes(name: str, groups: Sequence[str]) -> dict[str, Any]:
    """The attributes that describe the columns of an array of inputs; empty for one that holds no vectors."""
    described: dict[str, Any] = {"fields": list(FIELDS[name])} if name in FIELDS else {}
    return described | ({"groups": list(groups)} if name == "modification" else {})


def known(name: str, values: F32, attributes: Mapping[str, Any]) -> F32:
    """Stored vectors (…, F) with the columns that this program knows; raises as `by_name` does."""
    return by_name(values, [str(field["name"]) for field in attributes["fields"]], FIELDS[name])


def by_name(values: F32, stored: Sequence[str], known: Sequence[Mapping[str, Any]]) -> F32:
    """Vectors (…, F) whose columns have the names `stored`, with the `known` fields; those not stored are at rest.

    Unused rows stay NaN. Raises ValueError for a field that is not known.
    """
    names = [field["name"] for field in known]
    if list(stored) == names:
        return values
    if unknown := [name for name in stored if name not in names]:
        raise ValueError(f"has the field {unknown[0]}, which this program does not know: install a newer photonfarm")
    found = np.empty((*values.shape[:-1], len(names)), np.float32)
    for place, field in enumerate(known):
        at_rest = np.where(np.isnan(values[..., 0]), np.float32(np.nan), np.float32(field["rest"]))
        found[..., place] = values[..., stored.index(field["name"])] if field["name"] in stored else at_rest
    return found
