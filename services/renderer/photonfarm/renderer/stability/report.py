"""The stability report: every hard scene rendered and judged, as Markdown, JSON and pictures."""

from __future__ import annotations

import gc
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from photonfarm.shared.pictures import Picture

from .case import HardScene, Refusal, Settings
from .pictures import keep, sheet, triple
from .rows import ROWS
from .runner import ROUNDING, SIGNIFICANCE, Outcome, Result, run

FAILURES = Path(".stability")
"""Where the renders of failures are kept."""

EYE_ALONE = (
    "Mesh lights with smooth vertex normals: no light path starts there and none is joined to them, hits alone find "
    "them, because Mitsuba converts their densities with the wrong cosine (row 24, smooth-mesh-light).",
    "Textured lights on shapes other than meshes and rectangles: hits alone (row 23, textured-ball-light).",
    "Emitters of types without emission sampling of ours, such as `sunsky`: next event estimation and hits (row 6, "
    "sun-and-sky).",
    "Cameras other than `perspective` and `thinlens`: with connections 0 and light ratio 0 (row 28, orthographic).",
)
REFUSED_ON_IMPORT = (
    "Scalar, spectral and polarised variants: “the integrator needs a vectorised, unpolarised RGB variant, because its "
    "loops are traced by Dr.Jit and its light paths carry neither wavelengths nor Mueller matrices”."
)


@dataclass(slots=True)
class Report:
    """What a run found."""

    results: list[Result] = field(default_factory=list)
    pictures: list[tuple[str, Picture]] = field(default_factory=list)  # label, triple of the first settings

    @property
    def passed(self) -> bool:
        """Whether nothing failed."""
        return not any(result.faults for result in self.results)

    def rows(self) -> dict[int, bool]:
        """Number → whether all scenes of the row passed with all settings."""
        verdicts: dict[int, bool] = {}
        for result in self.results:
            if result.row is not None:
                verdicts[result.row] = verdicts.get(result.row, True) and not result.faults
        return verdicts


def examine(
    items: Iterable[HardScene | Refusal], *, quick: bool, seed: int = 0, settings: Sequence[Settings] = (),
    failures: Path = FAILURES, tell: Callable[[str], None] = lambda _: None,
) -> Report:  # fmt: skip
    """Run the scenes (see `rows.chosen`), keep the renders of failures, tell of each as it is done."""
    report = Report()
    for item in items:
        for outcome in run(item, quick=quick, seed=seed, settings=settings):
            _add(report, outcome, failures, tell)
        gc.collect()  # the next scene's kernels are found in the cache only once this scene is gone
    return report


def _add(report: Report, outcome: Outcome, failures: Path, tell: Callable[[str], None]) -> None:
    result = outcome.result
    if outcome.renders is not None and result.label not in dict(report.pictures):
        report.pictures.append((result.label, triple(outcome.renders, result.z_limit or 1.0)))
    report.results.append(result)
    tell(f"{result.label} ({result.settings}): {result.verdict}")
    if result.faults:
        folder = keep(outcome, failures)
        tell(f"  {'; '.join(result.faults)}\n  again: {result.command}\n  renders: {folder}")


