"""A user's own networks and losses, named `MODULE:NAME` like entry points."""

from __future__ import annotations

import re
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from photonfarm.core.errors import PhotonfarmError, SpecError

_PATTERN = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*")


def is_own(name: str) -> bool:
    """Whether a name has the form `MODULE:NAME`."""
    return bool(_PATTERN.fullmatch(name))


def load(key: str, name: str) -> Any:
    """Load the object `MODULE:NAME`; the module is searched for on Python's path and in the current folder.

    `key` is the setting that names it. Raises SpecError if there is no such module, it fails, or it lacks the name.
    """
    module, _, attribute = name.partition(":")
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.insert(0, here)
    try:
        loaded = import_module(module)
    except ModuleNotFoundError as error:
        raise SpecError(
            f"{key} = {name!r}: Python finds no module {error.name!r}; run in the folder that holds it, or put that "
            "folder on PYTHONPATH"
        ) from error
    except Exception as error:
        frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename.startswith(here)]
        line = f", line {frames[-1].lineno}" if frames and not isinstance(error, SyntaxError) else ""
        raise SpecError(
            f"{key} = {name!r}: module {module} cannot be imported{line}: {type(error).__name__}: {error}"
        ) from error
    if not hasattr(loaded, attribute):
        exist = ", ".join(each for each in vars(loaded) if not each.startswith("_")) or "nothing"
        raise SpecError(f"{key} = {name!r}: {loaded.__file__} has no {attribute!r}; it has {exist}")
    return getattr(loaded, attribute)


def _suggest(error: Exception) -> str:
    is_of_none = isinstance(error, AttributeError) and error.obj is None
    return "; inputs that the network's `needs` does not name are None" if is_of_none else ""


@contextmanager
def name_in_errors(**own: str) -> Iterator[None]:
    """Turn an error from inside a user's module into a SpecError of one sentence, which names the line.

    `own` are settings and their values, of which those of the form `MODULE:NAME` count. Other errors pass.
    """
    try:
        yield
    except PhotonfarmError:
        raise
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        for key, name in own.items():
            file = getattr(sys.modules.get(name.partition(":")[0]), "__file__", None)
            if is_own(name) and (own_frames := [frame for frame in frames if frame.filename == file]):
                where = f"{file}, line {own_frames[-1].lineno}, in {own_frames[-1].name}"
                raise SpecError(
                    f"{key} = {name!r}: {where}: {type(error).__name__}: {error}{_suggest(error)}"
                ) from error
        raise
