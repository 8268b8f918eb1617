"""A way to render a scene, and what it costs."""

from __future__ import annotations

import math
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

    def possible(self, spp: float) -> int:
        """The number of samples per pixel nearest to `spp` that it can render, at least 1."""

    def close(self) -> None:
        """Give back what it holds."""


@dataclass(frozen=True, slots=True)
class MitsubaMethod:
    """A Mitsuba integrator in this process."""

    scene: Any
    integrator: Any
    stratified_camera: Any = None  # of `multijittered`, where its points are wanted instead of the scene's own sampler

    def render(self, seed: int, spp: int) -> Shot:
        """One image."""
        import mitsuba as mi

        cpu, wall = time.process_time(), time.perf_counter()
        camera = 0 if self.stratified_camera is None else self.stratified_camera
        image = np.array(mi.render(self.scene, sensor=camera, integrator=self.integrator, spp=spp, seed=seed))
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        return Shot(np.ascontiguousarray(image[..., :3], np.float32), wall, cpu)

    def possible(self, spp: float) -> int:
        """The nearest possible samples per pixel; powers of four for `multijitter`.

        It takes counts that fill a grid, and rounds others up. A sample of other grids costs up to 40 % more (measured
        in Cornell's box, 10 % in the kitchen): its permutations then divide by what is no power of two.
        """
        if self.stratified_camera is None:
            return max(1, round(spp))
        return int(4 ** max(0, round(math.log(max(spp, 1), 4))))

    def close(self) -> None:
        """Nothing is held."""


def multijittered(scene: Any, sampler: str = "multijitter") -> Any:
    """The scene's camera, on the same film, with another sampler. Raises ValueError if it is no perspective camera.

    A sampler belongs to its camera and cannot be exchanged, so the camera is built anew.
    """
    import mitsuba as mi

    camera = scene.sensors()[0]
    if camera.class_name() != "PerspectiveCamera":
        raise ValueError(f"the camera is a {camera.class_name()}; only a perspective camera can be given a sampler")
    found = mi.traverse(camera)
    offsets = {key: float(found[key][0]) for key in ("principal_point_offset_x", "principal_point_offset_y")}
    to_world = mi.ScalarTransform4f(np.array(found["to_world"].matrix).reshape(4, 4))
    description = {
        "type": "perspective",
        "fov": float(found["x_fov"][0]),
        "fov_axis": "x",
        "to_world": to_world,
        "near_clip": camera.near_clip(),
        "far_clip": camera.far_clip(),
        "film": camera.film(),
        "sampler": {"type": sampler},
        **offsets,
    }
    return mi.load_dict(description)


def integrator(name: str, max_depth: int, chosen: dict[str, Any]) -> Any:
    """The Mitsuba plugin of a method; `chosen` holds the parameters of the method 'chosen'."""
    import mitsuba as mi

    common: dict[str, Any] = {"max_depth": max_depth, "rr_depth": 5}
    parameters: dict[str, dict[str, Any]] = {
        "path": {"type": "path"},
        "path-multijitter": {"type": "path"},
        "ptracer": {"type": "ptracer"},
        "bdpt-eye": {"type": "bdpt", "record": True, "connections": 0, "light_ratio": 0.0},
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
    """Renders until the longest budget is met within 15 %, or as nearly as the method can.

    The shorter ones follow from fixed cost + cost per sample.

    A method that is slower at one sample per pixel than a budget gets one. Every number of samples returned has been
    rendered, as one sample and several are different kernels.
    """
    first = method.render(1, 2)
    compile_s = max(0.0, first.wall_s - method.render(1, 2).wall_s)
    target = max(budgets_s)
    least = _warm_seconds(method, 1, clock)
    spp = _next(method, 1, least, target / 5)
    for _ in range(6):
        seconds = _warm_seconds(method, spp, clock)
        if abs(seconds / target - 1) < 0.15 or (spp == 1 and seconds > target):
            break
        before, spp = spp, _next(method, spp, seconds, target)
        if spp == before:
            break
    per_sample = max((seconds - least) / (spp - 1) if spp > 1 else least, 1e-9)
    fixed = max(0.0, least - per_sample)
    chosen = tuple(spp if b == target else method.possible((b - fixed) / per_sample) for b in budgets_s)
    for other in set(chosen):
        method.render(1, other)
    return Calibration(chosen, compile_s, fixed, per_sample)


def _warm_seconds(method: Method, spp: int, clock: str) -> float:
    """Seconds of an image: the lesser of two, because the first may compile."""
    return min(method.render(seed, spp).seconds(clock) for seed in (1, 2))


def _next(method: Method, spp: int, seconds: float, target: float) -> int:
    """Samples per pixel to try next: in proportion, in steps of at most 16 because short renders mislead."""
    return method.possible(spp * min(16.0, target / max(seconds, 1e-6)))
