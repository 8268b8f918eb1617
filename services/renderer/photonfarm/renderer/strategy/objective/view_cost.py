"""The processor time of a sample beside its two half-estimates: its configuration and its view."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.jobs.estimates import photons_of
from photonfarm.renderer.jobs.render import lit_points, visibility_of
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.renderer.strategy.pilot_scene import PilotScene
from photonfarm.shared.core.keys import view_key
from photonfarm.shared.core.records import F32, BasePointCloud, Photons
from photonfarm.shared.scene.modification import Modification
from photonfarm.shared.scene.pointcloud import rebuild
from photonfarm.shared.scene.view import View

LEAST_VIEWS, MOST_VIEWS = 2, 7
"""The views that are looked at; the first one compiles, and does not count."""

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class ViewCost:
    """Processor seconds, as in `SampleCosts`; a sample is charged for both, as with one view of each configuration."""

    configuration_s: float  # the scene edited, its points moved, its photons traced
    view_s: float  # the view's buffers and guides, and which points and photons it sees

    @property
    def half_s(self) -> float:
        """The part of either half-estimate, which share it."""
        return (self.configuration_s + self.view_s) / 2


FREE = ViewCost(0.0, 0.0)
"""The cost beside images where nothing but images is rendered."""


def measure(pilot_scene: PilotScene, views: Iterable[tuple[Modification, View]]) -> ViewCost:
    """The medians over some views, each of a configuration of its own, without the first one."""
    scene = pilot_scene.loaded
    cloud = scene.base()[1]
    times = []
    for modification, view in views:
        configuration_s, (points, photons) = timed(partial(configure, scene, cloud, modification))
        pilot_scene.apply(modification)  # so that it knows of the edit
        view_s, _ = timed(partial(look, scene, view, points, photons))
        guides_s, _ = timed(partial(guide, scene, view, cloud, modification))
        times.append((configuration_s, view_s + guides_s))
    configuration_s, view_s = np.median(times[1:], axis=0).tolist()
    return ViewCost(configuration_s, view_s)


def configure(
    scene: LoadedScene, cloud: BasePointCloud, modification: Modification
) -> tuple[tuple[F32, NDArray[np.bool_]], Photons | None]:
    """Bring a scene into a configuration; returns its points, as `rebuild` does, and its photons."""
    scene.apply(modification)
    dr.sync_thread()  # pending evaluations would be charged to the view
    return rebuild(cloud, modification), photons_of(scene, modification.key(scene.spec.radiance_id))[0]


def look(scene: LoadedScene, view: View, points: tuple[F32, NDArray[np.bool_]], photons: Photons | None) -> None:
    """Render the buffers of a view, and which points and photons it sees."""
    scene.buffers(view)
    visibility_of(scene, view, points, photons)


def guide(scene: LoadedScene, view: View, cloud: BasePointCloud, modification: Modification) -> None:
    """Render the guides of a view."""
    key = view_key(modification.key(scene.spec.radiance_id), view.vector)
    scene.guides(view, key, scene.spec.guides, lit_points(cloud, modification))


def timed(work: Callable[[], T]) -> tuple[float, T]:
    """The processor seconds of some work, and its result."""
    begun = backend.work_s()
    result = work()
    return backend.work_s() - begun, result
