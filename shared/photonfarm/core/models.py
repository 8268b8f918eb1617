"""Models of what users write: they cannot change, refuse unknown keys, and say what is wrong in sentences."""

from __future__ import annotations

import difflib
import re
import unicodedata
from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

Probability = Annotated[float, Field(ge=0, le=1)]


def _check_name(name: str) -> str:
    """The name; refuses what could not be a part of a file's name, or of a command line, everywhere."""
    if re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}", name):
        return name
    asked = re.sub(r"[^A-Za-z0-9_.-]+", "-", unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode())
    instead = f", such as {asked.strip('-_.')[:64]!r}" if asked.strip("-_.") else ""
    raise ValueError(
        f"{name!r} is no name: up to 64 letters a to z without accents, digits, and - _ . are allowed, a letter or "
        f"digit first{instead}"
    )


Name = Annotated[str, AfterValidator(_check_name)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]
Factor = Annotated[float, Field(ge=0, le=1e30, allow_inf_nan=False)]  # as float32 holds it

INPUT_SHOWN = 100
"""The most characters of a wrong value that a message repeats, as the value may be a whole file."""


class Frozen(BaseModel):
    """A model that cannot change and refuses unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def sentences(error: ValidationError, known: Iterable[str] = (), of: Any = None) -> Iterator[str]:
    """One sentence for each fault that a model found: its key, the value and the rule.

    `known` are the allowed keys, perhaps each with where it stands. Entries of lists are called by their names in the
    document `of`, where they have one.
    """
    faults = error.errors()
    for fault in faults:
        place = fault["loc"]
        if fault["type"] == "too_short" and any(place == each["loc"][:-1][: len(place)] for each in faults):
            continue  # only as its faulty entries were left out
        key, rule = _key(place, of), rule_of(fault)
        if not key:  # of the whole
            yield rule
        elif fault["type"] == "value_error":
            yield f"{key}: {rule}"
        elif fault["type"] == "missing":
            yield f"{key}: is missing, and required"
        elif fault["type"] == "extra_forbidden":
            name, places = str(place[-1]), known if isinstance(known, Mapping) else {}
            others = [each for each in known if each != name]
            remedy = f"it belongs {where}" if (where := places.get(name)) else f"nearest: {nearest(name, others)}"
            yield f"{key}: unknown key; {remedy}"
        else:
            yield f"{key} = {show_value(fault['input'])}: {rule}"


def rule_of(fault: ErrorDetails) -> str:
    """The rule that a fault breaks, in words."""
    rule = _RULES[fault["type"]].format(**fault.get("ctx", {})) if fault["type"] in _RULES else fault["msg"]
    return rule.removeprefix("Value error, ")


def show_value(value: Any) -> str:
    """A value as it is written, or how it begins."""
    text = repr(value)
    return text if len(text) <= INPUT_SHOWN else f"{text[:INPUT_SHOWN]}…"


_RULES = {
    "bool_parsing": "true or false is required",
    "bool_type": "true or false is required",
    "dict_type": "a table is required",
    "float_parsing": "a number is required",
    "finite_number": "a finite number is required",
    "float_type": "a number is required",
    "greater_than": "above {gt} is required",
    "greater_than_equal": "{ge} or more is required",
    "int_from_float": "a whole number is required",
    "int_parsing": "a whole number is required",
    "int_type": "a whole number is required",
    "less_than": "below {lt} is required",
    "less_than_equal": "{le} or less is required",
    "literal_error": "must be {expected}",
    "model_type": "a table is required",
    "multiple_of": "a multiple of {multiple_of} is required",
    "string_type": "text is required",
    "too_long": "{max_length} or fewer are required",
    "too_short": "{min_length} or more are required",
    "tuple_type": "a list is required",
}
"""The rules that wrong types break, for people; by pydantic's kinds of faults."""


def _key(place: tuple[int | str, ...], document: Any) -> str:
    """A place in a document in words: `objects.0.box` is `objects "table".box` where that entry has this name."""
    words = ""
    for part in place:
        try:
            document = document[part]
        except (LookupError, TypeError):
            document = None
        name = document.get("name") if isinstance(part, int) and isinstance(document, Mapping) else None
        words += f' "{name}"' if isinstance(name, str) else f".{part}"
    return words.removeprefix(".")


Changes = dict[str, tuple[Any, Any]]
"""Changed values by key: the old and the new one."""


def differing(before: Mapping[str, Any], now: Mapping[str, Any], inside: str = "") -> Changes:
    """The values that differ, (then, now), by key; a key within another one as OUTER.INNER, an entry by its name."""
    changes: Changes = {}
    for key in {**before, **now}:
        then, value = _table_by_name(before.get(key)), _table_by_name(now.get(key))
        if isinstance(then, Mapping) and isinstance(value, Mapping):
            changes |= differing(then, value, f"{inside}{key}.")
        elif then != value:
            changes[f"{inside}{key}"] = (then, value)
    return changes


def _table_by_name(value: Any) -> Any:
    """A list of tables that all have names as one table of them; anything else as it is."""
    if isinstance(value, list) and value and all(isinstance(each, Mapping) and "name" in each for each in value):
        return {each["name"]: each for each in value}
    return value


def nearest(name: str, known: Iterable[str], least: float = 0.3) -> str:
    """Up to three known names that resemble an unknown one, by `least` of 1, for a message."""
    return ", ".join(difflib.get_close_matches(name, list(known), n=3, cutoff=least)) or "none"
