"""The stability report as Markdown: verdict, table, pictures, hard cases and refusals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from photonfarm.core.statistics import two_sided_limit
from tests.stability.pictures import FULL_Z
from tests.stability.rows import ROWS
from tests.stability.runner import ROUNDING, SIGNIFICANCE, SceneResult, plus_minus

if TYPE_CHECKING:
    from tests.stability.report import StabilityReport

EYE_ALONE = (
    "Mesh lights with smooth vertex normals: no light path starts there and none is joined to them, hits alone find "
    "them, because Mitsuba converts their densities with the wrong cosine (row 24, smooth-mesh-light).",
    "Textured mesh lights whose faces share texels, and mirrored cylinder lights: hits alone, because Mitsuba samples "
    "one of the faces, or the wrong side.",
    "Textured lights on shapes other than meshes and rectangles: hits alone (row 23, textured-ball-light).",
    "Emitters of types without emission sampling of ours, such as `sunsky`: next event estimation and hits (row 6, "
    "sun-and-sky).",
    "Cameras other than `perspective` and `thinlens`: with connections 0 and light ratio 0 (row 28, orthographic).",
)
REFUSED_ON_IMPORT = (
    "Scalar, spectral and polarised variants: “the integrator needs a vectorised, unpolarised RGB variant, because its "
    "loops are traced by Dr.Jit and its light paths carry neither wavelengths nor Mueller matrices”."
)

_COLUMNS = (
    "row",
    "scene",
    "truth",
    "settings",
    "z max (limit)",
    "mean ratio (bound)",
    "path ratio",
    "would see: image, worst block",
    "max/mean (truth)",
    "NaN, inf",
    "CPU s",
    "verdict",
)
_HEAD = f"| {' | '.join(_COLUMNS)} |\n|{'---|' * len(_COLUMNS)}"


def markdown(report: StabilityReport, command: str) -> str:
    """The report as Markdown."""
    scenes: dict[str, list[SceneResult]] = {}
    for result in report.results:
        scenes.setdefault(result.label, []).append(result)
    parts = [
        "# Stability of `bdpt` on hard scenes",
        f"{_verdict(report)} Made by `{command}`, in {sum(result.cpu_s for result in report.results):.0f} CPU seconds.",
        _RULE,
        "\n".join([_HEAD, *(_line(results) for results in scenes.values() if results[0].row)]),
        _PICTURES if report.pictures else "",
        _rounded([results for results in scenes.values() if any(map(_is_rounding, results))]),
        _failures(report.results),
        _hard(report.results),
        _unsupported([result for result in report.results if result.truth == "refusal"]),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


_FLOOR = two_sided_limit(SIGNIFICANCE) * ROUNDING
_RULE = f"""\
A row is one of the {ROWS} hard cases, tried by one scene or several; it passes if those of its scenes that were
rendered pass. A line of the table is one scene with all its settings, and shows the worst of them (each by itself:
stability.json). Its columns:

- **truth**: what `bdpt` is compared with. A formula or a number is exact, the name of an integrator is a render.
- **settings**: connections, light paths per eye path.
- **z max (limit)**: the largest difference of a block's mean, or the whole image's, in standard errors. A right scene
  exceeds the limit by chance with probability {SIGNIFICANCE:g} per settings (Šidák over the blocks). A standard error
  below {ROUNDING:.2%} of the mean counts as {ROUNDING:.2%}, since Mitsuba's ray offsets and float32 sums are no more
  exact: no difference of the image's mean below {_FLOOR:.3%} fails, however little noise there is.
- **mean ratio (bound)**: mean of `bdpt` over that of the truth, ± one standard error, of the settings that are farthest
  from 1 in standard errors (of {ROUNDING:.2%} at least). The bound is for the standard error: above it the test would
  mean nothing, and fails. ° marks what differs by more than noise and passes as rounding.
- **path ratio**: the same of Mitsuba's `path`, where the truth is exact: what rounding alone does there.
- **would see**: the least bias that fails, in % of the mean radiance of the image, and of its worst block; the latter
  is large where little light, or light seldom, comes to a block.
