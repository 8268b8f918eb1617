"""What the parts of a sample cost: halves alone and together, inputs, photons, visibility, edits, the first call."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bench.card.rooms import draw_view, first_and_median, load_room
from bench.harness import results
from photonfarm.core.keys import view_key

TITLE = "A sample"
HALF_SPP, REPETITIONS, MOST_TOGETHER = 4, 5, 64


def measure(name: str, size: int, _out: Path, _limit_s: float) -> dict[str, Any]:
    """The parts at this size and at a quarter of it, in milliseconds."""
    return {"rows": [measure_at(name, side) for side in (max(16, size // 4), size)]}


def measure_at(name: str, size: int) -> dict[str, Any]:
    """The parts at one size."""
    from photonfarm.renderer.scene import backend

    scene = load_room(name, size, HALF_SPP)
    from photonfarm.renderer.jobs.render import lit_points
    from photonfarm.renderer.tools.measure.frame_costs import time_parts

    cloud = scene.base()[1]

    def time_all(number: int) -> dict[str, float]:
        return time_parts(scene, cloud, *draw_view(scene, number), backend.work_s)

    first_s, _, *others = (time_all(number) for number in range(REPETITIONS + 2))
    modification, key, view = draw_view(scene, 0)
    scene.apply(modification)
    count = min(scene.samples_at_once, MOST_TOGETHER)
    views = [draw_view(scene, 0, number)[2] for number in range(count)]
    keys, lit = [view_key(key, each.vector) for each in views], lit_points(cloud, modification)
    compiled, alone = first_and_median(lambda n: scene.render_halves(view, (2 * n, 2 * n + 1)), REPETITIONS)
    twice = [each for each in views for _ in "AB"]
    together = first_and_median(lambda n: scene.render_images(twice, range(n, n + 2 * count)), REPETITIONS)[1]
    inputs_s = first_and_median(lambda _: scene.inputs(views, keys, scene.spec.guides, lit), REPETITIONS)[1]
    parts = {part: statistics.median(of[part] for of in others) for part in first_s}
    return {
        "size": size,
        "halves": 1e3 * alone,
        "halves, together": 1e3 * together / count,
        "together": count,
        "inputs, together": 1e3 * inputs_s / count,
        **{part.removesuffix("_s").replace("_", " "): 1e3 * part_s for part, part_s in parts.items()},
        "first call, s": compiled + sum(first_s.values()),
    }


def describe(found: Mapping[str, Mapping[str, Any]]) -> str:
    """The table."""
    rows = [(name, row) for name, of in found.items() for row in of["rows"]]
    parts = [part for part in rows[0][1] if part not in ("size", "together")]
    lines = [[f"{name} {row['size']}²", row["together"], *(f"{row[part]:.3g}" for part in parts)] for name, row in rows]
    return f"""Milliseconds, one process, {HALF_SPP} spp a half; both halves of a view, alone and of so many views
together. Inputs are guides with buffers, and so are guides; points, and photons seen, are visibility.

{results.table(("", "views together", *parts), lines)}"""
