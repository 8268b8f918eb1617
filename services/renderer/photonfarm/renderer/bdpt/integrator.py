"""The integrator plugin ``bdpt``: an unbiased bidirectional path tracer with light tracing and random connections."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from . import randomness
from .camera import check_sensor
from .emission import Lights, next_2d, read_lights
from .eye_paths import Connectable, trace_eye_paths
from .light_paths import PathOptions, trace_light_paths
from .scenes import UNBOUNDED, check_scene, depth_limit

PASS_PATHS = 1 << 18
"""Most eye paths traced at once: bounds the memory to about 72 bytes for each light path and 60 for each eye path."""


class BidirectionalPathTracer(mi.SamplingIntegrator):
    """Bidirectional path tracer; expected image equal to that of Mitsuba's ``path`` for every choice of its parameters.

    - ``max_depth`` (int, default -1): longest path in edges, -1 unbounded; 1 shows lights only, 2 direct light. As in
      ``path``.
    - ``rr_depth`` (int, default 5): edges after which Russian roulette begins, on either side. As in ``path``.
    - ``connections`` (int ≥ 0, default 1): light vertices each eye vertex is connected to. Needs ``light_ratio`` > 0.
    - ``light_ratio`` (float ≥ 0, default 1): light paths per eye path, fractions allowed; 0 leaves a plain path tracer.

    Raises ValueError for a value outside these ranges, and on rendering for what it cannot render without bias.
    """

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        self.max_depth = depth_limit(int(props.get("max_depth", -1)))
        self.rr_depth = int(props.get("rr_depth", 5))
        self.connections = int(props.get("connections", 1))
        self.light_ratio = float(props.get("light_ratio", 1.0))
        self._check_parameters()

    def _check_parameters(self) -> None:
        if self.rr_depth < 1:
            raise ValueError(f"bdpt: rr_depth is {self.rr_depth}; allowed are numbers of edges from 1")
        if self.connections < 0:
            raise ValueError(f"bdpt: connections is {self.connections}; allowed are whole numbers from 0")
        if not 0 <= self.light_ratio <= 64:
            raise ValueError(
                f"bdpt: light_ratio is {self.light_ratio}; allowed are light paths per eye path from 0 to 64"
            )
        if self.connections and not self.light_ratio:
            raise ValueError(
                f"bdpt: connections is {self.connections} and light_ratio is 0; connections need light paths to "
                f"connect to; "
                "use connections=0 or a light_ratio above 0"
            )
        if self.hide_emitters:
            raise ValueError(
                "bdpt: hide_emitters is set; only false is allowed, because light paths cannot know what is hidden"
            )

    def to_string(self) -> str:
        """Mitsuba's description of an object."""
        depth = -1 if self.max_depth == UNBOUNDED else self.max_depth
        return (
            f"BidirectionalPathTracer[max_depth={depth}, rr_depth={self.rr_depth}, connections={self.connections}, "
            f"light_ratio={self.light_ratio}]"
        )

    def render(
        self,
        scene: Any,
        sensor: Any = 0,
        seed: Any = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> Any:
        """The image (TensorXf [H, W, C], linear radiance).

        Raises ValueError for scenes, sensors and films it cannot render.
        """
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        seed = int(seed if isinstance(seed, int) else seed[0])
        spp = spp or sensor.sampler().sample_count()
        film = sensor.film()
        check_scene(scene)
        check_sensor(sensor, light_tracing=self.light_ratio > 0)
        with dr.suspend_grad():
            film.prepare([])
            block = film.create_block()
            block.set_coalesce(False)
            lights = read_lights(scene) if scene.emitters() else None
            total = film.crop_size()[0] * film.crop_size()[1] * spp
            for part, begin in enumerate(range(0, total, PASS_PATHS)):
                n = min(PASS_PATHS, total - begin)
                self._render_pass(scene, sensor, lights, block, seed=seed, part=part, begin=begin, n=n, spp=spp)
            film.put_block(block)
            if not develop:
                return mi.TensorXf()
            image = film.develop()
            if evaluate:
                dr.eval(image)
            return image

    def _render_pass(
        self,
        scene: Any,
        sensor: Any,
        lights: Lights | None,
        block: Any,
        *,
        seed: int,
        part: int,
        begin: int,
        n: int,
        spp: int,
    ) -> None:
        """Trace n eye paths, the (begin)th first, and their share of light paths; add both to ``block``."""
        light_paths = max(1, round(n * self.light_ratio)) if self.light_ratio and lights is not None else 0
        options = self._options(light_paths / n)
        connectable = None
        if lights is not None and (options.traces_light or options.connects):
            vertices, seen = trace_light_paths(
                scene,
                sensor,
                lights,
                options,
                seed=randomness.stream_seed(seed, part, randomness.LIGHT),
                n=light_paths,
                splat=dr.opaque(mi.Float, n / light_paths),
                block=block,
            )
            if vertices is not None:
                pairing = randomness.stream_seed(seed, part, randomness.PAIRING)
                connectable = Connectable(vertices, seen, dr.opaque(mi.UInt32, light_paths), pairing)

        rng = randomness.generator(randomness.stream_seed(seed, part, randomness.EYE), n)
        ray, weight, position, aperture = primary_rays(sensor, rng, begin=begin, n=n, spp=spp)
        radiance, hit = trace_eye_paths(
            scene, sensor, lights, options, rng=rng, ray=ray, weight=weight, aperture=aperture, connectable=connectable
        )
        block.put(position, [], radiance, dr.select(hit, mi.Float(1), 0), mi.Float(1))

    def _options(self, light_ratio: float) -> PathOptions:
        traces_light = light_ratio > 0 and self.max_depth >= 2
        connects = light_ratio > 0 and self.connections > 0 and self.max_depth >= 3
        return PathOptions(
            max_depth=self.max_depth,
            rr_depth=self.rr_depth,
            connections=self.connections,
            count=dr.opaque(mi.Float, connection_count(self.connections, self.max_depth) if connects else 0.0),
            light_ratio=dr.opaque(mi.Float, light_ratio),
            connects=connects,
            traces_light=traces_light,
        )


def connection_count(connections: int, max_depth: int) -> float:
    """Technique count of connections: n_C over a nominal number of vertices per light path.

    A connection picks one of a path's vertices at random, so each (s, t) gets n_C/length of them on average. Any
    constant keeps the estimate unbiased (the counts only shape the weights); 3 is about the length in the closed rooms
    we measured.
    """
    return connections / min(3, max(1, max_depth - 2))


def primary_rays(sensor: Any, rng: Any, *, begin: int, n: int, spp: int) -> tuple[Any, Any, Any, Any]:
    """Rays, sensor weights, film positions in pixels and aperture samples of the samples begin … begin + n − 1.

    Each pixel has `spp` of them, one after the other.
    """
    film = sensor.film()
    size, offset = mi.ScalarVector2u(film.crop_size()), mi.ScalarVector2f(film.crop_offset())
    pixel = (dr.arange(mi.UInt32, n) + dr.opaque(mi.UInt32, begin)) // dr.opaque(mi.UInt32, spp)
    row = pixel // size[0]
    corner = mi.Point2f(mi.Float(pixel - row * size[0]), mi.Float(row))
    position = corner + next_2d(rng)
    aperture = next_2d(rng) if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    ray, weight = sensor.sample_ray(0, 0, position / mi.ScalarVector2f(size), aperture)
    # The box filter counts a sample for the pixel it was drawn in; the corner cannot round into the next one
    return ray, weight, corner + offset + 0.5, aperture


mi.register_integrator("bdpt", lambda props: BidirectionalPathTracer(props))
