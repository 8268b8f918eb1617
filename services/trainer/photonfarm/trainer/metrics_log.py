"""metrics.jsonl: one record a line, appended as training goes."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self


class MetricsLog:
    """The log of one run; a context manager. `listen` gets each record as it is written."""

    def __init__(self, path: Path, listen: Callable[[dict[str, Any]], None] | None = None) -> None:
        self._path, self._listen = path, listen

    def __enter__(self) -> Self:
        self._file = self._path.open("ab")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def cut(self, step: int) -> None:
        """Drop what was logged after the checkpoint of `step`; the run that continues from there writes it again.

        Cut in place: others may be reading along. A training record of `step` itself was written before the
        checkpoint and stays, a validation after it.
        """
        kept = 0
        for line in self._path.read_bytes().splitlines(keepends=True):
            if not line.endswith(b"\n") or _is_after(json.loads(line), step):
                break
            kept += len(line)
        self._file.truncate(kept)

    def write(self, kind: str, **values: Any) -> None:
        """Append a record and flush it."""
        record = {"kind": kind, **values}
        self._file.write(json.dumps(record).encode() + b"\n")
        self._file.flush()
        if self._listen:
            self._listen(record)


def _is_after(record: dict[str, Any], step: int) -> bool:
    return record["step"] > step or (record["step"] == step and record["kind"] != "train")


def read(path: Path) -> list[dict[str, Any]]:
    """The whole records of a log, in order; a last line cut short by a crash is left out."""
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_bytes().splitlines(keepends=True) if line.endswith(b"\n")]
