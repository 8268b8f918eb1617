"""The integrator plugin ``bdpt``: an unbiased bidirectional path tracer with light tracing and random connections."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi

from photonfarm.renderer.bdpt import randomness
from photonfarm.renderer.bdpt.camera import ImageStack, Splat, Sums, check_sensor, primary_rays
from photonfarm.renderer.bdpt.eye_paths import Connectable, trace_eye_paths
from photonfarm.renderer.bdpt.guiding.grid import Grid, SparseLanes
from photonfarm.renderer.bdpt.guiding.learning import Effort, PathGuide, learn
from photonfarm.renderer.bdpt.guiding.starts import Layout, StartGuide
from photonfarm.renderer.bdpt.guiding.tally import Tally, Totals
from photonfarm.renderer.bdpt.guiding.usefulness import SIDE, Usefulness
from photonfarm.renderer.bdpt.launches import LAUNCH_PATHS, Lanes, Launch, launches
from photonfarm.renderer.bdpt.light_paths import PathOptions, trace_light_paths
from photonfarm.renderer.bdpt.lights.emission import Lights, read_lights
from photonfarm.renderer.bdpt.poses import Places, Poses
from photonfarm.renderer.bdpt.recording import Recorders, call_recorded
from photonfarm.renderer.bdpt.scenes import bounding_box, check_scene

UNBOUNDED = 0xFFFFFFFF
"""The longest path, in edges, where there is no bound."""

SomeLanes = TypeVar("SomeLanes", bound=Lanes)


class BidirectionalPathTracer(mi.SamplingIntegrator):
    """Bidirectional path tracer whose expected image is that of Mitsuba's ``path``, whatever its parameters are.

    - ``max_depth`` (int, default -1): longest path in edges, -1 unbounded; 1 shows lights only, 2 direct light, as
      in ``path``.
    - ``rr_depth`` (int, default 5): edges after which Russian roulette begins, as in ``path``; paths that have lost
      most of their throughput meet it before.
    - ``connections`` (int from 0 to 64, default 1): light vertices that the first two eye vertices are connected to,
      later ones to half as many. Needs ``light_ratio`` > 0.
    - ``light_ratio`` (float from 0 to 64, default 1): light paths per eye path, fractions allowed; 0 leaves a plain
      path tracer.
    - ``light_samples`` (int from 1 to 64, default 1): samples of the lights by next event estimation at the first eye
      vertex, where most noise of direct light comes from; later vertices take one.
    - ``guided_light`` (bool, default false): let light paths start where they reach what the camera sees, and draw
      their vertices for connections by how much these add to the image. `render` learns a guide from a few paths of its
      own first, unless it is given one by `learn_guide`. Needs ``light_ratio`` > 0.
    - ``record`` (bool, default false): trace each kind of launch once with Python and replay it afterwards, which saves
      up to 0.8 s an image in scenes of many materials. For scenes that stay as they are, or that are edited with arrays
      in Dr.Jit's own memory only: Dr.Jit 1.5 does not notice when a mesh gets other memory of numpy's.
    - ``paths_at_once`` (int, default 2²⁰): the most eye or light paths in a launch of several images. It changes no
      value beyond the order of sums; a card wants more of them than a processor.

    Raises ValueError for a value outside these ranges, and when it renders for what it cannot render without bias.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        max_depth = _number(props, "max_depth", -1, -1)
        self.max_depth = UNBOUNDED if max_depth == -1 else max_depth
        self.rr_depth = _number(props, "rr_depth", 5, 1)
        self.connections = _number(props, "connections", 1, 0, 64)
        self.light_ratio = _number(props, "light_ratio", 1.0, 0, 64)
        self.light_samples = _number(props, "light_samples", 1, 1, 64)
        self.paths_at_once = _number(props, "paths_at_once", LAUNCH_PATHS, 1)
        self.guided_light, record = _yes_or_no(props, "guided_light"), _yes_or_no(props, "record")
        for name in ("connections", "guided_light"):
            if getattr(self, name) and not self.light_ratio:
                raise ValueError(
                    f"bdpt: {name} is {getattr(self, name)} and light_ratio is 0; it needs light paths; use a "
                    f"light_ratio above 0, or {name}={'false' if name == 'guided_light' else 0}"
                )
        if self.hide_emitters:
            raise ValueError(
                "bdpt: hide_emitters is set; only false is allowed, because light paths cannot know what is hidden"
            )
        self._recorders = Recorders() if record else None

    def to_string(self) -> str:
        """The integrator and its parameters in Mitsuba's notation."""
        depth = -1 if self.max_depth == UNBOUNDED else self.max_depth
        return (
            f"BidirectionalPathTracer[max_depth={depth}, rr_depth={self.rr_depth}, connections={self.connections}, "
            f"light_ratio={self.light_ratio}, light_samples={self.light_samples}, guided_light={self.guided_light}]"
        )

    def render(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor | int = 0,
        seed: mi.UInt32 | int = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
        guide: PathGuide | None = None,
    ) -> mi.TensorXf:
        """The image [H, W, C] of linear radiance. Raises ValueError for scenes, sensors and films it cannot render.

        ``sensor`` is a sensor or the number of one; ``spp`` of 0 stands for the samples per pixel of its sampler.
        A ``guided_light`` integrator without a ``guide`` learns one for this image.
        """
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        film = sensor.film()
        seed = int(seed if isinstance(seed, int) else seed[0])
        images = self._render(scene, sensor, [seed], spp or sensor.sampler().sample_count(), guide)
        with dr.suspend_grad():
            film.prepare([])
            images.put(film)
            if not develop:
                return mi.TensorXf()
            image = film.develop()
            if evaluate:
                dr.eval(image)
            return image

    def render_seeds(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor,
        seeds: Sequence[int],
        spp: int,
        guide: PathGuide | None = None,
        places: Places | None = None,
    ) -> mi.TensorXf:
        """Independent images, [K, H, W, 3], one for each seed; several small images share a launch.

        Without ``places`` all are of one view. Each equals the image that ``render`` gives for its seed. On one thread
        it is equal bit by bit if the numbers of an image's samples and light paths are multiples of 16, the lanes of a
        SIMD packet. Otherwise sums may differ by their order.

        With ``places``, of one for each image, the ``sensor`` stands at the origin, and is moved to each of them. An
        image has the random numbers that it has alone, and differs from it by rounding: a path near an edge may fall to
        its other side.

        A ``guided_light`` integrator without a ``guide`` learns one for each image. Raises as ``render`` does.
        """
        width, height = sensor.film().crop_size()
        return self._render(scene, sensor, seeds, spp, guide, places).tensor(width, height)

    def learn_guide(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor,
        seed: int,
        places: Places | None = None,
        effort: Effort | None = None,
    ) -> PathGuide | None:
        """A guide to what a sensor sees, or sees from several ``places``, for light paths and for connections.

        It is learned from random numbers of its own, so images that are rendered with it stay independent of each
        other, and unbiased. None without ``guided_light``, and where there are no light paths to guide. Raises as
        ``render`` does.
        """
        if not (self.guided_light and self._has_light_paths(scene)):
            return None
        self._check(scene, sensor)
        effort = effort or Effort()
        with dr.suspend_grad():
            width, height = (int(n) for n in sensor.film().crop_size())
            lights = read_lights(scene)
            layout = Layout.of(lights.count)
            lights = lights.guide_with(StartGuide.neutral(layout), scene)
            views = 1 if places is None else len(places)
            launch = Launch(views, 0, 1, 0, max(1, effort.light_paths // views), 0)
            options = self._options(launch, width * height)
            options = replace(options, light_ratio=dr.opaque(mi.Float, self.light_ratio))
            seeds = randomness.learning_seeds(seed & 0xFFFFFFFF, views)
            lanes = self._lanes(SparseLanes, launch, (width, height), 1, seeds, places, options)
            lanes.thin(effort.eye_paths // views)
            grid = Grid.over(bounding_box(scene), SIDE)
            images, totals = self._call(explore, scene, sensor, lights, options, lanes, grid)
            return learn(layout, lights.emit_probability, images, totals, lanes)

    def _has_light_paths(self, scene: mi.Scene) -> bool:
        return bool(self.light_ratio > 0 and self.max_depth > 2 and scene.emitters())

    def _check(self, scene: mi.Scene, sensor: mi.Sensor) -> None:
        sensor.sampler().seed(0, 1)  # else the state left by another integrator would be evaluated with our input
        check_scene(scene, light_paths=self.light_ratio > 0)
        check_sensor(sensor, light_tracing=self.light_ratio > 0)

    def _render(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor,
        seeds: Sequence[int],
        spp: int,
        guide: PathGuide | None,
        places: Places | None = None,
    ) -> ImageStack:
        self._check(scene, sensor)
        if guide is not None and not self.guided_light:
            raise ValueError("bdpt: a guide is given and guided_light is false; use guided_light=true, or no guide")
        width, height = (int(n) for n in sensor.film().crop_size())
        pixels = width * height
        images = ImageStack.black(len(seeds) * pixels)
        if self.guided_light and guide is None and len(seeds) > 1:  # each image is rendered alone, by its own guide
            for k, seed in enumerate(seeds):
                place = None if places is None else places[k : k + 1]
                images.add(self._render(scene, sensor, [seed], spp, None, place), k * pixels)
            return images
        with dr.suspend_grad():
            seeds = [seed & 0xFFFFFFFF for seed in seeds]
            if self.guided_light and guide is None:
                effort = Effort.for_image(pixels * spp, self.light_ratio, self.connections)
                guide = self.learn_guide(scene, sensor, seeds[0], places, effort)
            lights = read_lights(scene) if scene.emitters() else None
            light_ratio = self.light_ratio if self._has_light_paths(scene) else 0
            useful = None
            if lights is not None and guide is not None and light_ratio:
                lights = lights.guide_with(guide.starts, scene)
                if guide.usefulness_table is not None and self.connections:
                    useful = Usefulness.over(scene, guide.usefulness_table)
            for launch in launches(len(seeds), pixels, spp, light_ratio, self.paths_at_once):
                options = self._options(launch, pixels, useful)
                own = slice(launch.first_image, launch.first_image + launch.images)
                own_places = None if places is None else places[own]
                lanes = self._lanes(Lanes, launch, (width, height), spp, seeds[own], own_places, options)
                part = self._call(trace, scene, sensor, lights, options, lanes)
                images.add(part, launch.first_image * pixels)
            return images

    def _lanes(
        self,
        kind: type[SomeLanes],
        launch: Launch,
        size: tuple[int, int],
        spp: int,
        seeds: Sequence[int],
        places: Places | None,
        options: PathOptions,
    ) -> SomeLanes:
        shifts = randomness.shifts(seeds, launch, self.connections) if options.connects else None
        poses = None if places is None else Poses.of(places)
        return kind.of(launch, size, spp, randomness.image_keys(seeds), shifts, poses)

    def _call(
        self,
        function: Callable[..., Any],
        scene: mi.Scene,
        sensor: mi.Sensor,
        lights: Lights | None,
        options: PathOptions,
        lanes: Lanes,
        *more: Any,
    ) -> Any:
        clipping = sensor.near_clip(), sensor.far_clip()
        kind = (lanes.kind, options.kind, lights.kind_of_kernels if lights else None, clipping)
        return call_recorded(self._recorders, function, kind, scene, sensor, lights, options, lanes, *more)

    def _options(self, launch: Launch, pixels: int, useful: Usefulness | None = None) -> PathOptions:
        connects = self.connections > 0 and launch.light_paths > 0
        count = connection_count(self.connections, self.max_depth, guided=self.guided_light) if connects else 0.0
        return PathOptions(
            max_depth=self.max_depth,
            rr_depth=self.rr_depth,
            connections=self.connections,
            count=dr.opaque(mi.Float, count),
            light_ratio=dr.opaque(mi.Float, launch.light_paths / (pixels * launch.samples)),
            connects=connects,
            traces_light=launch.light_paths > 0,
            light_samples=self.light_samples,
            useful=useful,
        )


def explore(
    scene: mi.Scene, sensor: mi.Sensor, lights: Lights, options: PathOptions, lanes: SparseLanes, grid: Grid
) -> tuple[ImageStack, Totals]:
    """(images, totals of a `Tally`) of a launch from which a guide is learned; ``grid`` is that of a `Usefulness`."""
    tally = Tally.empty(Layout.of(lights.count), grid, lanes)
    images = trace(scene, sensor, lights, options, lanes, tally)
    dr.eval(tally.totals)
    return images, tally.totals


def trace(
    scene: mi.Scene,
    sensor: mi.Sensor,
    lights: Lights | None,
    options: PathOptions,
    lanes: Lanes,
    tally: Tally | None = None,
) -> ImageStack:
    """Trace the light paths and the eye paths of a launch; a recording runs it once for each kind of launch.

    What the light paths add is noted in ``tally``.
    """
    splats, sums = (Sums.zero(lanes.images * lanes.pixels) for _ in range(2))
    vertices = None
    if lights is not None and options.traces_light:
        image, path = lanes.light()
        sequence = randomness.stream(dr.gather(mi.UInt32, lanes.keys, image), randomness.LIGHT)
        note_splat = None if tally is None else tally.make_note_splat(image, options.light_ratio)
        splat = Splat(splats, lanes.splat_scale, image * lanes.pixels, lanes.width, lanes.height, note_splat)
        rng = randomness.sampler(sequence, path + lanes.first_light_path)
        offset = randomness.sampler(randomness.stream(lanes.keys, randomness.SLOTS), lanes.first_light_path)
        vertices = trace_light_paths(
            scene,
            lanes.place(sensor, image),
            lights,
            options,
            rng=rng,
            path=path,
            paths=lanes.counts[2],
            offset=offset.next_independent(),
            splat=splat,
            tally=tally,
        )
        dr.eval(splats)  # a kernel of its own: one kernel with both loops is 5 % slower

    image, sample, pixel = lanes.eye()
    keys = dr.gather(mi.UInt32, lanes.keys, image)
    sequence = randomness.stream(keys, randomness.EYE, pixel)
    rng = randomness.sampler(sequence, sample + lanes.first_sample)
    start = primary_rays(lanes.place(sensor, image), rng, pixel, joined=options.traces_light)
    connectable = None
    if vertices is not None:
        first = lanes.partner(sample, randomness.places(keys, sample + lanes.first_sample, pixel))
        note = None if tally is None else tally.make_note_connection(image, pixel)
        connectable = Connectable(vertices, lanes.counts[2], image, first, lanes.shifts, note)
    radiance, hit = trace_eye_paths(scene, lights, options, rng=rng, start=start, connectable=connectable)

    sums.add(image * lanes.pixels + pixel, radiance * lanes.eye_scale, dr.select(hit, lanes.eye_scale, 0))
    dr.eval(sums, splats)
    images = sums.images()
    images.radiance += splats.images().radiance
    dr.eval(images)
    return images


def connection_count(connections: int, max_depth: int, *, guided: bool) -> float:
    """The technique count of connections: n_C over a nominal number of vertices per light path, 3 at most.

    A connection gets one of a path's vertices at random, so each technique (s, t) gets about n_C/length of them.
    Every constant keeps the estimate unbiased, as counts only change the weights. About 3 was the mean length in the
    closed rooms that were measured. Where vertices are drawn by their usefulness, each connection is worth more, and
    n_C itself was best.
    """
    return connections / (1 if guided else min(3, max(1, max_depth - 2)))


def _number(props: mi.Properties, name: str, default: float, least: int, most: float = math.inf) -> Any:
    """A number of the plugin's parameters, whole if its default is; raises ValueError for anything else."""
    value, whole = props.get(name, default), isinstance(default, int)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or (whole and value != value // 1) or not least <= value <= most:
        kind, bound = "whole numbers" if whole else "numbers", f" to {most}" if most < math.inf else ""
        raise ValueError(f"bdpt: {name} is {value!r}; allowed are {kind} from {least}{bound}")
    return type(default)(value)


def _yes_or_no(props: mi.Properties, name: str) -> bool:
    """A Boolean of the plugin's parameters, false by default; raises ValueError for anything else."""
    value = props.get(name, False)
    if not isinstance(value, bool):
        raise ValueError(f"bdpt: {name} is {value!r}; allowed are true and false")
    return value


mi.register_integrator("bdpt", lambda props: BidirectionalPathTracer(props))
