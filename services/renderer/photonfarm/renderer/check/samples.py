"""Random configurations rendered quickly, with what they show of brightness, noise, cost and cameras.

They are the first that `photonfarm submit` plans by default, a view of each, on a small film.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from photonfarm.renderer.check import cameras
from photonfarm.renderer.check.cameras import Cameras
from photonfarm.renderer.measure import exposure, sample_costs
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.shared.core.pictures import Picture, display
from photonfarm.shared.core.records import F32, BasePointCloud
from photonfarm.shared.core.waiting import Steps, WorkLog
from photonfarm.shared.plan.sample_costs import SampleCosts, relative_variance
from photonfarm.shared.scene.modification import Modification, sample_modification
from photonfarm.shared.scene.pointcloud import rebuild
from photonfarm.shared.scene.spec import Film, SceneSpec
from photonfarm.shared.scene.view import View, sample_view

COUNT = 16
"""The rendered configurations."""

SIDE = 128
"""The most pixels along the longer side of their pictures."""

VIEWS = 32
"""The cameras of each configuration that rays are sent from."""

POINTS = 2048
"""The most points of the base cloud."""

WARM_UPS = 2
"""The configurations whose times do not count, as kernels are compiled for them."""

FEW_SPP = 1
"""The samples per pixel of the quicker of the two timed passes."""


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """One configuration, and a view of it."""

    number: int
    modification: Modification
    view: View
    picture: Picture


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """All configurations."""

    shown: list[Shown]
    images: exposure.Pictures
    cameras: Cameras
    costs: SampleCosts  # of the spec's film; rough, and without guides


@dataclass(frozen=True, slots=True, eq=False)
class _Measured:
    """One configuration's images and cameras, and its times in CPU seconds."""

    halves: F32  # (2, H, W, 3)
    cameras: Cameras
    configuration_s: float
    buffers_s: float
    few_s: float
    all_s: float


def small(spec: SceneSpec) -> SceneSpec:
    """The spec as it is loaded for a check."""
    return exposure.shrunk(spec, SIDE).model_copy(update={"points": min(spec.points, POINTS)})


def render(scene: LoadedScene, spec: SceneSpec, cloud: BasePointCloud, work: WorkLog) -> Samples:
    """Render the configurations of a spec in a scene that was loaded from `small` of it."""
    film = scene.spec.film
    half_spp = int(np.clip(exposure.PATHS // (film.width * film.height), FEW_SPP + 1, 64))
    drawn = [_drawn(spec, number) for number in range(COUNT)]
    measured: list[_Measured] = []
    steps = Steps(COUNT, slow=WARM_UPS)
    work.begin(f"rendering {COUNT} configurations", steps.words)
    for number, (modification, views) in enumerate(drawn):
        measured.append(_measured(scene, cloud, modification, views, number, half_spp))
        steps.reach(len(measured))
    return Samples(
        [
            Shown(number, modification, views[0], display(measured[number].halves.mean(axis=0), spec.exposure))
            for number, (modification, views) in enumerate(drawn)
        ],
        exposure.Pictures(np.stack([each.halves for each in measured])),
        cameras.joined([each.cameras for each in measured]),
        _costs(spec, film, half_spp, measured[WARM_UPS:]),
    )


def _drawn(spec: SceneSpec, number: int) -> tuple[Modification, list[View]]:
    """A configuration, and its views; the first is that of the configuration's sample."""
    modification = sample_modification(spec, sample_costs.SEED, number)
    key = modification.key(spec.radiance_id)
    first = 0 if spec.groups else number  # as a plan numbers the views of a configuration
    others = (COUNT + number * VIEWS + index for index in range(1, VIEWS))
    return modification, [sample_view(spec, key, sample_costs.SEED, index, modification) for index in (first, *others)]


def _measured(
    scene: LoadedScene, cloud: BasePointCloud, modification: Modification, views: Sequence[View], number: int, spp: int
) -> _Measured:
    configuration_s, (position, there) = _timed(lambda: _configure(scene, cloud, modification))
    buffers_s, _ = _timed(lambda: scene.buffers(views[0]))
    few_s, _ = _timed(lambda: scene.render_halves(views[0], (4 * number, 4 * number + 1), FEW_SPP))
    all_s, halves = _timed(lambda: scene.render_halves(views[0], (4 * number + 2, 4 * number + 3), spp))
    found = cameras.look(scene, views, position[there])
    return _Measured(halves, found, configuration_s, buffers_s, few_s, all_s)


def _configure(scene: LoadedScene, cloud: BasePointCloud, modification: Modification) -> Any:
    scene.apply(modification)
    return rebuild(cloud, modification)


def _timed(work: Callable[[], Any]) -> tuple[float, Any]:
    begun = backend.work_s()
    result = work()
    return backend.work_s() - begun, result


def _costs(spec: SceneSpec, film: Film, half_spp: int, measured: Sequence[_Measured]) -> SampleCosts:
    """The costs of samples of the spec's own film, of which the small one has a share of the pixels."""
    larger = spec.film.width * spec.film.height / (film.width * film.height)
    passes = [sample_costs.line_through(2 * FEW_SPP, each.few_s, 2 * half_spp, each.all_s) for each in measured]
    halves = [each.halves for each in measured if np.isfinite(each.halves).all()]
    noise = [relative_variance(a, b, 2 * half_spp) for a, b in halves]
    known = [variance for variance in noise if variance is not None]
    return SampleCosts(
        spec.scene_id,
        configuration_s=_median([each.configuration_s for each in measured]),
        view_s=larger * _median([each.buffers_s for each in measured]),
        pass_s=_median([fixed for fixed, _ in passes]),
        spp_s=larger * _median([each for _, each in passes]),
        relative_variance=_median(known) if known else 0.0,
    )


def _median(values: Sequence[float]) -> float:
    return float(np.median(values))
