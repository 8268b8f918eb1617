"""Random configurations rendered quickly, with what they show of brightness and cameras.

They are the first that `photonfarm submit` plans by default, a view of each, on a small film.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from photonfarm.core.pictures import Picture, display
from photonfarm.core.records import BasePointCloud
from photonfarm.core.waiting import Steps, WorkLog
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.renderer.tools.check import cameras
from photonfarm.renderer.tools.check.cameras import Cameras
from photonfarm.renderer.tools.measure import exposure
from photonfarm.scene.modification import Modification, rebuild, sample_modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import View, sample_view

COUNT = 16
"""The rendered configurations."""

SIDE = 128
"""The most pixels along the longer side of their pictures."""

VIEWS = 32
"""The cameras of each configuration that rays are sent from."""

POINTS = 2048
"""The most points of the base cloud."""

MOST_SPP = 64
"""The most samples per pixel of a half of a picture."""


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


def small(spec: SceneSpec) -> SceneSpec:
    """The spec as it is loaded for a check."""
    return exposure.shrunk(spec, SIDE).model_copy(update={"points": min(spec.points, POINTS)})


def render(scene: LoadedScene, spec: SceneSpec, cloud: BasePointCloud, work: WorkLog) -> Samples:
    """Render the configurations of a spec in a scene that was loaded from `small` of it."""
    film = scene.spec.film
    half_spp = int(np.clip(exposure.PATHS // (film.width * film.height), 1, MOST_SPP))
    shown: list[Shown] = []
    halves, seen, steps = [], [], Steps(COUNT, slow=2)
    work.begin(f"rendering {COUNT} configurations", steps.words)
    for number in range(COUNT):
        modification, views = _drawn(spec, number)
        scene.apply(modification)
        halves.append(scene.render_halves(views[0], (2 * number, 2 * number + 1), half_spp))
        position, there = rebuild(cloud, modification)
        seen.append(cameras.look(scene, views, position[there]))
        picture = display(halves[-1].mean(axis=0), spec.exposure)
        shown.append(Shown(number, modification, views[0], picture))
        steps.reach(len(shown))
    return Samples(shown, exposure.Pictures(np.stack(halves)), cameras.joined(seen))


def _drawn(spec: SceneSpec, number: int) -> tuple[Modification, list[View]]:
    """A configuration, and its views; the first is that of the configuration's sample."""
    modification = sample_modification(spec, exposure.SEED, number)
    key = modification.key(spec.radiance_id)
    first = 0 if spec.groups else number  # as a plan numbers the views of a configuration
    others = (COUNT + number * VIEWS + index for index in range(1, VIEWS))
    return modification, [sample_view(spec, key, exposure.SEED, index, modification) for index in (first, *others)]
