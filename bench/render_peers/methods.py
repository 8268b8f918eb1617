"""A way to render a scene, and what it costs."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """One image and what it cost, as its user has it: with tracing, launch and download."""

    image: NDArray[np.float32]  # [H, W, 3]
    wall_s: float
    cpu_s: float  # over all threads

    def seconds(self, clock: str) -> float:
        """Seconds on the clock 'wall' or 'cpu'."""
        return self.wall_s if clock == "wall" else self.cpu_s


class Method(Protocol):
    """Something that renders one scene."""

    def render(self, seed: int, spp: int) -> Shot:
        """One image of `spp` samples per pixel; equal seeds share samples, others are independent."""

    def close(self) -> None:
        """Give back what it holds."""


@dataclass(frozen=True, slots=True)
class MitsubaMethod:
    """A Mitsuba integrator in this process."""

    scene: Any
    integrator: Any

    def render(self, seed: int, spp: int) -> Shot:
        """As `Method`."""
        import mitsuba as mi

        cpu, wall = time.process_time(), time.perf_counter()
        image = np.array(mi.render(self.scene, integrator=self.integrator, spp=spp, seed=seed))
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        return Shot(np.ascontiguousarray(image[..., :3], np.float32), wall, cpu)

    def close(self) -> None:
        """Nothing is held."""


def integrator(name: str, max_depth: int, chosen: dict[str, Any]) -> Any:
    """The Mitsuba plugin of a method; `chosen` holds the parameters of the method 'chosen'."""
    import mitsuba as mi

    common: dict[str, Any] = {"max_depth": max_depth, "rr_depth": 5}
    parameters: dict[str, dict[str, Any]] = {
        "path": {"type": "path"},
        "ptracer": {"type": "ptracer"},
        "bdpt": {"type": "bdpt", "record": True, "connections": 1, "light_ratio": 1.0},
        "chosen": {"type": "bdpt", "record": True, **chosen},
    }
    return mi.load_dict({**common, **parameters[name]})


@dataclass(frozen=True, slots=True)
class Calibration:
    """Samples per pixel for each time budget, and where the time goes."""

    spp: tuple[int, ...]
    compile_s: float  # what the first render took longer than a later one, wall
    fixed_s: float  # of an image, whatever its samples are
    sample_s: float  # of one sample of every pixel


def calibrate(method: Method, budgets_s: tuple[float, ...], clock: str) -> Calibration:
    """Renders until the longest budget is met within 15 %; the shorter ones follow from fixed cost + cost per sample.

    A method that is slower at one sample per pixel than a budget gets one. Every number of samples returned has been
    rendered, as one sample and several are different kernels.
    """
    first = method.render(1, 2)
    compile_s = max(0.0, first.wall_s - method.render(1, 2).wall_s)
    target = max(budgets_s)
    least = _warm_seconds(method, 1, clock)
    spp = _next(1, least, target / 5)
    for _ in range(6):
        seconds = _warm_seconds(method, spp, clock)
        if abs(seconds / target - 1) < 0.15 or (spp == 1 and seconds > target):
            break
        spp = _next(spp, seconds, target)
    per_sample = max((seconds - least) / (spp - 1) if spp > 1 else least, 1e-9)
    fixed = max(0.0, least - per_sample)
    chosen = tuple(spp if b == target else max(1, round((b - fixed) / per_sample)) for b in budgets_s)
    for other in set(chosen):
        method.render(1, other)
    return Calibration(chosen, compile_s, fixed, per_sample)


def _warm_seconds(method: Method, spp: int, clock: str) -> float:
    """Seconds of an image: the lesser of two, because the first may compile."""
    return min(method.render(seed, spp).seconds(clock) for seed in (1, 2))


def _next(spp: int, seconds: float, target: float) -> int:
    """Samples per pixel to try next: in proportion, in steps of at most 16 because short renders mislead."""
    return max(1, round(spp * min(16.0, target / max(seconds, 1e-6))))
