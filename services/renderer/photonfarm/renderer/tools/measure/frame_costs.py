"""`photonfarm measure-frames`: the cost of the parts of one frame on this machine, and the surfaces in its pixels.

A part is timed until its result is in numpy's memory, in a process whose thread pool is one thread: by what the
processor spends on it, so that other load does not count, and on a card by the clock.

*Images of 1/k of the pixels* tell the cost of rendering only the pixels that a method keeps. They stand for some pixels
of the whole image: the same field of view on a smaller film, with as many light paths as the whole image has, since
their splats cannot be limited to some of its pixels. The integrator allows 64 light paths per eye path at most, so that
the cost of an image that would need more is too low. Sides are rounded to whole pixels, so that the image may have a
few more or fewer than 1/k.

*The kind of the first surface* at each pixel's centre goes by the lobes that its BSDF has. Flags describe a whole BSDF
and not a point on it: a blend or a `principled` whose glossy part is textured away somewhere is glossy there too, and a
two-sided surface has the lobes of both sides. A null lobe, which masks have beside the lobes of what they mask, lets
light pass unchanged, and does not count as a coat.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import cycle, islice
from math import sqrt
from pathlib import Path
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from photonfarm.core.archives import PARTS, FrameCosts, Surface
from photonfarm.core.errors import IncompleteError, StoreError
from photonfarm.core.formatting import format_count
from photonfarm.core.keys import Key, view_key
from photonfarm.core.records import F32, BasePointCloud, arrays_of
from photonfarm.renderer.jobs.estimates import photons_of
from photonfarm.renderer.jobs.render import lit_points
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.loaded_scene import LoadedScene, integrator_of
from photonfarm.renderer.scene.loading import AimedSensor
from photonfarm.renderer.scene.view_rays import ViewCameras
from photonfarm.scene.modification import Modification, rebuild, rest
from photonfarm.scene.spec import GuideSpec, SceneSpec
from photonfarm.scene.spec_loading import locate
from photonfarm.scene.view import View
from photonfarm.store import SceneReader, Store
from photonfarm.store.read.find import scene_named


def surface_kinds(scene: Any, view: View, spec: SceneSpec) -> NDArray[np.uint8]:
    """The kind of surface at each pixel's centre, (H, W) of `Surface`, between the view's clipping planes."""
    si = scene.ray_intersect(ViewCameras.of([view], spec).pixels().ray(0.5, 0.5).ray)
    kind = dr.select(si.shape.is_emitter(), mi.UInt32(Surface.EMITTER), _kind_of_lobes(si.bsdf().flags()))
    kinds = np.array(dr.select(si.is_valid(), kind, int(Surface.NOTHING)))
    return kinds.astype(np.uint8).reshape(spec.film.height, spec.film.width)


def _kind_of_lobes(flags: Any) -> Any:
    """The kind DIFFUSE, SPECULAR or MIRROR (UInt32), by a BSDF's flags."""
    diffuse = mi.has_flag(flags, mi.BSDFFlags.Diffuse)
    glossy = mi.has_flag(flags, mi.BSDFFlags.Glossy)
    delta = mi.has_flag(flags, mi.BSDFFlags.DeltaReflection) | mi.has_flag(flags, mi.BSDFFlags.DeltaTransmission)
    specular = glossy | (diffuse & delta)
    unmixed = dr.select(diffuse, mi.UInt32(Surface.DIFFUSE), mi.UInt32(Surface.MIRROR))
    return dr.select(specular, mi.UInt32(Surface.SPECULAR), unmixed)


MOST_LIGHT_PATHS = 64.0
"""The most light paths per eye path that the integrator allows."""


