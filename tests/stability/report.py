"""The stability report: every hard scene rendered and judged, as Markdown, JSON and pictures."""

from __future__ import annotations

import gc
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TypeVar

from photonfarm.core.pictures import Picture
from tests.stability.markdown import markdown as markdown
from tests.stability.pictures import keep, sheet, triple
from tests.stability.rows import ROWS
from tests.stability.runner import ROUNDING, SIGNIFICANCE, SceneOutcome, SceneResult, run
from tests.stability.scenes.case import BdptSettings, HardScene, Refusal

Label = TypeVar("Label", int, str)


@dataclass(slots=True)
class StabilityReport:
    """The results of a run."""

    results: list[SceneResult] = field(default_factory=list)
    pictures: list[tuple[str, Picture]] = field(default_factory=list)  # label, triple of the first settings

    @property
    def passed(self) -> bool:
        """Whether nothing failed."""
        return not any(result.faults for result in self.results)

    def rows(self) -> dict[int, bool]:
        """Whether each row passed, by number: all of its scenes that were rendered, with all settings."""
        return _all_passed((result.row, result) for result in self.results if result.row is not None)

    def scenes(self) -> dict[str, bool]:
        """Whether each scene passed with all settings, by label; one for each line of the table."""
        return _all_passed((result.label, result) for result in self.results if result.row is not None)


def _all_passed(results: Iterable[tuple[Label, SceneResult]]) -> dict[Label, bool]:
    verdicts: dict[Label, bool] = {}
    for key, result in results:
        verdicts[key] = verdicts.get(key, True) and not result.faults
    return verdicts


def examine(
    items: Iterable[HardScene | Refusal],
    *,
    quick: bool,
    seed: int,
    settings: Sequence[BdptSettings],
    failures: Path,
    log: Callable[[str], None],
) -> StabilityReport:
    """Run the scenes (see `rows.chosen`), keep the renders of failures in a folder, and log each when it is done."""
    report = StabilityReport()
    for item in items:
        for outcome in run(item, quick=quick, seed=seed, settings=settings):
            _add(report, outcome, failures, log)
        gc.collect()  # Dr.Jit finds the next scene's kernels in its cache only once this scene is gone
    return report


def _add(report: StabilityReport, outcome: SceneOutcome, failures: Path, log: Callable[[str], None]) -> None:
    result = outcome.result
    if outcome.renders is not None and result.label not in dict(report.pictures):
        report.pictures.append((result.label, triple(outcome.renders)))
    report.results.append(result)
    log(f"{result.label} ({result.settings}): {result.verdict}")
    if result.faults:
        folder = keep(outcome, failures)
        log(f"  {'; '.join(result.faults)}\n  again: {result.command}\n  renders: {folder}")


def write(report: StabilityReport, out: Path, command: str) -> None:
    """Write stability.md, stability.json and stability.png into a folder; `command` is the command that made them."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "stability.md").write_text(markdown(report, command), encoding="utf-8")
    (out / "stability.json").write_text(as_json(report, command), encoding="utf-8")
    if report.pictures:
        sheet(report.pictures).quantize(256).save(out / "stability.png", optimize=True)


def as_json(report: StabilityReport, command: str) -> str:
    """All results, one object for each scene and settings."""
    results = [asdict(result) | {"label": result.label, "verdict": result.verdict} for result in report.results]
    rows, scenes = report.rows(), report.scenes()
    document = {
        "command": command,
        "rows_passed": sum(rows.values()),
        "rows_run": len(rows),
        "rows": ROWS,
        "scenes_passed": sum(scenes.values()),
        "scenes_run": len(scenes),
        "significance": SIGNIFICANCE,
        "smallest_standard_error": ROUNDING,
        "results": results,
    }
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
