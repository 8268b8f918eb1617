"""Which scenes are measured, how deep, and against what reference."""

from __future__ import annotations

from dataclasses import dataclass

METHODS = ("path", "path-multijitter", "ptracer", "bdpt-eye", "bdpt", "chosen", "pyluxcore")
PEERS = ("path", "path-multijitter", "ptracer", "pyluxcore")
FIXED = ("bdpt-eye", "bdpt")
"""Settings of `bdpt` that no pilot chose."""
PLAN_SECONDS = 60.0
"""CPU time of the pilot in `photonfarm scene plan` by default."""
BASELINE = "path"
BUDGETS = (1 / 16, 1 / 4, 1.0)
"""Shares of the time budget that images are rendered at; longer times are averages of the last."""


@dataclass(frozen=True, slots=True)
class ScenePlan:
    """One line of the benchmark."""

    scene: str  # name for scene_loading.load
    max_depth: int  # longest path in edges
    reference: tuple[str, ...] = ("bdpt", "path")  # methods whose long renders make the reference
    note: str = ""


PLANS: dict[str, ScenePlan] = {
    "cornell": ScenePlan("cornell", 8),
    "room": ScenePlan("room", 8, note="the built-in room"),
    "kitchen": ScenePlan("kitchen", 8),
    "bathroom": ScenePlan("bathroom", 8),
    "living-room-2": ScenePlan("living-room-2", 8),
    "veach-ajar": ScenePlan("veach-ajar", 12, note="light behind a door"),
    "cove": ScenePlan("cove", 8, note="all light in the image is indirect"),
    "door_gap": ScenePlan("door_gap", 8),
    "glass_caustic": ScenePlan(
        "glass_caustic", 8, ("bdpt",), "light seen twice through the ball is found by chance alone, by every method"
    ),
    "floor_caustic": ScenePlan(
        "floor_caustic", 8, ("bdpt", "ptracer"), "a caustic alone: the ball is out of the picture"
    ),
    "mirror_room": ScenePlan("mirror_room", 8),
    "hundred_lights": ScenePlan("hundred_lights", 8),
}
"""Every line by its name. `path` is left out of references where its noise is far above that of `bdpt`."""


def estimated_seconds(lines: int, methods: int, seeds: int, seconds: float, reference: float, pilot_s: float) -> float:
    """Expected duration of a run, rather too long: every method counts for every scene, also pyluxcore.

    Per method: `seeds` images at each budget, about four for calibration; two long references per scene; half a
    minute per scene to load and to compile, and a quarter more than its time for a pilot (twice that in large scenes).
    """
    per_method = (seeds * sum(BUDGETS) + 4) * seconds
    return lines * (methods * per_method + 2 * reference * seconds + 30 + 1.25 * pilot_s)