class PartialFilm:
    """A film of about 1/k of the pixels of a spec's, and their integrator; k = 1 gives the spec's own images.

    Each pixel has `halves` times the samples of a half-estimate.
    """

    def __init__(self, spec: SceneSpec, k: int, halves: int = 1) -> None:
        transport = spec.transport.model_copy(update={"half_spp": halves * spec.transport.half_spp})
        self.spec = part_of(spec.model_copy(update={"transport": transport}), k)
        self._sensor = AimedSensor(self.spec)
        self._integrator = integrator_of(self.spec.transport)

    def render(self, scene: Any, view: View, seed: int) -> F32:
        """One half-estimate of linear radiance of a Mitsuba scene, (h, w, 3)."""
        half_spp = self.spec.transport.half_spp
        images = self._integrator.render_seeds(scene, self._sensor.aim(view), (seed,), half_spp)
        return np.array(images, np.float32)[0]


def part_of(spec: SceneSpec, k: int) -> SceneSpec:
    """The spec with about 1/k of the pixels, in about the same proportions, and as many light paths in all."""
    pixels = spec.film.width * spec.film.height
    height = max(1, round(spec.film.height / sqrt(k)))
    width = max(1, round(pixels / (k * height)))
    light_ratio = min(spec.transport.light_ratio * pixels / (width * height), MOST_LIGHT_PATHS)
    film = spec.film.model_copy(update={"width": width, "height": height})  # sides need not be divisible by 8
    transport = spec.transport.model_copy(update={"light_ratio": light_ratio})
    return spec.model_copy(update={"film": film, "transport": transport})


WARM_UPS = 2
"""The untimed first frames: the first compiles kernels, the second is the first to replay recorded launches."""

Amount = tuple[int, int]
"""k and n: of one in k pixels, n times the samples of a half-estimate."""

T = TypeVar("T")
Clock = Callable[[], float]


@dataclass(frozen=True, slots=True, eq=False)
class TimedFrame:
    """The configuration and the view of a row of the store."""

    row: int
    modification: Modification
    view: View
    key: Key  # of the modification


def write_frame_costs(
    store: str | Path,
    scene: str,
    rows: Sequence[int],
    amounts: Sequence[Amount],
    timed: int,
    points: int | None,
    out: Path,
    seconds: float = math.inf,
) -> FrameCosts:
    """Measure some rows of a scene into a file, with the first `points` of its base cloud, or all of them.

    The backend must have been loaded, with one thread.
    Raises StoreError for a scene or a row that the store does not hold, IncompleteError for a row that is not complete,
    SceneNotHereError if the scene's files are not on this machine.
    """
    opened = Store(store)
    reader = SceneReader(store, scene_named(opened, scene))
    reader.refresh()
    _check_complete(reader, rows)
    frames = [TimedFrame(row, *reader.inputs(row)[:2], reader.modification_key(row)) for row in rows]
    cloud, spec = reader.base()[1], locate(reader.spec)
    used: dict[str, Any] = {name: values[:points] for name, values in arrays_of(cloud).items()}
    costs = frame_costs(LoadedScene.load(spec), replace(cloud, **used), frames, amounts, timed, seconds)
    costs.write(out)
    return costs


def _check_complete(reader: SceneReader, rows: Sequence[int]) -> None:
    planned = max((plan["first_row"] + plan["samples"] for plan in reader.plan_requests), default=0)
    if max(rows) >= planned:
        raise StoreError(
            f"there is no row {max(rows)}; scene {reader.spec.scene_id} has {format_count(planned, 'row')}, and the "
            "first is 0"
        )
    if missing := sorted(set(rows) - set(reader.rows.tolist())):
        raise IncompleteError(
            f"row {missing[0]} of scene {reader.spec.scene_id} is not complete; {len(reader.rows)} of "
            f"{reader.planned} planned rows are, which `photonfarm store find` shows"
        )


