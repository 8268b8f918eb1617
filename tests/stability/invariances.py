"""Changes that must not change an image: technique counts, the grouping of lights, units, the history of a scene.

Also the promises about equal seeds. `checks` yields all of them by name, quick or long; each runs by itself, reports
its figures, and can be repeated with `command`. Equal seeds give equal bytes with one thread only
(`backend.load(threads=1)`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from photonfarm.core.statistics import BlockTest, block_z_test
from tests.stability.runner import ROUNDING, SIGNIFICANCE, plus_minus
from tests.stability.scenes import hard_scenes
from tests.stability.scenes.cameras import scaled
from tests.stability.scenes.case import ALL, TRUTH_SEEDS, BdptSettings, Effort, Images, SceneDict, load, render
from tests.stability.weights import weight_check

QUICK = Effort(size=16, blocks=4, seeds=8, spp=32, truth_spp=128, resolution=0.02)
LONG = Effort(size=32, blocks=8, seeds=16, spp=128, truth_spp=512, resolution=0.005)
DEPTH = 5
COUNTS = tuple(BdptSettings(c, r) for c, r in product((0, 1, 4), (0.0, 0.25, 1.0, 4.0)) if r or not c)
"""(connections, light_ratio) whose images must have equal means; connections without light paths are refused."""
_SKEWED = ("glass_caustic", "floor_caustic", "mirror_room")
"""The scenes with rare bright samples, for which a few renders prove too little; they have rows of their own."""
_LANES = {False: 256, True: 8192}  # primary rays for the weights' check


@dataclass(frozen=True, slots=True)
class Invariance:
    """A property that must hold."""

    name: str
    claim: str  # what must hold
    run: Callable[[], tuple[list[str], str]]  # renders what it needs; (why it failed, what was measured in words)
    long: bool

    @property
    def command(self) -> str:
        """The command that runs it again."""
        return f"python -m tests.stability --invariances {self.name}" + " --quick" * (not self.long)


def checks(*, long: bool) -> Iterator[Invariance]:
    """All invariances; the long version renders more scenes, with tighter limits."""
    effort = LONG if long else QUICK
    for kind, claim, find, quick, more in _KINDS:
        for name in (*quick, *more) if long else quick:
            check = partial(find, hard_scenes.HARD_SCENES[name], effort)
            yield Invariance(f"{kind}-{name.replace('_', '-')}", claim, check, long)
    for factor in _NEAR_SCALED:
        claim = "lengths times a factor give the same image"
        yield Invariance(f"scale-{factor:g}", claim, partial(scale, factor, effort), long)
    for name, build in (weight_check.LONG_SCENES if long else weight_check.SCENES).items():
        claim = "weights of one path sum to 1 and are the oracle's"
        yield Invariance(f"weights-{name}", claim, partial(oracles_weights, build, _LANES[long]), long)


def choose(names: Sequence[str], *, long: bool) -> list[Invariance]:
    """The checks of these names, or whose names begin with them; all for an empty choice.

    Raises ValueError for a name that matches none.
    """
    everything = list(checks(long=long))
    for name in names:
        if not any(check.name.startswith(name) for check in everything):
            known = ", ".join(dict.fromkeys(f"{check.name.partition('-')[0]}-" for check in everything))
            raise ValueError(f"no invariance is called {name!r} or begins so; they begin with {known}")
    return [check for check in everything if not names or check.name.startswith(tuple(names))]


# ------------------------------------------------ The checks ------------------------------------------------


def equal_means(build: Callable[[int], SceneDict], effort: Effort) -> tuple[list[str], str]:
    """Compare every pair of counts with the usual pair at more samples; the path tracer, (0, 0), may be noisy."""
    scene = load(build(effort.size))
    truth = _images(scene, ALL[0], effort, TRUTH_SEEDS, effort.truth_spp)
    faults, ratios = [], []
    for settings in COUNTS:
        wanted = effort if settings.light_ratio else replace(effort, resolution=np.inf)
        test, found = _compare(_images(scene, settings, effort, 0), truth, wanted)
        faults += [f"{settings}: {fault}" for fault in found]
        ratios.append(f"{settings}: {plus_minus(test.mean_ratio, test.mean_ratio_standard_error)}")
    return faults, "; ".join(ratios)


def additive(build: Callable[[int], SceneDict], effort: Effort) -> tuple[list[str], str]:
    """Compare the image of all lights with the sum of those of the even and the odd ones, switched off in place."""
    scene = load(build(effort.size))
    parameters = mi.traverse(scene)
    keys = _brightness_keys(parameters)
    lit = {key: mi.Color3f(parameters[key]) for key in keys}
    together = _images(scene, ALL[0], effort, 0)
    parts = []
    for half in (0, 1):
        for k, key in enumerate(keys):
            parameters[key] = lit[key] if k % 2 == half else mi.Color3f(0)
        parameters.update()
        parts.append(_images(scene, ALL[0], effort, TRUTH_SEEDS * (1 + half)))
    test, faults = _compare(together, parts[0] + parts[1], effort)
    shares = [float(part.mean() / together.mean()) for part in parts]
    faults += [f"half of the lights is {share:.1%} of the image: nothing to add" for share in shares if share < 0.02]
    return faults, f"{_ratio(test)}; the halves are {shares[0]:.1%} and {shares[1]:.1%}"


def linear(build: Callable[[int], SceneDict], effort: Effort) -> tuple[list[str], str]:
    """Compare images of lights 8 times as bright with the same seed, and 3 times as bright with other seeds.

    A factor of 8 changes only the exponents.
    """
    scene = load(build(effort.size))
    before = _images(scene, ALL[0], effort, 0)
    _brighten(scene, 8)
    off = _largest_difference(_images(scene, ALL[0], effort, 0), before * 8)
    faults = [f"times 8: a pixel is off by {off:.2g}, allowed is {_SUMS:g}"] if not off <= _SUMS else []
    _brighten(scene, 3 / 8)
    test, found = _compare(_images(scene, ALL[0], effort, TRUTH_SEEDS), before * 3, effort)
    return faults + found, f"times 8: largest difference {off:.2g}; times 3: {_ratio(test)}"


_SUMS = 1e-5
"""The largest relative difference of a pixel (see `_differences`) that float32 sums alone can cause."""
_NEAR = 1e-3
"""The relative difference below which two pixels count as near."""
_SHARE = 0.9
"""The share of pixels that must be near when both images have one seed; in the others a path met or missed an edge."""
_NEAR_SCALED = {1e3: _NEAR, 1e-3: 2e-2}
"""The same limit by scale factor: ray offsets shrink with the scene only down to a size of one unit."""


def scale(factor: float, effort: Effort) -> tuple[list[str], str]:
    """Compare the cove with a copy whose lengths are multiplied by a factor: with the same seeds, and with others."""
    images = _images(load(scaled(factor)(effort.size)), ALL[0], effort, 0)
    same = _images(load(scaled(1.0)(effort.size)), ALL[0], effort, 0)
    near = float(np.mean(_differences(images, same) < _NEAR_SCALED[factor]))
    faults = [f"with one seed {near:.1%} of the pixels are near, wanted are {_SHARE:.0%}"] if near < _SHARE else []
    others = _images(load(scaled(1.0)(effort.size)), ALL[0], effort, TRUTH_SEEDS)
    test, found = _compare(images, others, effort)
    return (
        faults + found,
        f"with one seed {near:.1%} of the pixels are within {_NEAR_SCALED[factor]:.1%}; with others {_ratio(test)}",
    )


def update_equals_reload(build: Callable[[int], SceneDict], effort: Effort) -> tuple[list[str], str]:
    """Compare scenes that are edited in place with scenes loaded anew: a dimmed light, then a moved box and camera.

    With the dimmed light the images must be equal bit by bit. With the moved box and camera the last bits differ:
    Embree stores moved meshes in another way than new ones, and Mitsuba inverts a camera's transform with another
    precision when it loads it.
    """
    step, new = [0.2, -0.1, 0.15], [0.2, -3.0, 1.1]
    at = mi.ScalarTransform4f().translate([-0.3, 0.2, 0.3]) @ mi.ScalarTransform4f().scale(0.2)
    view = mi.ScalarTransform4f().look_at(origin=new, target=[0, 0, 0.9], up=[0, 0, 1])
    box = {"type": "cube", "to_world": at, "bsdf": hard_scenes.grey(0.5)}
    start = {**build(effort.size), "box": box}
    scene = load(start)
    _images(scene, ALL[0], effort, 5)  # so that a stale state could show
    parameters = mi.traverse(scene)
    parameters["light.emitter.radiance.value"] = mi.Color3f(1.5, 2.0, 2.5)
    parameters.update()
    dimmed = _images(scene, ALL[0], effort, 0)
    vertices = dr.unravel(mi.Point3f, parameters["box.vertex_positions"])
    parameters["box.vertex_positions"] = dr.ravel(vertices + mi.Point3f(step))
    parameters["sensor.to_world"] = mi.Transform4f(view)
    parameters.update()
    moved = _images(scene, ALL[0], effort, 0)

    other = {**start, "light": {**start["light"], "emitter": hard_scenes.shining([1.5, 2.0, 2.5])}}
    unequal = float(np.mean(_images(load(other), ALL[0], effort, 0) != dimmed))
    sensor = {**start["sensor"], "to_world": view}
    scene = load({**other, "sensor": sensor, "box": {**box, "to_world": mi.ScalarTransform4f().translate(step) @ at}})
    near = float(np.mean(_differences(moved, _images(scene, ALL[0], effort, 0)) <= _NEAR))
    test, faults = _compare(moved, _images(scene, ALL[0], effort, TRUTH_SEEDS), effort)
    faults += [f"with one seed {unequal:.2%} of the values are unequal"] if unequal else []
    faults += [f"with one seed {near:.2%} of the pixels are near, wanted are {_SHARE:.0%}"] if near < _SHARE else []
    figures = f"unequal values with a dimmed light {unequal:.1%}; near pixels with box and camera moved {near:.1%}"
    return faults, f"with one seed: {figures}; with others {_ratio(test)}"


def reproducible(build: Callable[[int], SceneDict], effort: Effort) -> tuple[list[str], str]:
    """Render a seed twice with another seed between, and both at once; equal seeds must give equal bytes."""
    scene = load(build(effort.size))
    faults = []
    for settings in ALL:
        plugin = mi.load_dict(_integrator(settings))
        first, other, again = (
            np.array(plugin.render(scene, seed=seed, spp=effort.spp))[None, ..., :3] for seed in (3, 9, 3)
        )
        together = np.array(plugin.render_seeds(scene, scene.sensors()[0], [9, 3], effort.spp))
        if not np.array_equal(first, again):
            faults.append(f"{settings}: one seed gives two images")
        if not np.array_equal(together, np.concatenate([other, first])):
            faults.append(f"{settings}: render_seeds gives other images than render")
        if np.array_equal(first, other):
            faults.append(f"{settings}: two seeds give one image")
    return faults, f"{len(ALL)} settings"


def recorded(build: Callable[[int], SceneDict], effort: Effort) -> tuple[list[str], str]:
    """Compare recorded launches with traced ones bit by bit, after changes of seeds, samples, lights and camera."""
    scene = load(build(effort.size))
    parameters, sensor = mi.traverse(scene), scene.sensors()[0]
    key = _brightness_keys(parameters)[0]
    lit = mi.Color3f(parameters[key])
    plugins = [mi.load_dict({**_integrator(ALL[0]), "record": record}) for record in (True, False)]
    view = mi.Transform4f().look_at(origin=[0.2, -3.0, 1.1], target=[0, 0, 0.9], up=[0, 0, 1])
    dr.make_opaque(view)
    steps: list[tuple[str, tuple[int, ...], int, dict[str, Any]]] = [
        ("first", (1,), 8, {}),
        ("another seed", (2,), 8, {}),
        ("several seeds", (3, 4, 5), 8, {}),
        ("other samples", (3,), 5, {}),
        ("dimmed", (6,), 8, {key: lit * 0.3}),
        ("dead", (7,), 8, {key: lit * 0}),
        ("lit again", (7,), 8, {key: lit}),
        ("moved", (8,), 8, {"sensor.to_world": view}),
        ("first again", (1,), 8, {}),
    ]
    faults = []
    for name, seeds, spp, edits in steps:
        for edited, value in edits.items():
            parameters[edited] = value
            dr.make_opaque(parameters[edited])
        if edits:
            parameters.update()
        ours, anew = (np.array(plugin.render_seeds(scene, sensor, seeds, spp)) for plugin in plugins)
        if not np.array_equal(ours, anew):
            faults.append(
                f"{name}: {np.mean(ours != anew):.1%} of the values differ, by up to "
                f"{_largest_difference(ours, anew):.2g}"
            )
    return faults, f"{len(steps)} renders"


def oracles_weights(build: Callable[[int], SceneDict], lanes: int) -> tuple[list[str], str]:
    """Compare the integrator's weights of traced paths with the oracle's; see `weight_check`."""
    faults, figures = [], []
    for settings in ALL:
        found = weight_check.compare_weights(build, settings, lanes=lanes)
        faults += [f"{settings}: {fault}" for fault in found.faults]
        figures.append(
            f"{settings}: {found.paths} paths ({found.with_delta} with a mirror or glass), "
            f"sums within {found.sum_error:.1g}, weights within {found.weight_error:.1g}"
        )
    return faults, "; ".join(figures)


_MANY = ("many_lights",)
_KINDS: tuple[tuple[str, str, Callable[..., tuple[list[str], str]], tuple[str, ...], tuple[str, ...]], ...] = (
    (
        "counts",
        "every (connections, light_ratio) gives the same mean",
        equal_means,
        ("plastics", *_MANY),
        tuple(n for n in hard_scenes.HARD_SCENES if n not in (*_SKEWED, "plastics", *_MANY)),
    ),
    (
        "additive",
        "the image of all lights is the sum of the images of two halves of them",
        additive,
        _MANY,
        ("hundred_lights",),
    ),
    (
        "linear",
        "radiances times a factor give the image times it",
        linear,
        _MANY,
        ("plastics", "rotated_envmap", "mirror_room"),
    ),
    (
        "update",
        "a scene edited in place gives the image of the same loaded anew",
        update_equals_reload,
        _MANY,
        ("cove",),
    ),
    (
        "seed",
        "one seed gives one image, alone or among others, bit by bit",
        reproducible,
        _MANY,
        ("cornell", "plastics", "glass_caustic", "cove"),
    ),
    (
        "recorded",
        "launches that are recorded give the images of those that are traced anew",
        recorded,
        _MANY,
        ("cornell", "glass_caustic", "cove"),
    ),
)
"""Kinds of checks: name, claim, function of a scene, scenes of the quick version, and those that the long one adds."""


# ------------------------------------------------ Their parts ------------------------------------------------


def _integrator(settings: BdptSettings) -> dict[str, Any]:
    return {"type": "bdpt", "max_depth": DEPTH, **settings.parameters}


def _images(scene: Any, settings: BdptSettings, effort: Effort, seed: int, spp: int | None = None) -> Images:
    return render(scene, _integrator(settings), spp or effort.spp, range(seed, seed + effort.seeds))


def _compare(a: Images, b: Images, effort: Effort) -> tuple[BlockTest, list[str]]:
    """The block z-test of two sets of images, and its faults."""
    tests = [block_z_test(a, b, blocks, SIGNIFICANCE, ROUNDING) for blocks in (effort.blocks, 1)]
    faults = [f"|z| is {test.z_max:.2f}, the limit {test.z_limit:.2f}" for test in tests if not test.passed]
    if not tests[0].mean_ratio_standard_error <= effort.resolution:
        faults.append(f"too noisy to tell: {_ratio(tests[0])}, allowed is ± {effort.resolution:g}")
    return tests[0], faults


def _ratio(test: BlockTest) -> str:
    ratio = plus_minus(test.mean_ratio, test.mean_ratio_standard_error)
    return f"mean ratio {ratio}, largest z {test.z_max:.1f}"


def _differences(a: Images, b: Images) -> Images:
    """The differences, [K, H, W, 3], relative to the pixel or, if that is dark, to the mean."""
    return np.asarray(np.abs(a - b) / np.maximum(np.abs(b), np.mean(b)))


def _largest_difference(a: Images, b: Images) -> float:
    return float(_differences(a, b).max())


def _brightness_keys(parameters: Any) -> list[str]:
    names = ("radiance.value", "intensity.value", "irradiance.value", "radiance.data")
    return [key for key in parameters.keys() if key.endswith(names)]  # noqa: SIM118 - no mapping


def _brighten(scene: Any, factor: float) -> None:
    parameters = mi.traverse(scene)
    keys = _brightness_keys(parameters)
    keys += [f"{name}.scale" for name in ("sky",) if f"{name}.scale" in parameters]  # environment maps
    for key in keys:
        parameters[key] = parameters[key] * factor
    parameters.update()
