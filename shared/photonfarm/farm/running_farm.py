"""Where a `photonfarm up` of this machine announces itself, so that `status` and `web` find its Redis by the store."""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from photonfarm.core.files import write_whole
from photonfarm.core.processes import is_gone, process_space

if TYPE_CHECKING:
    from photonfarm.store import Store

WEB_PORT = 8420
"""The port of the pages, unless it is taken."""

METRICS_PORT = 8421
"""The port of `serve-metrics`."""


@dataclass(frozen=True, slots=True)
class RunningFarm:
    """A farm of this user that is at work on this machine."""

    process: int
    space: str  # in which the process number counts
    redis_url: str
    run: str | None  # the trainer's folder, absolute; None if nothing is trained
    web: str | None  # the address of its pages


@contextlib.contextmanager
def announce(store: Store, *, redis_url: str, run: Path | None, web: str | None) -> Iterator[None]:
    """Announce this process's farm until the block ends; a disk that refuses that is no reason not to render."""
    farm = RunningFarm(os.getpid(), process_space(), redis_url, str(run.absolute()) if run else None, web)
    file = _file(store)
    try:
        with contextlib.suppress(OSError):
            file.parent.mkdir(mode=0o700, exist_ok=True)
            if _is_ours(file.parent):
                write_whole(file, json.dumps(asdict(farm)))
        yield
    finally:
        if (announced := _read(file)) is not None and announced.process == os.getpid():
            with contextlib.suppress(OSError):
                file.unlink(missing_ok=True)


def running_farm(store: Store) -> RunningFarm | None:
    """The farm that works on a store, if one of this user does on this machine."""
    farm = _read(_file(store))
    return None if farm is None or farm.space != process_space() or is_gone(farm.process) else farm


def _folder() -> Path:
    return Path(tempfile.gettempdir(), f"photonfarm-{os.getuid()}-farms")


def _file(store: Store) -> Path:
    return _folder() / f"{store.store_id}.json"


def _is_ours(folder: Path) -> bool:
    """Whether nobody else can have written into a folder."""
    about = folder.stat()
    return about.st_uid == os.getuid() and not about.st_mode & 0o077


def _read(file: Path) -> RunningFarm | None:
    try:
        return RunningFarm(**json.loads(file.read_text())) if _is_ours(file.parent) else None
    except (OSError, ValueError, TypeError):
        return None
