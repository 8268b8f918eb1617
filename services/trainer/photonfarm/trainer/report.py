"""The report of a run: report.json with its figures, report.html with its curves and pictures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from photonfarm.shared.store import Store, store_errors
from photonfarm.trainer import checkpoint
from photonfarm.trainer.figures import production, run_figures, summary, validations
from photonfarm.trainer.loop import CHECKPOINT, read_settings
from photonfarm.trainer.page import page
from photonfarm.trainer.store_source import StoreSource


def write_report(store: str | Path, run: Path, out: Path) -> dict[str, Any]:
    """Write report.html and report.json of a run into the folder `out`; returns the figures of the latter.

    Both the untrained and the last network are evaluated, on the held-out samples that the store now has, the
    first 512 if there are more. Raises SpecError if `run` is not a run, StoreError without a readable checkpoint or
    store or if `out` cannot be written, IncompleteError if nothing is held out.
    """
    settings = read_settings(run)
    scene_id = checkpoint.load(run / CHECKPOINT)["scene_id"]
    found = run_figures(StoreSource(Store(store).root, scene_id), settings, run)
    figures = summary(settings, run, found, production(store, scene_id))
    with store_errors("write the report", out):
        out.mkdir(parents=True, exist_ok=True)
        (out / "report.json").write_text(json.dumps(figures, indent=2, ensure_ascii=False) + "\n")
        (out / "report.html").write_text(page(figures, validations(run), found.shown))
    return figures
