"""Queries for samples."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from photonfarm.shared.core.errors import SpecError
from photonfarm.shared.core.keys import Key
from photonfarm.shared.core.records import F32

_KEY = re.compile(r"[0-9a-fA-F]{32}")


@dataclass(frozen=True, slots=True, eq=False)
class Query:
    """The conditions on samples; None stands for any value."""

    modification: F32 | Key | None = None  # a vector (4·G,) or (G, 4), or a content key
    view: F32 | Key | None = None  # a vector (6,), or a content key, which implies the modification
    sample: Key | None = None
    row: int | None = None
    job: int | None = None
    tolerance: float = 1e-3  # of positions, in scene units; 0: equal bit by bit

    @classmethod
    def of(
        cls,
        *,
        modification: str | None = None,
        view: str | None = None,
        sample: str | None = None,
        row: int | None = None,
        job: int | None = None,
        tolerance: float = 1e-3,
    ) -> Query:
        """The query of the command line's options; raises SpecError for text that is neither key nor vector."""
        if sample is not None and not _KEY.fullmatch(sample):
            raise SpecError(f"--sample {sample!r}: a key of 32 hexadecimal digits is required")
        return cls(
            _vector_or_key("--modification", modification, 4),
            _vector_or_key("--view", view, 6),
            None if sample is None else bytes.fromhex(sample),
            row, job, tolerance,
        )  # fmt: skip


def _vector_or_key(option: str, text: str | None, multiple: int) -> F32 | Key | None:
    if text is None:
        return None
    if _KEY.fullmatch(text.strip()):
        return bytes.fromhex(text.strip())
    words = text.replace(",", " ").replace("[", " ").replace("]", " ").split()
    try:
        vector = np.array([float(word) for word in words], np.float32)
    except ValueError as error:
        raise SpecError(f"{option} {text!r}: neither a key of 32 hexadecimal digits nor numbers") from error
    if len(vector) % multiple or not np.isfinite(vector).all() or (multiple == 6 and len(vector) != 6):
        rule = "six finite ones" if multiple == 6 else "four finite ones for each movable group"
        raise SpecError(f"{option}: has {len(vector)} numbers; {rule} are required")
    return vector
