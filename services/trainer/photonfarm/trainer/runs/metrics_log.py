"""metrics.jsonl: one record a line, appended during training."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from photonfarm.core.errors import StoreError, store_errors


class MetricsLog:
    """The log of one run. `on_record` is called with each record as it is written; StoreError if the disk refuses."""

    def __init__(self, path: Path, on_record: Callable[[dict[str, Any]], object] | None = None) -> None:
        self._path, self._on_record = path, on_record

    def cut(self, step: int) -> list[dict[str, Any]]:
        """Drop the records after the checkpoint of `step`, which a resumed run writes again.

        Returns the records that stay. They are renamed into place, so that a concurrent reader always finds a whole
        file. A training record of `step` itself was written before the checkpoint, and so was everything up to an end
        there; a validation or a change of settings without an end after it was written after the checkpoint.
        """
        with store_errors("cut the log", self._path):
            lines = _lines(self._path)
            records = [_record(line, self._path) for line in lines if line.endswith(b"\n")]
            ends = [i + 1 for i, record in enumerate(records) if (record["step"], record["kind"]) == (step, "end")]
            kept = max(ends, default=0)
            while kept < len(records) and not _is_after(records[kept], step):
                kept += 1
            if kept < len(lines):
                partial = self._path.with_suffix(".partial")
                partial.write_bytes(b"".join(lines[:kept]))
                partial.replace(self._path)
            return records[:kept]

    def write(self, kind: str, **values: Any) -> None:
        """Append a record."""
        record = {"kind": kind, **values}
        with store_errors("write the log", self._path), self._path.open("ab") as file:
            file.write(json.dumps(record).encode() + b"\n")
        if self._on_record:
            self._on_record(record)


def _is_after(record: dict[str, Any], step: int) -> bool:
    return record["step"] > step or (record["step"] == step and record["kind"] != "train")


def _lines(path: Path) -> list[bytes]:
    return path.read_bytes().splitlines(keepends=True) if path.exists() else []


def _record(line: bytes, path: Path) -> dict[str, Any]:
    try:
        record: dict[str, Any] = json.loads(line)
        _ = record["step"], record["kind"]
        return record
    except (ValueError, KeyError, TypeError) as error:
        raise StoreError(
            f"{path}: holds the line {line[:40]!r}, which is not a record of a training run; remove that line"
        ) from error


def read(path: Path) -> list[dict[str, Any]]:
    """The whole records of a log, in order; a last line cut short by a crash is left out. Raises StoreError."""
    with store_errors("read the log", path):
        return [_record(line, path) for line in _lines(path) if line.endswith(b"\n")]
