"""Everything photonfarm raises on purpose, and the exit code that the command line gives for it.

    PhotonfarmError                exit 1   (never raised itself)
    ├── SpecError (ValueError)     exit 3   a scene spec or a request that cannot be used
    ├── StoreError (OSError)       exit 4   a store, or other data, that cannot be read or written
    │   └── CorruptError           exit 4   stored bytes that are not what was committed
    ├── QueueError (OSError)       exit 5   no Redis, or one that refuses us
    ├── BackendError (RuntimeError) exit 6  this machine cannot render or import: Mitsuba, LLVM, card, scenes, Blender
    ├── SchedulerError (OSError)   exit 9   no SLURM, or one that refuses a job
    └── IncompleteError            exit 7   work that ended before it was done, samples that are not complete
        └── DivergedError          exit 8   training whose loss is no longer finite (in the trainer's `learner`)

Exit 0 is success, 2 is wrong usage of a command (given by click), 130 is Ctrl-C.
A message names the key, the value and the rule.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path


class PhotonfarmError(Exception):
    """Base of all errors that a user can cause or must know of."""

    exit_code = 1


class SpecError(PhotonfarmError, ValueError):
    """A scene spec or a request breaks a rule."""

    exit_code = 3


class StoreError(PhotonfarmError, OSError):
    """The store cannot be read or written."""

    exit_code = 4


class CorruptError(StoreError):
    """Stored bytes differ from what was committed."""


class QueueError(PhotonfarmError, OSError):
    """The queue's Redis cannot be reached or used."""

    exit_code = 5


class BackendError(PhotonfarmError, RuntimeError):
    """Mitsuba, Dr.Jit, LLVM or the scene files cannot be used on this machine."""

    exit_code = 6


class SchedulerError(PhotonfarmError, OSError):
    """SLURM is not here, or refuses a job."""

    exit_code = 9


class SceneNotHereError(BackendError):
    """The files of a scene are missing on this machine, or are others than were planned."""


class IncompleteError(PhotonfarmError):
    """Work ended before it was done; what is stored stays."""

    exit_code = 7


def say_install(extra: str) -> str:
    """The command that installs an extra, as docs/configuration.md has it."""
    return f"pip install -c constraints.txt '.[{extra}]' in the checkout"


@contextlib.contextmanager
def store_errors(doing: str, where: str | Path) -> Iterator[None]:
    """Turn an OSError into a StoreError that names what failed, where and why."""
    try:
        yield
    except StoreError:
        raise
    except OSError as error:
        reason = error.strerror or str(error)
        raise StoreError(f"{where}: cannot {doing}: {reason} ({error.filename or where})") from error
