"""The libraries that Mitsuba and Dr.Jit have loaded."""

from __future__ import annotations

import ctypes
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType


def library_of(module: ModuleType, pattern: str, functions: Iterable[str]) -> ctypes.CDLL | None:
    """The library beside a module whose name matches a pattern; None if it is not there or lacks a function."""
    path = next(Path(module.__file__ or "").parent.glob(pattern), None)
    if path is None:
        return None
    library = ctypes.CDLL(str(path))
    return library if all(hasattr(library, name) for name in functions) else None
