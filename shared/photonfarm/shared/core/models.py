"""Models of what users write: they cannot change, refuse unknown keys, and say what is wrong in sentences."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

Probability = Annotated[float, Field(ge=0, le=1)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=64)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]
Factor = Annotated[float, Field(ge=0, allow_inf_nan=False)]

INPUT_SHOWN = 100
"""The most characters of a wrong value that a message repeats, as the value may be a whole file."""


class Frozen(BaseModel):
    """A model that cannot change and refuses unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def sentences(error: ValidationError, known: Iterable[str] = ()) -> Iterator[str]:
    """One sentence for each fault that a model found: its key, the value and the rule; `known` are the allowed keys."""
    for fault in error.errors():
        key = ".".join(map(str, fault["loc"]))
        rule = fault["msg"].removeprefix("Value error, ")
        if not key:  # of the whole
            yield rule
        elif fault["type"] in ("value_error", "missing"):
            yield f"{key}: {rule}"
        elif fault["type"] == "extra_forbidden":
            yield f"{key}: unknown key; nearest: {nearest(str(fault['loc'][-1]), known)}"
        else:
            yield f"{key} = {_shortened(repr(fault['input']))}: {rule}"


def _shortened(text: str) -> str:
    return text if len(text) <= INPUT_SHOWN else f"{text[:INPUT_SHOWN]}…"


def nearest(name: str, known: Iterable[str]) -> str:
    """Up to three known names that resemble an unknown one, for a message."""
    return ", ".join(difflib.get_close_matches(name, list(known), n=3, cutoff=0.3)) or "none"
