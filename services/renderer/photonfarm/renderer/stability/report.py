"""The stability report: every hard scene rendered and judged, as Markdown, JSON and pictures."""

from __future__ import annotations

import gc
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TypeVar

from photonfarm.shared.pictures import Picture
from photonfarm.shared.statistics import two_sided_limit

from .case import HardScene, Refusal, Settings
from .pictures import FULL_Z, keep, sheet, triple
from .rows import ROWS
from .runner import ROUNDING, SIGNIFICANCE, Outcome, Result, plus_minus, run

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


Key = TypeVar("Key", int, str)


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
        """Number → whether all of the row's scenes that were rendered passed, with all settings."""
        return _all_passed((result.row, result) for result in self.results if result.row is not None)

    def scenes(self) -> dict[str, bool]:
        """Label → whether the scene passed with all settings; one for each line of the table."""
        return _all_passed((result.label, result) for result in self.results if result.row is not None)


def _all_passed(results: Iterable[tuple[Key, Result]]) -> dict[Key, bool]:
    verdicts: dict[Key, bool] = {}
    for key, result in results:
        verdicts[key] = verdicts.get(key, True) and not result.faults
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
        report.pictures.append((result.label, triple(outcome.renders)))
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
    rows, scenes = report.rows(), report.scenes()
    document = {
        "command": command, "rows_passed": sum(rows.values()), "rows_run": len(rows), "rows": ROWS,
        "scenes_passed": sum(scenes.values()), "scenes_run": len(scenes),
        "significance": SIGNIFICANCE, "smallest_standard_error": ROUNDING, "results": results,
    }  # fmt: skip
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


# ------------------------------------------------ Markdown ------------------------------------------------

_HEAD = (
    "| row | scene | truth | settings | z max (limit) | mean ratio | would see | max/mean (truth) | NaN, inf | CPU s "
    "| verdict |\n"
    "|---|---|---|---|---|---|---|---|---|---|---|"
)


def markdown(report: Report, command: str) -> str:
    """The report as Markdown."""
    scenes: dict[str, list[Result]] = {}
    for result in report.results:
        scenes.setdefault(result.label, []).append(result)
    parts = [
        "# Stability of `bdpt` on hard scenes",
        f"{_verdict(report)} Made by `{command}`, in {sum(result.cpu_s for result in report.results):.0f} CPU seconds.",
        _RULE,
        "\n".join([_HEAD, *(_line(results) for results in scenes.values() if results[0].row)]),
        _PICTURES if report.pictures else "",
        _failures(report.results),
        "## What is hard\n\n"
        + "\n".join(f"- {s[0].label}: {s[0].hard}" for s in scenes.values() if s[0].z_max is not None),
        _unsupported([result for result in report.results if result.truth == "refusal"]),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


_RULE = (
    f"A row is one of the {ROWS} hard cases, tried by one scene or several; it passes if those of its scenes that were "
    "rendered pass. A line of the table is one scene with all its settings (connections, light paths per eye path), "
    "and shows the worst: the largest |z| of any block and of the whole image, the mean ratio (bdpt over truth) "
    "farthest from 1 in standard errors, the brightest pixel of any render over the mean. A scene passes if no value "
    "is NaN or infinite, no |z| exceeds its limit (Šidák over the blocks; a right scene fails by chance with "
    f"probability {SIGNIFICANCE:g} per settings), and the ratio's standard error is small enough for the test to mean "
    "something (the bound is in brackets). **Would see**: the bias, as part of the mean, from which on the image "
    "fails, and that of its worst block, which is large where little light, or light seldom, comes to a block. In z, a "
    f"standard error below {ROUNDING:.2%} of the mean counts as {ROUNDING:.2%}, since Mitsuba's ray offsets and "
    "float32 sums are no more exact (in row 1 `path` itself is off by "
    f"0.07%): no difference below {two_sided_limit(SIGNIFICANCE) * ROUNDING:.3%} fails, however little noise there is. "
    "Each settings by itself: stability.json."
)
_PICTURES = (
    "Each scene with its first settings: bdpt's mean image, the truth, and z of each block: white where they agree, "
    f"red where bdpt is brighter, blue where it is darker, in full colour from |z| = {FULL_Z:g} on.\n\n"
    "![bdpt | truth | z of each scene](stability.png)"
)


def _verdict(report: Report) -> str:
    """How many rows and scenes pass; refusals that have no row are counted by themselves."""
    rows, scenes = report.rows(), report.scenes()
    others = [not result.faults for result in report.results if result.row is None]
    parts = [f"**{sum(rows.values())} of {len(rows)} rows pass**, {sum(scenes.values())} of {len(scenes)} scenes"]
    parts += [f"and {sum(others)} of {len(others)} further refusals"] if others else []
    tried = "" if len(rows) == ROWS else f" There are {ROWS} rows; the others were not tried."
    return f"{' '.join(parts)}.{tried}"


def _line(results: list[Result]) -> str:
    first = results[0]
    if first.z_limit is None:
        said = f"| {first.row} | {first.name} | {first.truth} | {first.settings}"
        return f"{said} | – | – | – | – | – | {first.cpu_s:.1f} | {first.verdict} |"
    z = max((r.z_max or 0.0) for r in results)
    furthest = max(results, key=_deviation)
    brightest = max((r.max_over_mean or 0.0) for r in results)
    verdict = "FAIL" if any(r.faults for r in results) else "pass"
    return (
        f"| {first.row} | {first.name} | {first.truth} | {' · '.join(r.settings for r in results)} "
        f"| {z:.2f} ({first.z_limit or 0:.2f}) | {_ratio(furthest)} "
        f"| {_seen([r.seen_bias for r in results])}, {_seen([r.seen_block_bias for r in results])} "
        f"| {brightest:.3g} ({first.truth_max_over_mean or 0:.3g}) | {sum(r.nan for r in results)}, "
        f"{sum(r.inf for r in results)} | {sum(r.cpu_s for r in results):.1f} | {verdict} |"
    )


def _seen(biases: Sequence[float | None]) -> str:
    """The worst of some biases that would be seen."""
    return "unknown" if None in biases else f"{max(bias for bias in biases if bias is not None):.2g}"


def _deviation(result: Result) -> float:
    if result.mean_ratio is None or result.mean_ratio_standard_error is None:
        return float("inf")
    return abs(result.mean_ratio - 1) / max(result.mean_ratio_standard_error, ROUNDING)


def _ratio(result: Result) -> str:
    if result.mean_ratio is None or result.mean_ratio_standard_error is None:
        return "unknown"
    return f"{plus_minus(result.mean_ratio, result.mean_ratio_standard_error)} (≤ {result.resolution:g})"


def _failures(results: Sequence[Result]) -> str:
    lines = [f"- {r.label} ({r.settings}): {'; '.join(r.faults)}. Again: `{r.command}`" for r in results if r.faults]
    return "## Failures\n\n" + "\n".join(lines) if lines else ""


def _unsupported(refusals: Sequence[Result]) -> str:
    said = [f"- {r.label}: “{r.hard}” ({r.verdict})" for r in refusals]
    refused = "## Refused\n\n" + "\n".join([*said, f"- {REFUSED_ON_IMPORT}"])
    return refused + "\n\n## Done from the eye alone\n\n" + "\n".join(f"- {sentence}" for sentence in EYE_ALONE)
