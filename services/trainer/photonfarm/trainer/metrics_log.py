"""metrics.jsonl: one record a line, appended as training goes."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import takewhile
from pathlib import Path
from typing import Any

from photonfarm.shared.store import store_errors


class MetricsLog:
    """The log of one run. `listen` gets each record as it is written; StoreError where it cannot be."""

    def __init__(self, path: Path, listen: Callable[[dict[str, Any]], object] | None = None) -> None:
        self._path, self._listen = path, listen

    def cut(self, step: int) -> None:
        """Drop what was logged after the checkpoint of `step`; the run that continues from there writes it again.

        What stays is renamed into place, so that whoever reads along finds a whole file under this name. A training
        record of `step` itself was written before the checkpoint and stays, a validation after it.
        """
        with store_errors("cut the log", self._path):
            lines = self._path.read_bytes().splitlines(keepends=True) if self._path.exists() else []
            kept = list(takewhile(lambda line: line.endswith(b"\n") and not _is_after(json.loads(line), step), lines))
            if len(kept) < len(lines):
                partial = self._path.with_suffix(".partial")
                partial.write_bytes(b"".join(kept))
                partial.replace(self._path)

    def write(self, kind: str, **values: Any) -> None:
        """Append a record."""
        record = {"kind": kind, **values}
        with store_errors("write the log", self._path), self._path.open("ab") as file:
            file.write(json.dumps(record).encode() + b"\n")
        if self._listen:
            self._listen(record)


def _is_after(record: dict[str, Any], step: int) -> bool:
    return record["step"] > step or (record["step"] == step and record["kind"] != "train")


def read(path: Path) -> list[dict[str, Any]]:
    """The whole records of a log, in order; a last line cut short by a crash is left out."""
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_bytes().splitlines(keepends=True) if line.endswith(b"\n")]
