"""Samples of another store, planned in this one.

Shape letters: M modifications, V views, S samples.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from photonfarm.core.keys import KEY_BYTES
from photonfarm.core.models import Frozen
from photonfarm.plan.request import UNUSED, PlannedContent, SamplesToPlan, contents, view_contents


class Joined(Frozen):
    """What a plan of a join holds: samples that another store had. Its rows cannot be made from this alone."""

    kind: Literal["join"] = "join"
    store: str  # id of the other store
    samples: Annotated[int, Field(ge=1)]


def samples_to_join(other: PlannedContent, rows: NDArray[np.int64], known: PlannedContent) -> SamplesToPlan:
    """The samples in some rows of another store's plans that are not `known` in this one, in the order of the rows.

    Configurations and views that are known here keep the rows that they have here.
    """
    keys = other.column("sample_key")[rows]
    new = np.array([key.tobytes() not in known.samples for key in keys], np.bool_)
    rows, keys = rows[new], keys[new]
    modification_row, of_modification = np.unique(other.column("sample_modification")[rows], return_inverse=True)
    view_row, first, of_view = np.unique(other.column("sample_view")[rows], return_index=True, return_inverse=True)
    modification, view = other.vectors("modification", modification_row), other.vectors("view", view_row)
    here = np.array([known.modifications.get(each, UNUSED) for each in contents(modification)], np.int64)
    seen = view_contents(here[of_modification[first]], view)
    return SamplesToPlan(
        modification,
        here,
        view,
        np.array([known.views.get(each, UNUSED) for each in seen], np.int64),
        of_modification,
        of_view,
        other.column("sample_pass")[rows],
        keys.reshape(-1, KEY_BYTES),
        other.column("modification_density")[modification_row],
        other.column("view_density")[view_row],
    )
