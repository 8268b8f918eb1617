"""The settings of `bdpt` that photonfarm's own strategy chooses for a scene."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from bench.renderer.peers.methods import Calibration

LEAST_IMAGE_S = 0.1
PILOT_SEED = 50_000_000
"""Far from the seeds that are measured, so that no image helped to choose its own settings."""


@dataclass(frozen=True, slots=True)
class Chosen:
    """Settings, and what it took to find them."""

    connections: int
    light_ratio: float
    pilot_wall_s: float  # with the compilation of all candidates; 0 for settings that were given
    why: str
    guided_light: bool = False
    light_samples: int = 1

    def parameters(self) -> dict[str, Any]:
        """The settings as the plugin takes them."""
        guided = {"guided_light": True} if self.guided_light else {}
        samples = {"light_samples": self.light_samples} if self.light_samples > 1 else {}
        return {"connections": self.connections, "light_ratio": self.light_ratio, **guided, **samples}


def words(parameters: dict[str, Any]) -> str:
    """The settings in brackets, "(1, 0.25)", "(1, 0.25, guided)" or "(1, 0.25, 2 light samples)"."""
    guided = ", guided" if parameters.get("guided_light") else ""
    samples = f", {n} light samples" if (n := parameters.get("light_samples", 1)) > 1 else ""
    return f"({parameters['connections']}, {parameters['light_ratio']:g}{guided}{samples})"


def given(text: str) -> Chosen:
    """Settings from "CONNECTIONS,LIGHT_RATIO" or "CONNECTIONS,LIGHT_RATIO,guided". Raises ValueError for others."""
    try:
        connections, light_ratio, *more = text.split(",")
        if more not in ([], ["guided"]):
            raise ValueError(text)
        return Chosen(int(connections), float(light_ratio), 0.0, "given", bool(more))
    except ValueError:
        raise ValueError(
            f"chosen settings are {text!r}; allowed is CONNECTIONS,LIGHT_RATIO such as 0,1, or with ',guided' after "
            "it, or nothing to run the pilot"
        ) from None


def pilot_spp(known: Calibration) -> int:
    """Samples per pixel of the pilot's images, from the calibration of `bdpt`.

    An image's samples take about as long as what it costs beside them, or the pilot would choose by that alone.
    """
    return max(1, round((max(2 * known.fixed_s, LEAST_IMAGE_S) - known.fixed_s) / known.sample_s))


def by_pilot(scene: Any, max_depth: int, seconds: float, spp: int) -> Chosen:
    """What the pilot of `photonfarm scene plan` finds for this one view.

    It takes about `seconds` of CPU time, and more where its first round and the kernels of all candidates need more.
    """
    import time

    import mitsuba as mi

    from photonfarm.renderer.scene.backend import work_s
    from photonfarm.renderer.strategy.budget import time_images
    from photonfarm.renderer.strategy.candidates import GRID, PLAIN, best, compare_at_cost
    from photonfarm.renderer.strategy.content import SceneContent
    from photonfarm.renderer.strategy.pilot import measure_errors
    from photonfarm.renderer.strategy.plan import BLACK, reasons_for

    plugins: dict[Any, Any] = {}

    def render(candidate: Any, seed: int, spp: int) -> Any:
        if candidate not in plugins:
            common = {"type": "bdpt", "record": True, "max_depth": max_depth, "rr_depth": 5}
            plugins[candidate] = mi.load_dict({**common, **asdict(candidate)})
        image = np.array(mi.render(scene, integrator=plugins[candidate], spp=spp, seed=seed))
        return np.ascontiguousarray(image[..., :3], np.float32)

    start = time.perf_counter()
    pointless = SceneContent.of(scene, scene.sensors()[0]).why_no_light_paths(max_depth, 1.0)
    candidates = [PLAIN] if pointless else GRID
    costs = time_images([render], candidates, spp, 0.2 * seconds, work_s)
    image_s = costs[PLAIN].time_s(spp)
    found = measure_errors([render], costs, later_s=image_s, seconds=0.8 * seconds, spp=spp, seed=PILOT_SEED)
    chosen, reasons = PLAIN, [BLACK]
    if found.measured:
        compared = compare_at_cost(found.measured, spp, image_s)
        chosen = best(compared.values()).candidate
        reasons = reasons_for(compared[chosen], list(compared.values()), found.shared)
    spent_s = time.perf_counter() - start
    return Chosen(
        chosen.connections, chosen.light_ratio, spent_s, "; ".join(reasons), chosen.guided_light, chosen.light_samples
    )
