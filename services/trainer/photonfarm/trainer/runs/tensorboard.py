"""A run as TensorBoard shows it: event files beside metrics.jsonl, of the same records, and pictures now and then."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from photonfarm.shared.core.pictures import display
from photonfarm.shared.core.records import F32

FOLDER = "tensorboard"
SHOWN = 4  # pictures of one validation at most

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
"""What is drawn of a record of metrics.jsonl, and as what."""


class EventFiles:
    """Event files of one session of a run.

    What an earlier session wrote after the checkpoint that this one goes on from is taken out of the curves.
    """

    def __init__(self, folder: Path, *, writer: Any) -> None:
        self._folder, self._make = folder, writer
        self._writer: Any = None

    def record(self, record: dict[str, Any]) -> None:
        """Draw the figures of a record of metrics.jsonl."""
        step = record["step"]
        holds = record["kind"] in ("changes", "recovered", "end")  # what was shown of that step itself
        writer = self._from(step + holds)
        figures = {tag: record[name] for name, tag in NAMES.items() if isinstance(record.get(name), int | float)}
        figures |= {f"waits/{name}": share for name, share in record.get("waits", {}).items()}
        for tag, value in figures.items():
            writer.add_scalar(tag, value, step)
        writer.flush()

    def pictures(self, step: int, target: F32, prediction: F32) -> None:
        """Show targets (the means of A and B) above predictions, at most `SHOWN`, as clip(I, 0, 1)^(1/2.2)."""
        rows = [np.concatenate([display(image, 1.0) for image in images[:SHOWN]], 1) for images in (target, prediction)]
        self._from(step).add_image("held out/target above prediction", np.concatenate(rows), step, dataformats="HWC")

    def close(self) -> None:
        """Leave the files complete."""
        if self._writer is not None:
            self._writer.close()

    def _from(self, step: int) -> Any:
        """The writer; curves that exist end before the first step that is asked for."""
        if self._writer is None:
            self._writer = self._make(str(self._folder), purge_step=step)
        return self._writer


@contextmanager
def event_files(run: Path) -> Iterator[EventFiles | None]:
    """Event files in the folder `run`/tensorboard; None where TensorBoard is not installed."""
    if find_spec("tensorboard") is None:
        yield None
        return
    from torch.utils.tensorboard import SummaryWriter

    files = EventFiles(run / FOLDER, writer=SummaryWriter)
    try:
        yield files
    finally:
        files.close()