- **max/mean (truth)**: brightest pixel of any render over the mean of the image; the same of the truth.
- **NaN, inf**: how many values of all renders are not finite; a scene passes with none.
- **CPU s**: CPU seconds of all that is rendered for the line."""
_PICTURES = (
    "Each scene with its first settings: bdpt's mean image, the truth, and z of each block: white where they agree, "
    f"red where bdpt is brighter, blue where it is darker, in full colour from |z| = {FULL_Z:g} on.\n\n"
    "![bdpt | truth | z of each scene](stability.png)"
)


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
    if first.z_limit is None:
        head = f"| {first.row} | {first.name} | {first.truth} | {first.settings}"
        return f"{head} | – | – | – | – | – | – | {first.cpu_s:.1f} | {first.verdict} |"
    z = max((r.z_max or 0.0) for r in results)
    brightest = max((r.max_over_mean or 0.0) for r in results)
    verdict = "FAIL" if any(r.faults for r in results) else "pass"
    return (
        f"| {first.row} | {first.name} | {first.truth} | {' · '.join(r.settings for r in results)} "
        f"| {z:.2f} ({first.z_limit or 0:.2f}) | {_ratio(results)} "
        f"| {_path_ratio(first)} "
        f"| {_seen([r.seen_bias for r in results])}, {_seen([r.seen_block_bias for r in results])} "
        f"| {brightest:.3g} ({first.truth_max_over_mean or 0:.3g}) | {sum(r.nan for r in results)}, "
        f"{sum(r.inf for r in results)} | {sum(r.cpu_s for r in results):.1f} | {verdict} |"
    )


def _seen(biases: Sequence[float | None]) -> str:
    """The largest, over some results, of the smallest bias that would make a result fail."""
    if None in biases:
        return "unknown"
    worst = 100 * max(bias for bias in biases if bias is not None)
    return f"{worst:.2g} %" if worst < 100 else f"{worst:.0f} %"


def _deviation(result: SceneResult) -> float:
    if result.mean_ratio is None or result.mean_ratio_standard_error is None:
        return float("inf")
    return abs(result.mean_ratio - 1) / max(result.mean_ratio_standard_error, ROUNDING)


def _ratio(results: Sequence[SceneResult]) -> str:
    result = max(results, key=_deviation)
    if result.mean_ratio is None or result.mean_ratio_standard_error is None:
        return "unknown"
    rounding = " °" if any(map(_is_rounding, results)) else ""
    return f"{plus_minus(result.mean_ratio, result.mean_ratio_standard_error)}{rounding} (≤ {result.resolution:g})"


def _path_ratio(result: SceneResult) -> str:
    if result.path_ratio is None or result.path_ratio_standard_error is None:
        return "–"
    return plus_minus(result.path_ratio, result.path_ratio_standard_error)


def _is_rounding(result: SceneResult) -> bool:
    """Whether a result passes only by the tolerance for rounding: it differs by more than noise and than ROUNDING."""
    if result.faults or result.mean_ratio is None or result.mean_ratio_standard_error is None:
        return False
    off = abs(result.mean_ratio - 1)
    return off > ROUNDING and off > two_sided_limit(SIGNIFICANCE) * result.mean_ratio_standard_error


def _rounded(scenes: Sequence[Sequence[SceneResult]]) -> str:
    """The list of scenes marked ° in the table: how far the means of `bdpt` and of `path` are off by rounding."""
    if not scenes:
        return ""
    worst = [max(results, key=_deviation) for results in scenes]
    lines = [f"- {r.label}: `bdpt` {_per_cent(r.mean_ratio)}, `path` {_per_cent(r.path_ratio)}" for r in worst]
    head = (
        "° Off by more than noise, and passed as rounding: there is so little noise that rounding shows, and colours "
        "the picture all over. So much the mean is off, of `bdpt` with the worst settings:"
    )
    return "\n".join([head, "", *lines])


def _per_cent(ratio: float | None) -> str:
    return "unknown" if ratio is None else f"{100 * (ratio - 1):+.3f} %"


def _hard(results: Sequence[SceneResult]) -> str:
    """What makes the scenes hard, one line for each row; scenes with the same sentence are listed once."""
    rows: dict[int, dict[str, list[str]]] = {}
    for result in results:
        if result.row is not None and result.truth != "refusal":
            names = rows.setdefault(result.row, {}).setdefault(result.hard, [])
            names += [result.name] if result.name not in names else []
    lines = []
    for row, sentences in rows.items():
        found = [f"*{', '.join(names)}*: {hard}" if len(sentences) > 1 else hard for hard, names in sentences.items()]
        lines.append(f"- {row}: {'; '.join(found)}")
    return "## What is hard\n\n" + "\n".join(lines) if lines else ""


def _failures(results: Sequence[SceneResult]) -> str:
    lines = [f"- {r.label} ({r.settings}): {'; '.join(r.faults)}. Again: `{r.command}`" for r in results if r.faults]
    return "## Failures\n\n" + "\n".join(lines) if lines else ""


def _unsupported(refusals: Sequence[SceneResult]) -> str:
    lines = [f"- {r.label}: “{r.hard}” ({r.verdict})" for r in refusals]
    refused = "## Refused\n\n" + "\n".join([*lines, f"- {REFUSED_ON_IMPORT}"])
    return refused + "\n\n## Done from the eye alone\n\n" + "\n".join(f"- {sentence}" for sentence in EYE_ALONE)
