"""`photonfarm scene cost`: what samples of a scene cost on this machine, and how noisy they are.

Times are CPU times of a process whose thread pool is one thread, until a part's result is in numpy's memory: the time
of a worker without what it does once for a scene, and without storing.
"""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from photonfarm.core.errors import IncompleteError, StoreError
from photonfarm.core.files import write_whole
from photonfarm.core.formatting import format_count
from photonfarm.core.records import BasePointCloud
from photonfarm.core.waiting import Log, Steps, WorkLog
from photonfarm.plan.sample_costs import SampleCosts, relative_variance
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.renderer.strategy.budget import Budget
from photonfarm.renderer.strategy.measurement import digest_here, file_of
from photonfarm.renderer.tools.measure.frame_costs import WARM_UPS, time_parts, time_work
from photonfarm.scene.modification import sample_modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import sample_view

SEED = 0
"""The master seed of configurations and views, the same as the default of `submit`."""

FRAMES = 6
"""The default number of measured views."""

RANGE = 4
"""The ratio of samples between the two timed passes, which separates the fixed part from the cost of samples."""

MOST_PATHS = 1 << 21
"""The most eye paths of a half of the larger pass, unless one sample of each pixel needs more.

Clean images would take minutes, and beyond one launch of the integrator time is proportional to samples anyway.
"""

T = TypeVar("T")


def find_or_measure(
    spec: SceneSpec, beside: Path | None, frames: int, *, again: bool, log: Log, seconds: float = math.inf
) -> SampleCosts:
    """The costs kept from an earlier measurement here of as many frames; with `again`, or without one, measured now.

    In so many `seconds` of processor time, loading included, fewer frames may fit, and what they gave will do for them.
    The backend must have been loaded, with one thread. Raises SpecError and BackendError as loading does,
    IncompleteError if not even one view fits.
    """
    of = "sample costs", spec.scene_id, spec.transport.model_dump_json(), str(frames)
    whole, part = (file_of("costs", digest_here(*of, *also)) for also in ((), ("in few seconds",)))
    for file in [] if again else [whole, part] if math.isfinite(seconds) else [whole]:
        if (kept := _read_kept(file)) is not None:
            return kept
    with WorkLog(log) as work_log:
        work_log.begin(f"loading {spec.name}")
        budget = Budget(seconds)
        loaded = LoadedScene.load(spec, beside)
        costs, measured = costs_within(loaded, frames, budget, work_log)
    try:
        write_whole(whole if measured == frames else part, costs.json())
    except OSError as error:
        log(f"the measurement could not be kept: {error}")
    return costs


def _read_kept(file: Path) -> SampleCosts | None:
    try:
        return SampleCosts.read(file.read_bytes())
    except (OSError, StoreError):  # no measurement, or an unusable one
        return None


def measure_costs(spec: SceneSpec, frames: int = FRAMES) -> SampleCosts:
    """Load the scene of a spec, with a thread pool of one as workers have, and measure; raises as loading does."""
    backend.load(threads=1)
    return sample_costs(LoadedScene.load(spec), frames)


def sample_costs(scene: LoadedScene, frames: int, log: Log = lambda _: None) -> SampleCosts:
    """The medians over views of `frames` random configurations, one view of each, after some untimed ones."""
    with WorkLog(log) as work_log:
        return costs_within(scene, frames, Budget(math.inf), work_log)[0]


def costs_within(scene: LoadedScene, frames: int, budget: Budget, work_log: WorkLog) -> tuple[SampleCosts, int]:
    """The costs, and of how many frames; as many as the budget allows, and one at least after the one that compiles."""
    name, measured = scene.spec.name, list[dict[str, float]]()
    views = Steps(WARM_UPS + frames, slow=WARM_UPS)
    within = f", in about {budget.seconds:.0f} s of processor time in all" if math.isfinite(budget.seconds) else ""
    work_log.begin(
        f"measuring what samples of {name} cost here, in {format_count(frames, 'view')} after {WARM_UPS} that do not "
        f"count{within}",
        lambda: f"view {views.words()}",
    )
    cloud = scene.base()[1]
    last_s = 0.0
    for number in range(WARM_UPS + frames):
        if number > 1 and last_s > budget.left_s:  # the first one compiles, and never counts
            break
        before = budget.spent_s
        if not number and before > budget.seconds:
            raise IncompleteError(
                f"{name}: loading it took {before:.0f} s of processor time, more than the {budget.seconds:.0f} s for "
                "measuring its costs; `photonfarm scene cost` measures them without a limit, and keeps them"
            )
        measured.append(_measure_frame(scene, cloud, number))
        views.reach(len(measured))
        last_s = budget.spent_s - before
    measured = measured[min(WARM_UPS, len(measured) - 1) :]
    known = {key: [each[key] for each in measured if not math.isnan(each[key])] for key in measured[0]}
    medians = {key: float(np.median(values or [0.0])) for key, values in known.items()}
    return SampleCosts(scene.spec.scene_id, **medians), len(measured)


def _measure_frame(scene: LoadedScene, cloud: BasePointCloud, number: int) -> dict[str, float]:
    """What `SampleCosts` holds, in one view; the noise is NaN if nothing is seen, or values are not finite."""
    spec, few = scene.spec, fewer_samples(scene.spec)
    modification = sample_modification(spec, SEED, number)
    key = modification.key(spec.radiance_id)
    view = sample_view(spec, key, SEED, number, modification)
    parts = time_parts(scene, cloud, modification, key, view, backend.work_s)
    configuration_s = parts["edit_s"] + parts["photons_s"]
    few_s, halves = time_work(partial(scene.render_halves, view, (4 * number, 4 * number + 1), few), backend.work_s)
    many = partial(scene.render_halves, view, (4 * number + 2, 4 * number + 3), RANGE * few)
    pass_s, spp_s = line_through(2 * few, few_s, 2 * RANGE * few, time_work(many, backend.work_s)[0])
    noise = relative_variance(halves[0], halves[1], 2 * few) if np.isfinite(halves).all() else None
    return {
        "configuration_s": configuration_s,
        "view_s": parts["guides_s"] + parts["points_s"] + parts["photons_seen_s"],
        "pass_s": pass_s,
        "spp_s": spp_s,
        "relative_variance": math.nan if noise is None else noise,
        "guides_s": parts["guides_s"],
    }


def fewer_samples(spec: SceneSpec) -> int:
    """The samples per pixel of a half of the smaller pass: the spec's own, or fewer if 4 times as many are too many."""
    of_film = RANGE * spec.film.width * spec.film.height
    return int(np.clip(MOST_PATHS // of_film, 1, spec.transport.half_spp))


def line_through(few: int, few_s: float, many: int, many_s: float) -> tuple[float, float]:
    """Fixed seconds, and seconds a sample, from the times at two numbers of samples; neither is below 0."""
    spp_s = max((many_s - few_s) / (many - few), 0.0)
    return max(few_s - few * spp_s, 0.0), spp_s
