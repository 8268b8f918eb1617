"""Rays and paths per second: bare rays, `path`, and `bdpt` by strategy."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.card.rooms import draw_view, first_and_median, load_room, on_card
from bench.harness import results
from photonfarm.scene.spec import Transport

if TYPE_CHECKING:
    from photonfarm.renderer.scene.loaded_scene import LoadedScene

TITLE = "Rays and paths per second"
MAX_DEPTH, RR_DEPTH = 8, 5
STRATEGIES: dict[str, dict[str, Any]] = {
    "bdpt (0, 0)": {"connections": 0, "light_ratio": 0.0},
    "bdpt (1, 1)": {"connections": 1, "light_ratio": 1.0},
    "bdpt (2, 0.25), 4 light samples": {"connections": 2, "light_ratio": 0.25, "light_samples": 4},
    "bdpt (4, 0.125), guided": {"connections": 4, "light_ratio": 0.125, "guided_light": True},
}
BARE = "bare rays"
REPETITIONS = 3


def make_integrators() -> dict[str, Any]:
    """`path`, and `bdpt` by each of `STRATEGIES`, with recorded launches as workers have them."""
    import mitsuba as mi

    from photonfarm.renderer.scene import backend
    from photonfarm.renderer.scene.loaded_scene import integrator_of

    depths = {"max_depth": MAX_DEPTH, "rr_depth": RR_DEPTH}
    recorded = {
        name: integrator_of(Transport.model_validate({**depths, **strategy}), backend.paths_at_once())
        for name, strategy in STRATEGIES.items()
    }
    return {"path": mi.load_dict({"type": "path", **depths}), **recorded}


def measure(name: str, size: int, _out: Path, _limit_s: float) -> dict[str, Any]:
    """Millions a second, and the first call's seconds."""
    spp = 256 if on_card() else 16
    scene = load_room(name, size, spp)
    import drjit as dr

    count = 1 << 22 if on_card() else 1 << 18
    rays = draw_rays(scene, count)
    hit = partial(scene.scene.ray_intersect_preliminary, rays, coherent=False)
    first, median = first_and_median(lambda _: (dr.eval(hit().t), dr.sync_thread()), REPETITIONS)
    rows = {BARE: {"millions": count / median / 1e6, "first_s": first}}
    modification, _, view = draw_view(scene, 0)
    scene.apply(modification)
    for method, integrator in make_integrators().items():
        first, median = first_and_median(partial(scene.render, view, integrator=integrator), REPETITIONS)
        rows[method] = {"millions": size * size * spp / median / 1e6, "first_s": first}
    return {"size": size, "spp": spp, "rows": rows}


def draw_rays(scene: LoadedScene, count: int) -> Any:
    """Rays that leave the surfaces at rest into random directions, without any order."""
    import drjit as dr
    import mitsuba as mi

    cloud, rng = scene.base()[1], np.random.default_rng(0)
    chosen = rng.integers(len(cloud.position), size=count)
    normal, towards = cloud.normal[chosen], rng.standard_normal((count, 3)).astype(np.float32)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    towards *= np.sign((towards * normal).sum(axis=1, keepdims=True))
    ray = mi.Ray3f(mi.Point3f((cloud.position[chosen] + 1e-3 * normal).T), mi.Vector3f(towards.T))
    dr.eval(ray)
    return ray


def describe(found: Mapping[str, Mapping[str, Any]]) -> str:
    """The table."""
    parts = []
    for name, of in found.items():
        path = of["rows"]["path"]["millions"]
        lines = [
            [
                method,
                f"{row['millions']:.3g}",
                "" if method == BARE else f"×{path / row['millions']:.2f}",
                f"{row['first_s']:.2g}",
            ]
            for method, row in of["rows"].items()
        ]
        header = ("", "millions a second", "cost of a path over `path`'s", "first call, s")
        parts.append(
            f"`{name}` at {of['size']}², {of['spp']} spp, max_depth {MAX_DEPTH}; rays without order, from surfaces; "
            f"paths from pixels, whole calls.\n\n{results.table(header, lines)}"
        )
    return "\n\n".join(parts)
