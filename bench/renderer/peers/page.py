"""The Markdown page of all scenes measured: efficiencies, what the chosen settings gain, and details of each scene."""

from __future__ import annotations

import math
from typing import Any

from bench.harness.results import table
from bench.renderer.peers.chosen import words
from bench.renderer.peers.plans import BASELINE, FIXED, PEERS, PLAN_SECONDS
from photonfarm.core.formatting import format_count

Z_LIMIT = 3.5
SAME_SCENE = 0.05
LABELS = {
    "path": "`path`",
    "path-multijitter": "`path`, multijitter",
    "ptracer": "`ptracer`",
    "bdpt-eye": "`bdpt` (0, 0)",
    "bdpt": "`bdpt` (1, 1)",
    "chosen": "`bdpt`, chosen",
    "pyluxcore": "pyluxcore BIDIR",
}


def mark(method: str, row: dict[str, Any]) -> str:
    """' ‡' where the mean is off beyond chance, ' §' where pyluxcore renders another scene, else nothing."""
    off, z = abs(row["mean_ratio"]["value"] - 1), abs(row["mean_ratio"]["z"])
    if not row["finite"]:
        return " (not finite)"
    if method == "pyluxcore":
        return " §" if z > Z_LIMIT and off > SAME_SCENE else ""
    return " ‡" if z > Z_LIMIT and off > 1e-3 else ""


def figure(estimate: dict[str, float]) -> str:
    """'1.23 ± 0.04', or a dash where there is none: the reference's noise hides the error."""
    value, error = estimate["value"], estimate["standard_error"]
    if not math.isfinite(value):
        return "–"
    return number(value, 3) + (f" ± {number(error, 1)}" if math.isfinite(error) else "")


def number(value: float, digits: int) -> str:
    """Significant digits without exponents from 0.001 on."""
    if value == 0 or abs(value) < 1e-3:
        return f"{value:.{digits}g}"
    decimals = digits - 1 - math.floor(math.log10(abs(value)))
    return f"{round(value, decimals):.{max(0, decimals)}f}"


EXPLANATION = """\
One image of each method at the same {clock} time, {seconds:g} s on {threads}, at {size}² pixels; samples per
pixel follow from that. {seeds} independent images of each, the methods in turn. Time is that of a render call as its
user has it, with tracing, launch and download; **compile** is what the first call took longer than a later one, apart.

- **relMSE**: mean of (f − r)²/(r² + 0.01·mean(r)²) over images, pixels and channels, against a reference r that shares
  no sample with the images. Bias counts in full. The reference is noisy itself: its variance is subtracted from the
  numerator, and what is left is its noise in the denominator, by which dark pixels count somewhat too much, for every
  method alike.
- **trimmed**: the same without the worst 1 % of the pixels, ranked by their error averaged over the images. Every
  method loses its own worst pixels, by the same rule: this forgives rare outliers and flatters methods that have them,
  and in the glass caustic it takes away most of the caustic, which is hardly more than 1 % of the image.
- **mean**: of the images over that of the common reference.
- **efficiency**: (relMSE × time) of `path` over that of the method, above 1 is better; ± is one standard error, by the
  delete-one jackknife over rounds. Rare light that none of the images met is in none of these errors.
- `path`, `ptracer`: Mitsuba's, with its `independent` sampler.
- `path`, multijitter: `path` with the best of Mitsuba's stratified samplers, `multijitter`, in powers of four of
  samples per pixel: other counts cost up to 40 % more per sample. So its images take half to twice the time; efficiency
  counts it. (In Cornell's box `stratified` and `orthogonal` gain less, `ldsampler`'s mean is off by 0.4 %, and
  `ptracer` gains nothing by any of them.)
- `bdpt` (connections, light paths per eye path): with Owen-scrambled Sobol' points for eye and light paths. (0, 0) is a
  path tracer with these points: what (1, 1) gains over it is due to light paths, not to the points.
- `bdpt`, **chosen**: by the pilot of `photonfarm scene plan`, {pilot};
  its time stands apart, in the table of scenes.
- pyluxcore {luxcore}: BIDIRCPU in a process of its own, RGB, Sobol' sampler, no Russian roulette; its
  acceleration structure is built before the clock starts, as Mitsuba's is on loading. It bounds its eye path and its
  light path, not their sum, so that its images hold some longer paths and are brighter by them; its errors are taken
  against its own reference, and its mean against the common one says how far the scenes are the same.
- ‡ the mean is off by more than {z:g} standard errors (mapped from Student's t to a normal distribution) and 0.1 %:
  the method is biased there (`ptracer` cannot see through or in mirrors and glass), or has missed rare light.
  § pyluxcore's mean is off by more than {same:.0%}: it renders another scene, compare with care.

In the plots (linked) filled markers are images rendered at that time, hollow ones averages of 2 and 4 images.
"""


def page(results: list[dict[str, Any]], settings: dict[str, Any], machine: str) -> str:
    """The whole page."""
    head = "# `bdpt` against its peers, at equal time\n\n    make bench-render\n\n"
    pilot = f"given {settings['pilot_seconds']:g} s of CPU time here and {PLAN_SECONDS:g} s there by default"
    if settings["chosen"]:
        pilot = f"but given here: {settings['chosen']}"
    text = EXPLANATION.format(
        pilot=pilot,
        clock=settings["clock"],
        seconds=settings["seconds"],
        threads=format_count(settings["threads"], "thread"),
        size=settings["size"],
        seeds=settings["seeds"],
        luxcore=settings["versions"].get("pyluxcore", "(absent)"),
        z=Z_LIMIT,
        same=SAME_SCENE,
    )
    versions = ", ".join(f"{name} {version}" for name, version in settings["versions"].items())
    commits = ", ".join(sorted({result["commit"] for result in results}))
    measured = f"Measured on {machine}; {versions}; made at commit {commits}.\n"
    parts = [head + text, measured, *summary(results), *verdict(results), *scenes(results)]
    return "\n".join(parts + [line for result in results for line in details(result)])


