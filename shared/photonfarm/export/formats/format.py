"""What a format is: how samples become a file, and what describes all files of a folder."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from photonfarm.core.errors import StoreError
from photonfarm.export.columns import Contents
from photonfarm.export.manifest import Manifest
from photonfarm.export.settings import FormatName
from photonfarm.export.snapshot import Snapshot, Values


@dataclass(frozen=True, slots=True)
class Exported:
    """An export whose files of samples are written."""

    folder: Path
    snapshot: Snapshot
    contents: Contents
    manifest: Manifest


class Format(Protocol):
    """One of the formats; each is a module of this folder."""

    SUFFIX: str  # of its files
    PACKAGES: Sequence[str]  # modules that it needs, of the extra `export`
    ONE_PER_FILE: bool | None  # True, False: always one sample, always several in a file; None: as is asked, or one

    @staticmethod
    def write(file: Path, samples: Iterator[Values], contents: Contents) -> None:
        """Write samples into a file, which appears whole. Raises StoreError if the disk refuses."""

    @staticmethod
    def finish(exported: Exported) -> None:
        """Write what describes all files of the folder."""


_MODULES: dict[FormatName, str] = {"webdataset": "tar_shards", "exr": "exr", "npz": "npz", "parquet": "parquet"}


def format_named(name: FormatName) -> Format:
    """A format by its name; raises StoreError if a package that it needs is not installed."""
    found: Any = import_module(f"{__package__}.{_MODULES[name]}")
    for package in found.PACKAGES:
        try:
            import_module(package)
        except ModuleNotFoundError as error:
            raise StoreError(f"--to {name}: needs the package {package}; pip install 'photonfarm[export]'") from error
    return found


def nothing_more(_: Exported) -> None:
    """The `finish` of a format that describes itself."""
