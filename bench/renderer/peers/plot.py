"""Error against time, log-log, one picture per scene."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from PIL import Image

STYLES = {
    "path": ("tab:gray", "o", "path"),
    "path-multijitter": ("black", "P", "path, multijitter"),
    "ptracer": ("tab:orange", "s", "ptracer"),
    "bdpt-eye": ("tab:cyan", "<", "bdpt (0, 0)"),
    "bdpt": ("tab:blue", "^", "bdpt (1, 1)"),
    "chosen": ("tab:red", "D", "bdpt, chosen"),
    "pyluxcore": ("tab:green", "v", "pyluxcore BIDIR"),
}
"""Colour, marker and name of each method."""

COLOURS = 64  # of the picture: lines and letters need no more


def save(result: dict[str, Any], path: Path, clock: str) -> None:
    """Write the PNG of one scene's result: relMSE full on the left, trimmed on the right.

    Filled markers are images rendered at that time, hollow ones averages of images. Values that are not positive,
    where the reference's noise hides the error, are left out.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import LogLocator, NullFormatter

    name = {"cpu": "CPU"}.get(clock, clock)
    figure, axes = plt.subplots(1, 2, figsize=(9, 4.0), sharex=True, sharey=True, layout="constrained")
    for axis, kind in zip(axes, ("full", "trimmed"), strict=True):
        for method in (m for m in STYLES if m in result["curves"]):
            draw(axis, method, result["curves"][method], kind)
        axis.set(xscale="log", yscale="log", xlabel=f"{name} seconds", title=f"{result['line']}: {title(kind)}")
        axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.grid(visible=True, which="both", linewidth=0.3, alpha=0.6)
    axes[0].set_ylabel("relMSE")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(STYLES), fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=100, metadata={"Software": None})
    Image.open(drawn).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)
    plt.close(figure)


def title(kind: str) -> str:
    """What a panel shows."""
    return "all pixels" if kind == "full" else "without the worst 1 %"


def draw(axis: Any, method: str, points: list[dict[str, Any]], kind: str) -> None:
    """One method's line and markers."""
    colour, marker, label = STYLES[method]
    shown = [p for p in points if p[kind] > 0 and p["seconds"] > 0]
    axis.plot([p["seconds"] for p in shown], [p[kind] for p in shown], color=colour, linewidth=1)
    axis.plot([], [], marker, color=colour, linestyle="-", linewidth=1, markersize=5, label=label)
    for point in shown:
        face = colour if point["averaged"] == 1 else "white"
        axis.plot(point["seconds"], point[kind], marker, color=colour, markerfacecolor=face, markersize=5)