def summary(results: list[dict[str, Any]]) -> list[str]:
    """Efficiencies of all scenes, full / trimmed."""
    methods = [m for m in LABELS if m != "path" and any(m in r["rows"] for r in results)]
    lines = [
        [f"[{result['line']}](render/{result['line']}.png)", *(efficiencies(result, method) for method in methods)]
        for result in results
    ]
    header = ("scene", *(LABELS[m] for m in methods))
    return ["## Efficiency relative to `path`: full / trimmed\n", table(header, lines), ""]


def efficiencies(result: dict[str, Any], method: str) -> str:
    """'full / trimmed' with the mark of a doubtful mean; a dash where the method is absent."""
    row = result["rows"].get(method)
    if row is None or "efficiency_full" not in row:
        return "–"
    return f"{figure(row['efficiency_full'])} / {figure(row['efficiency_trimmed'])}{mark(method, row)}"


def scenes(results: list[dict[str, Any]]) -> list[str]:
    """What was rendered, and against what."""
    lines = []
    for r in results:
        picked = r["chosen"]
        chosen = f"{words(picked)}, pilot {picked['pilot_wall_s']:.0f} s" if picked else "–"
        lux = r["absent"].get("pyluxcore") or "; ".join(r["differences"]) or "the same"
        lux = lux if "pyluxcore" in r["absent"] or "pyluxcore" in r["rows"] else "–"
        lines.append((r["line"], r["scene"], r["max_depth"], r["reference"], chosen, lux, r["note"]))
    header = ("line", "scene", "max_depth", "reference", "chosen", "pyluxcore", "note")
    return ["## Scenes\n", table(header, lines), ""]


def details(result: dict[str, Any]) -> list[str]:
    """One scene's table."""
    columns = ("method", "spp", "wall s", "CPU s", "compile s", "mean", "relMSE", "trimmed", "efficiency", "trimmed")
    lines = []
    for method in (m for m in LABELS if m in result["rows"]):
        row = result["rows"][method]
        mean = f"{row['mean_ratio']['value']:.4f} ± {row['mean_ratio']['standard_error']:.4f}{mark(method, row)}"
        keys = ("efficiency_full", "efficiency_trimmed")
        efficiency = ["1" if method == BASELINE else figure(row[key]) if key in row else "–" for key in keys]
        compiled = "in the pilot" if method == "chosen" and was_piloted(result) else f"{row['compile_s']:.1f}"
        costs = [f"{row['wall_s']:.2f}", f"{row['cpu_s']:.2f}", compiled]
        errors = [figure(row["full"]), figure(row["trimmed"])]
        lines.append((LABELS[method], row["spp"], *costs, mean, *errors, *efficiency))
    picture = f"![relMSE against time](render/{result['line']}.png)\n"
    return [f"## {result['line']}\n", picture, table(columns, lines), ""]


def was_piloted(result: dict[str, Any]) -> bool:
    """Whether a pilot chose, which has compiled what it chose."""
    return bool(result["chosen"] and result["chosen"]["pilot_wall_s"] > 0)


# ------------------------------------------------------------------------- what the chosen settings gain

PEERS_EXPLAINED = f"""\
(relMSE × time) of the peer over that of `bdpt`, chosen, above 1 `bdpt` is better; ± as above. The best peer is the one
over which it gains least, of {"; ".join(LABELS[peer] for peer in PEERS)}; one whose mean is marked as off,
‡ or §, is left out.
"""


def verdict(results: list[dict[str, Any]]) -> list[str]:
    """What *chosen* gains over the best unbiased peer, scene by scene, and where it loses to fixed settings."""
    compared = [result for result in results if result["gains"]]
    if not compared:
        return []
    lines = []
    for result in compared:
        best = [best_peer(result, kind) for kind in ("full", "trimmed")]
        cells = [
            f"{figure(result['gains'][peer][kind])} ({LABELS[peer]})" if peer else "–"
            for peer, kind in zip(best, ("full", "trimmed"), strict=True)
        ]
        lines.append((result["line"], *cells))
    won = table(("scene", "all pixels", "trimmed"), lines)
    return ["## `bdpt`, chosen, over the best unbiased peer\n", won, "", PEERS_EXPLAINED, *losses(compared)]


def best_peer(result: dict[str, Any], kind: str) -> str | None:
    """The peer over which *chosen* gains least, of those whose mean is not marked as off."""
    gains = {
        peer: gain["value"]
        for peer in PEERS
        if (gain := result["gains"].get(peer, {}).get(kind))
        and math.isfinite(gain["value"])
        and not mark(peer, result["rows"][peer])
    }
    return min(gains, key=lambda peer: gains[peer], default=None)


def losses(results: list[dict[str, Any]]) -> list[str]:
    """A sentence for each scene and fixed setting of `bdpt` that beats *chosen* by more than the standard error."""
    lines = []
    for result in results:
        for fixed, gains in ((name, gains) for name, gains in result["gains"].items() if name in FIXED):
            if any(gain["value"] + gain["standard_error"] < 1 for gain in gains.values()):
                picked = words(result["chosen"])
                lines.append(
                    f"- In {result['line']} *chosen*, {picked}, is worse than {LABELS[fixed]}: it has "
                    f"{figure(gains['full'])} of its efficiency in all pixels, {figure(gains['trimmed'])} trimmed."
                )
    return [*lines, ""] if lines else ["No fixed setting of `bdpt` beats *chosen* by more than its error.\n"]
