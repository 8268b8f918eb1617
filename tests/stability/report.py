"""The stability report: every hard scene rendered and judged, as Markdown, JSON and pictures.

Shape letters: K renders, H W image, B blocks.
"""

from __future__ import annotations

import gc
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from photonfarm.core.pictures import Picture, display
from tests.stability.rows import ROWS
from tests.stability.runner import ROUNDING, SIGNIFICANCE, Renders, SceneOutcome, SceneResult, plus_minus, run
from tests.stability.scenes.case import BdptSettings, HardScene, Refusal

Key = TypeVar("Key", int, str)


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


def _all_passed(results: Iterable[tuple[Key, SceneResult]]) -> dict[Key, bool]:
    verdicts: dict[Key, bool] = {}
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
    """Run the scenes (see `rows.choose`), keep the renders of failures in a folder, and log each when it is done."""
    report = StabilityReport()
    for item in items:
        for outcome in run(item, quick=quick, seed=seed, settings=settings):
            result = outcome.result
            if outcome.renders is not None and result.label not in dict(report.pictures):
                report.pictures.append((result.label, triple(outcome.renders)))
            report.results.append(result)
            log(f"{result.label} ({result.settings}): {result.verdict}")
            if result.faults:
                folder = keep(outcome, failures)
                log(f"  {'; '.join(result.faults)}\n  again: {result.command}\n  renders: {folder}")
        gc.collect()  # Dr.Jit finds the next scene's kernels in its cache only once this scene is gone
    return report


def write(report: StabilityReport, out: Path, command: str) -> None:
    """Write stability.md, stability.json and stability.png into a folder; `command` is the command that made them."""
    out.mkdir(parents=True, exist_ok=True)
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
        "results": [asdict(result) | {"verdict": result.verdict} for result in report.results],
    }
    text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False)
    (out / "stability.md").write_text(markdown(report, command), encoding="utf-8")
    (out / "stability.json").write_text(text + "\n", encoding="utf-8")
    if report.pictures:
        sheet(report.pictures).quantize(256).save(out / "stability.png", optimize=True)


# ------------------------------------------------ Markdown ------------------------------------------------


_COLUMNS = [
    *("row", "scene", "truth", "settings", "z max (limit)", "mean ratio (bound)"),
    *("max/mean (truth)", "not finite", "CPU s", "verdict"),
]
_HEAD = f"| {' | '.join(_COLUMNS)} |\n|{'---|' * len(_COLUMNS)}"
_RULE = f"""\
A row is one of the {ROWS} hard cases, tried by one scene or several; it passes if those of its scenes that were
rendered pass. A line of the table is one scene with all its settings, and shows the worst of them (each by itself:
stability.json). Its columns:

- **truth**: what `bdpt` is compared with: a formula, a number, or the integrator that renders it.
- **settings**: connections, light paths per eye path.
- **z max (limit)**: the largest difference of a block's mean, or the whole image's, in standard errors of at least
  {ROUNDING:.2%} of the mean. A right scene exceeds the limit by chance with probability {SIGNIFICANCE:g} per settings.
- **mean ratio (bound)**: mean of `bdpt` over that of the truth, ± one standard error, of the settings that are farthest
  from 1. The bound is for the standard error: above it the test would mean nothing, and fails.
- **max/mean (truth)**: brightest pixel of any render over the mean of the image; the same of the truth.
- **not finite**: how many values of all renders are NaN or infinite; a scene passes with none.
- **CPU s**: CPU seconds of all that is rendered for the line."""


