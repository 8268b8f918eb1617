"""A run in TensorBoard: event files beside metrics.jsonl, with the same records, and pictures at validations."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from photonfarm.core.pictures import display
from photonfarm.core.records import F32

FOLDER = "tensorboard"
SHOWN = 4  # the most pictures of one validation

NAMES = {
    "loss": "loss/training",
    "rate": "optimiser/rate",
    "rate_factor": "optimiser/rate factor",
    "error": "error/held out",
    "standard_error": "error/standard error",
    "shown_error": "error/held out, light up to white",
    "noise_floor": "error/noise of the targets",
    "samples": "samples/arrived",
    "draws": "samples/drawn",
    "samples_per_used": "samples/arrived for each used",
}
"""The names of curves, by the keys of records in metrics.jsonl."""


class EventFiles:
    """The event files of one session of a run.

    Events of an earlier session after the checkpoint that this one resumes from are removed from the curves.
    """

    def __init__(self, folder: Path, *, writer: Any) -> None:
        self._folder, self._make = folder, writer
        self._writer: Any = None

    def record(self, record: dict[str, Any]) -> None:
        """Add the figures of a record of metrics.jsonl."""
        step = record["step"]
        writer = self._begin(step + (record["kind"] in ("changes", "recovered", "end")))  # what was shown of it stays
        figures = {tag: record[name] for name, tag in NAMES.items() if isinstance(record.get(name), int | float)}
        figures |= {f"waits/{name}": share for name, share in record.get("waits", {}).items()}
        for tag, value in figures.items():
            writer.add_scalar(tag, value, step)
        writer.flush()

    def pictures(self, step: int, target: F32, prediction: F32) -> None:
        """Add targets (the means of A and B) above predictions, at most `SHOWN`, as clip(I, 0, 1)^(1/2.2)."""
        rows = [np.concatenate([display(image, 1.0) for image in images[:SHOWN]], 1) for images in (target, prediction)]
        writer = self._begin(step)
        writer.add_image("held out/target above prediction", np.concatenate(rows), step, dataformats="HWC")

    def _begin(self, step: int) -> Any:
        """The writer; existing curves are cut before the first step that is written."""
        if self._writer is None:
            self._writer = self._make(str(self._folder), purge_step=step)
        return self._writer

    def close(self) -> None:
        """Close the files, complete."""
        if self._writer is not None:
            self._writer.close()


@contextmanager
def open_event_files(run: Path) -> Iterator[EventFiles | None]:
    """Event files in the folder `run`/tensorboard; None if TensorBoard is not installed."""
    if find_spec("tensorboard") is None:
        yield None
        return
    from torch.utils.tensorboard import SummaryWriter

    with closing(EventFiles(run / FOLDER, writer=SummaryWriter)) as files:
        yield files
