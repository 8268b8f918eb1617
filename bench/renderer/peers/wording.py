"""How the page names methods, marks doubtful means and writes figures."""

from __future__ import annotations

import math
from typing import Any

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