def frame_costs(
    scene: LoadedScene,
    cloud: BasePointCloud,
    frames: Sequence[TimedFrame],
    amounts: Sequence[Amount],
    timed: int,
    seconds: float = math.inf,
) -> FrameCosts:
    """The surfaces of all frames, and the times of `timed` of them and of images of so many pixels and samples.

    If there are fewer frames than are timed, they are repeated. After so many `seconds`, from the first one that
    counts, no further one is begun.
    """
    films = [PartialFilm(scene.spec, *amount) for amount in amounts]
    surface = []
    for frame in frames:
        scene.apply(frame.modification)
        surface.append(surface_kinds(scene.scene, frame.view, scene.spec))
    parts, render_s = np.split(_seconds(scene, cloud, films, frames, timed, seconds), [len(PARTS)])
    return FrameCosts(
        scene.spec.scene_id,
        np.array([frame.row for frame in frames], np.int64),
        np.stack(surface),
        **dict(zip(PARTS, parts, strict=True)),
        kept=np.array([k for k, _ in amounts], np.int64),
        halves=np.array([halves for _, halves in amounts], np.int64),
        render_s=render_s,
    )


def take_turns(frames: Sequence[TimedFrame]) -> Iterator[TimedFrame]:
    """The frames without end, one of each configuration in turn: neighbours differ in it, unless all have the same."""
    of_configuration: dict[Key, list[TimedFrame]] = {}
    for frame in frames:
        of_configuration.setdefault(frame.key, []).append(frame)
    for turn in cycle([cycle(alike) for alike in of_configuration.values()]):
        yield next(turn)


def _seconds(
    scene: LoadedScene,
    cloud: BasePointCloud,
    films: Sequence[PartialFilm],
    frames: Sequence[TimedFrame],
    timed: int,
    seconds: float,
) -> NDArray[np.float64]:
    """The times of each of `PARTS` and of a half-estimate on each film, (parts and films, timed frames)."""
    until = math.inf
    stays = len({frame.key for frame in frames}) == 1
    measured: list[list[float]] = []
    for seed, frame in enumerate(islice(take_turns(frames), WARM_UPS + timed)):
        if seed == WARM_UPS:
            until = time.perf_counter() + seconds
        elif seed > WARM_UPS and time.perf_counter() > until:
            break
        if stays:  # else there would be nothing to edit
            scene.apply(rest(scene.spec))
        parts = time_parts(scene, cloud, frame.modification, frame.key, frame.view, backend.work_s)
        renders = [partial(film.render, scene.scene, frame.view, seed) for film in films]
        render_s = [time_work(render, backend.work_s)[0] for render in renders]
        measured.append([*(parts[name] for name in PARTS), *render_s])
    return np.array(measured[WARM_UPS:]).T


def time_parts(
    scene: LoadedScene, cloud: BasePointCloud, modification: Modification, key: Key, view: View, clock: Clock
) -> dict[str, float]:
    """Seconds of each of `PARTS`, by a clock; `key` is the modification's. Photons of a scene without take none."""
    seconds: dict[str, float] = {}

    def timed(name: str, work: Callable[[], T]) -> T:
        seconds[name], result = time_work(work, clock)
        return result

    timed("edit_s", partial(_edit, scene, modification))
    timed("buffers_s", partial(scene.buffers, view))
    guided = view_key(key, view.vector)

    def inputs(wanted: GuideSpec) -> object:
        return scene.inputs([view], [guided], wanted, lit_points(cloud, modification))

    timed("surface_s", partial(inputs, scene.spec.guides.without_shadows()))
    timed("guides_s", partial(inputs, scene.spec.guides))
    timed("points_s", lambda: scene.sees([view], rebuild(cloud, modification)[0]))
    photons = timed("photons_s", lambda: photons_of(scene, key)[0])
    if photons is None:
        return seconds | {"photons_s": 0.0, "photons_seen_s": 0.0}
    timed("photons_seen_s", lambda: scene.sees([view], photons.position))
    return seconds


def _edit(scene: LoadedScene, modification: Modification) -> None:
    scene.apply(modification)
    dr.sync_thread()  # pending evaluations would be charged to the view


def time_work(work: Callable[[], T], clock: Clock) -> tuple[float, T]:
    """The seconds of some work, by a clock, and its result."""
    begun = clock()
    result = work()
    return clock() - begun, result