def write(report: Report, out: Path, command: str) -> None:
    """Write stability.md, stability.json and stability.png into a folder; `command` is what made them."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "stability.md").write_text(markdown(report, command), encoding="utf-8")
    (out / "stability.json").write_text(as_json(report, command), encoding="utf-8")
    if report.pictures:
        sheet(report.pictures).save(out / "stability.png")


def as_json(report: Report, command: str) -> str:
    """All results, one object for each scene and settings."""
    results = [asdict(result) | {"label": result.label, "verdict": result.verdict} for result in report.results]
    rows = report.rows()
    document = {
        "command": command, "rows_passed": sum(rows.values()), "rows_run": len(rows), "rows": ROWS,
        "significance": SIGNIFICANCE, "rounding": ROUNDING, "results": results,
    }  # fmt: skip
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


# ------------------------------------------------ Markdown ------------------------------------------------

_HEAD = (
    "| row | scene | truth | settings | z max (limit) | mean ratio | max/mean (truth) | NaN, inf | CPU s | verdict |\n"
    "|---|---|---|---|---|---|---|---|---|---|"
)


def markdown(report: Report, command: str) -> str:
    """The report as Markdown."""
    rows = report.rows()
    scenes: dict[str, list[Result]] = {}
    for result in report.results:
        scenes.setdefault(result.label, []).append(result)
    parts = [
        "# Stability of `bdpt` on hard scenes",
        f"**{sum(rows.values())} of {len(rows)} rows pass** (there are {ROWS}). Made by `{command}`, in "
        f"{sum(result.cpu_s for result in report.results):.0f} CPU seconds.",
        _RULE,
        "\n".join([_HEAD, *(_line(results) for results in scenes.values() if results[0].row)]),
        "![bdpt, truth and z of each scene](stability.png)" if report.pictures else "",
        _failures(report.results),
        "## What is hard\n\n"
        + "\n".join(f"- {s[0].label}: {s[0].hard}" for s in scenes.values() if s[0].z_max is not None),
        _unsupported([result for result in report.results if result.truth == "refusal"]),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


_RULE = (
    "A line stands for one scene with all its settings (connections, light paths per eye path), and shows the worst: "
    "the largest |z| of any block and of the whole image, the mean ratio (bdpt over truth) farthest from 1 in standard "
    "errors, the brightest pixel of any render over the mean. A scene passes if no value is NaN or infinite, no |z| "
    f"exceeds its limit (Šidák over the blocks; a right scene fails by chance with probability {SIGNIFICANCE:g} per "
    "settings), and the ratio's standard error is small enough for the test to mean something (the bound is in "
    f"brackets). Differences below {4.5 * ROUNDING:.2%} count as rounding. Each settings by itself: stability.json."
)


def _line(results: list[Result]) -> str:
    first = results[0]
    if first.z_limit is None:
        said = f"| {first.row} | {first.name} | {first.truth} | {first.settings}"
        return f"{said} | – | – | – | – | {first.cpu_s:.1f} | {first.verdict} |"
    z = max((r.z_max or 0.0) for r in results)
    furthest = max(results, key=_deviation)
    brightest = max((r.max_over_mean or 0.0) for r in results)
    verdict = "FAIL" if any(r.faults for r in results) else "pass"
    return (
        f"| {first.row} | {first.name} | {first.truth} | {' · '.join(r.settings for r in results)} "
        f"| {z:.2f} ({first.z_limit or 0:.2f}) | {_ratio(furthest)} "
        f"| {brightest:.3g} ({first.truth_max_over_mean or 0:.3g}) | {sum(r.nan for r in results)}, "
        f"{sum(r.inf for r in results)} | {sum(r.cpu_s for r in results):.1f} | {verdict} |"
    )


def _deviation(result: Result) -> float:
    if result.mean_ratio is None or result.mean_ratio_standard_error is None:
        return float("inf")
    return abs(result.mean_ratio - 1) / max(result.mean_ratio_standard_error, ROUNDING)


def _ratio(result: Result) -> str:
    if result.mean_ratio is None or result.mean_ratio_standard_error is None:
        return "unknown"
    return f"{result.mean_ratio:.4f} ± {result.mean_ratio_standard_error:.4f} (≤ {result.resolution:g})"


def _failures(results: Sequence[Result]) -> str:
    lines = [f"- {r.label} ({r.settings}): {'; '.join(r.faults)}. Again: `{r.command}`" for r in results if r.faults]
    return "## Failures\n\n" + "\n".join(lines) if lines else ""


def _unsupported(refusals: Sequence[Result]) -> str:
    said = [f"- {r.label}: “{r.hard}” ({r.verdict})" for r in refusals]
    refused = "## Refused\n\n" + "\n".join([*said, f"- {REFUSED_ON_IMPORT}"])
    return refused + "\n\n## Done from the eye alone\n\n" + "\n".join(f"- {sentence}" for sentence in EYE_ALONE)