def markdown(report: StabilityReport, command: str) -> str:
    """The report as Markdown: verdict, table, pictures, failures, hard cases and refusals."""
    scenes: dict[str, list[SceneResult]] = {}
    for result in report.results:
        scenes.setdefault(result.label, []).append(result)
    failures = [f"- {r.label} ({r.settings}): {'; '.join(r.faults)}. Again: `{r.command}`" for r in report.results]
    failed = [line for line, r in zip(failures, report.results, strict=True) if r.faults]
    hard = [f"- {label}: {results[0].hard}" for label, results in scenes.items() if results[0].truth != "refusal"]
    refused = [f"- {r.label}: “{r.hard}” ({r.verdict})" for r in report.results if r.truth == "refusal"]
    sections = {"## Failures": failed, "## What is hard": hard, "## Refused": refused}
    pictures = (
        "Each scene with its first settings: bdpt's mean, the truth, and z of each block: white where they agree, "
        f"red where bdpt is brighter, blue where it is darker, in full colour from |z| = {FULL_Z:g} on.\n\n"
        "![bdpt | truth | z of each scene](stability.png)"
    )
    parts = [
        "# Stability of `bdpt` on hard scenes",
        f"{_verdict(report)} Made by `{command}`, in {sum(result.cpu_s for result in report.results):.0f} CPU seconds.",
        _RULE,
        "\n".join([_HEAD, *(_line(results) for results in scenes.values() if results[0].row)]),
        pictures if report.pictures else "",
        *("\n\n".join([head, "\n".join(lines)]) if lines else "" for head, lines in sections.items()),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _verdict(report: StabilityReport) -> str:
    """The numbers of rows and scenes that pass, and separately of refused scenes that belong to no row."""
    rows, scenes = report.rows(), report.scenes()
    others = [not result.faults for result in report.results if result.row is None]
    parts = [f"**{sum(rows.values())} of {len(rows)} rows pass**, {sum(scenes.values())} of {len(scenes)} scenes"]
    parts += [f"and {sum(others)} of {len(others)} further refusals"] if others else []
    tried = "" if len(rows) == ROWS else f" There are {ROWS} rows; the others were not tried."
    return f"{' '.join(parts)}.{tried}"


def _line(results: list[SceneResult]) -> str:
    first = results[0]
    cells = [str(first.row), first.label.partition("-")[2], first.truth, " · ".join(r.settings for r in results)]
    if first.z_limit is None:
        cells += ["–"] * 4
    else:
        worst = max(results, key=_deviation)
        ratio = "unknown"
        if worst.mean_ratio is not None and worst.mean_ratio_standard_error is not None:
            ratio = f"{plus_minus(worst.mean_ratio, worst.mean_ratio_standard_error)} (≤ {worst.resolution:g})"
        brightest = max(r.max_over_mean or 0.0 for r in results)
        cells += [
            f"{max(r.z_max or 0.0 for r in results):.2f} ({first.z_limit:.2f})",
            ratio,
            f"{brightest:.3g} ({first.truth_max_over_mean or 0:.3g})",
            str(sum(r.not_finite for r in results)),
        ]
    verdict = "FAIL" if any(r.faults for r in results) else "pass"
    return f"| {' | '.join([*cells, f'{sum(r.cpu_s for r in results):.1f}', verdict])} |"


def _deviation(result: SceneResult) -> float:
    if result.mean_ratio is None or result.mean_ratio_standard_error is None:
        return float("inf")
    return abs(result.mean_ratio - 1) / max(result.mean_ratio_standard_error, ROUNDING)


# ------------------------------------------------ Pictures ------------------------------------------------

SIDE = 96
"""The pixels of one picture's side on the sheet."""
FULL_Z = 5.0
"""The |z| that is shown in full colour; the limits lie a little above."""
_LABEL, _GAP, _COLUMNS_OF_SHEET = 14, 8, 3
_WIDTH, _HEIGHT = 3 * SIDE + _GAP, SIDE + _LABEL + _GAP  # of a labelled triple


def triple(renders: Renders) -> Picture:
    """(SIDE, 3·SIDE, 3): the mean of bdpt, the truth, and the blocks' z (red: bdpt is brighter, blue: darker)."""
    from PIL import Image

    bdpt, truth = (np.mean(images, axis=0).astype(np.float32) for images in (renders.bdpt, renders.truth))
    exposure = 0.9 / max(float(np.percentile(truth, 98)), 1e-12)
    parts = (display(bdpt, exposure), display(truth, exposure), of_z(renders.z))
    resized = [np.asarray(Image.fromarray(part).resize((SIDE, SIDE), Image.Resampling.NEAREST)) for part in parts]
    return np.concatenate(resized, axis=1)


def of_z(z: npt.NDArray[np.float64]) -> Picture:
    """Colours (…, 3) of z (…): white at 0, full red at `FULL_Z`, full blue at −`FULL_Z`, black for NaN."""
    strength = np.clip(np.nan_to_num(z) / FULL_Z, -1, 1)
    red, blue = np.maximum(strength, 0), np.maximum(-strength, 0)
    colours = np.round(255 * np.stack([1 - blue, 1 - red - blue, 1 - red], axis=-1)).astype(np.uint8)
    colours[np.isnan(z)] = 0
    return colours


def sheet(outcomes: Sequence[tuple[str, Picture]]) -> Any:
    """One image (PIL): all labelled triples in reading order."""
    from PIL import Image, ImageDraw

    lines = -(-len(outcomes) // _COLUMNS_OF_SHEET)
    whole = Image.new("RGB", (_COLUMNS_OF_SHEET * _WIDTH, max(lines, 1) * _HEIGHT), "white")
    draw = ImageDraw.Draw(whole)
    for k, (label, picture) in enumerate(outcomes):
        x, y = k % _COLUMNS_OF_SHEET * _WIDTH, k // _COLUMNS_OF_SHEET * _HEIGHT
        draw.text((x, y), label, fill="black")
        whole.paste(Image.fromarray(picture), (x, y + _LABEL))
    return whole


def keep(outcome: SceneOutcome, folder: Path) -> Path:
    """Write the renders [K, H, W, 3] as .npy and the triple as .png into a folder of this outcome; returns it."""
    from PIL import Image

    own = folder / f"{outcome.result.label}_{outcome.result.settings}"
    own.mkdir(parents=True, exist_ok=True)
    if outcome.renders is not None:
        np.save(own / "bdpt.npy", outcome.renders.bdpt)
        np.save(own / "truth.npy", outcome.renders.truth)
        Image.fromarray(triple(outcome.renders)).save(own / "bdpt_truth_z.png")
    (own / "result.txt").write_text(f"{outcome.result}\n", encoding="utf-8")
    return own
