"""The report of one or several runs on one store: report.html, a page that needs nothing else, and report.json.

Its plots and the pictures side by side lie beside it too.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Unpack

from photonfarm.core.errors import store_errors
from photonfarm.core.files import make_folder
from photonfarm.core.page import write_page
from photonfarm.core.pictures import write_png
from photonfarm.trainer.compare.evaluate import MeasureOptions
from photonfarm.trainer.compare.evaluation_page import COMPARISON, draw_comparison
from photonfarm.trainer.predictors.trained import TrainedRun
from photonfarm.trainer.report.contents import gather_contents
from photonfarm.trainer.report.page import Verdict, format_page
from photonfarm.trainer.report.plots import draw_plots
from photonfarm.trainer.report.views import choose_views


def write_report(
    store: str | Path, runs: Sequence[Path], out: Path, *, timed: bool = True, **how: Unpack[MeasureOptions]
) -> dict[str, Any]:
    """Write the report of the runs into the folder `out`; returns the figures of report.json.

    Runs and denoisers are measured as by `compare`, and the times of frames if `timed`. Raises SpecError if the runs
    cannot be compared, StoreError if a folder is not a run with a readable checkpoint, for a store that cannot be read
    or if `out` cannot be written, IncompleteError if nothing is held out.
    """
    loaded = [TrainedRun.load(run) for run in runs]
    make_folder(out, "write the report")
    contents = gather_contents(store, loaded, timed=timed, **how)
    if on_progress := how.get("on_progress"):
        on_progress("plots and pages are drawn", 0, 0)
    plots, verdict = draw_plots(contents), Verdict.of(contents)
    text = json.dumps({**contents.document(), "verdict": verdict.sentence}, indent=2, ensure_ascii=False)
    with store_errors("write the report", out):
        for plot in (plot for group in plots for plot in group.plots):
            (out / f"{plot.name}.svg").write_bytes(plot.svg)
        (out / "report.json").write_text(text + "\n")
    write_page(out / "report.html", format_page(contents, verdict, choose_views(contents), plots))
    write_png(draw_comparison(contents.evaluation), out / COMPARISON)
    document: dict[str, Any] = json.loads(text)
    return document
