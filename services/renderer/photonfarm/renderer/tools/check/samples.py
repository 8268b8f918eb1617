"""Random configurations rendered quickly, with what they show of brightness and cameras.

They are the first that `photonfarm submit` plans by default, a view of each, on a small film. What cameras stand in and
see is found by rays from many of them.

Shape letters: N cameras, P points of the base cloud.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from photonfarm.core.pictures import Picture, display
from photonfarm.core.records import F32, BasePointCloud
from photonfarm.core.waiting import Steps, WorkLog
from photonfarm.renderer.scene.gbuffer import reflects_here, sight_shares
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.renderer.scene.surroundings import LEAVING, NONE
from photonfarm.renderer.scene.view_rays import ViewCameras
from photonfarm.renderer.tools.measure import exposure
from photonfarm.scene.modification import Modification, rebuild, sample_modification
from photonfarm.scene.poor_views import are_near, hand_of
from photonfarm.scene.spec import Film, SceneSpec
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

RAYS_ALONG = 16
"""The rays along each side of a camera's image."""

BEHIND = 0.1
"""The least share of look-at points in free sight: a camera outside the room that sees fewer is behind a wall."""


@dataclass(frozen=True, slots=True, eq=False)
class Cameras:
    """Random cameras of one or several configurations."""

    inside: tuple[str | None, ...]  # N ids of the shapes that cameras stand inside of
    behind: NDArray[np.bool_]  # (N,) outside the room, with a wall between them and nearly all look-at points
    nothing: NDArray[np.bool_]  # (N,) no surface at all in the image
    dark: F32  # (N,) the share of the image that shows the black back of a one-sided surface
    near: NDArray[np.bool_]  # (N,) within a hand of what at least half of the image shows
    seen: F32  # (N,) the share of the points that the view sees

    def __len__(self) -> int:
        return len(self.inside)

    def holders(self) -> list[tuple[str, int]]:
        """The shapes that most cameras stand inside of, with how many do."""
        return Counter(name for name in self.inside if name is not None).most_common()

    @property
    def placed_well(self) -> NDArray[np.bool_]:
        """Which cameras are neither inside a shape nor behind a wall, (N,)."""
        well: NDArray[np.bool_] = np.array([name is None for name in self.inside]) & ~self.behind
        return well

    @property
    def inside_share(self) -> float:
        """The share of cameras inside shapes."""
        return sum(name is not None for name in self.inside) / len(self)


def join_cameras(parts: Sequence[Cameras]) -> Cameras:
    """The cameras of several configurations."""
    names = ("behind", "nothing", "dark", "near", "seen")
    arrays = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
    return Cameras(tuple(name for part in parts for name in part.inside), *arrays)


def examine_cameras(scene: LoadedScene, views: Sequence[View], cloud: F32) -> Cameras:
    """Cameras of the scene's present configuration; `cloud` (P, 3) are points that are there in it."""
    ids = [shape.id() or f"shape {number}" for number, shape in enumerate(scene.scene.shapes())]
    origin, target = (np.stack([getattr(view, name) for view in views]) for name in ("origin", "target"))
    here = scene.surroundings(origin)
    sights = sight_shares(scene.scene, origin, target)
    hit, dark, near = _images(scene, views)
    return Cameras(
        inside=tuple(None if number == NONE else ids[number] for number in here.solid),
        behind=(here.leaving > LEAVING) & (sights < BEHIND),
        nothing=hit == 0,
        dark=dark,
        near=near,
        seen=scene.sees(views, cloud).mean(axis=1, dtype=np.float32),
    )


def _images(scene: LoadedScene, views: Sequence[View]) -> tuple[F32, F32, NDArray[np.bool_]]:
    """Shares of images: with a surface between near and far plane, with a black back; and which are near; (N,) each."""
    coarse = scene.spec.model_copy(update={"film": Film(width=RAYS_ALONG, height=RAYS_ALONG)})
    sent = ViewCameras.of(views, coarse).pixels().ray(0.5, 0.5)
    si = scene.scene.ray_intersect(sent.ray)
    hit = si.is_valid()
    depth = dr.select(hit, (si.t + sent.before) * sent.along, 0)
    lit = reflects_here(si) | (si.shape.is_emitter()) | mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Transmission)
    dark = hit & ~lit
    dr.eval(hit, dark, depth)
    shares = [np.array(mask).reshape(len(views), -1).mean(axis=1, dtype=np.float32) for mask in (hit, dark)]
    near = are_near(hand_of(scene.spec), np.array(depth).reshape(len(views), RAYS_ALONG, RAYS_ALONG))
    return shares[0], shares[1], near


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


def shrink_spec(spec: SceneSpec) -> SceneSpec:
    """The spec as it is loaded for a check."""
    return exposure.shrink_film(spec, SIDE).model_copy(update={"points": min(spec.points, POINTS)})


def render(scene: LoadedScene, spec: SceneSpec, cloud: BasePointCloud, work: WorkLog) -> Samples:
    """Render the configurations of a spec in a scene that was loaded from `shrink_spec` of it."""
    film = scene.spec.film
    half_spp = int(np.clip(exposure.PATHS // (film.width * film.height), 1, MOST_SPP))
    shown: list[Shown] = []
    halves, seen, steps = [], [], Steps(COUNT, slow=2)
    work.begin(f"rendering {COUNT} configurations", steps.words)
    for number in range(COUNT):
        modification, views = _draw_views(spec, number)
        scene.apply(modification)
        halves.append(scene.render_halves(views[0], (2 * number, 2 * number + 1), half_spp))
        position, there = rebuild(cloud, modification)
        seen.append(examine_cameras(scene, views, position[there]))
        picture = display(halves[-1].mean(axis=0), spec.exposure)
        shown.append(Shown(number, modification, views[0], picture))
        steps.reach(len(shown))
    return Samples(shown, exposure.Pictures(np.stack(halves)), join_cameras(seen))


def _draw_views(spec: SceneSpec, number: int) -> tuple[Modification, list[View]]:
    """A configuration, and its views; the first is that of the configuration's sample."""
    modification = sample_modification(spec, exposure.SEED, number)
    key = modification.key(spec.radiance_id)
    # A plan numbers each configuration's views from 0, and a scene without groups has one configuration
    first = 0 if spec.groups else number
    others = (COUNT + number * VIEWS + index for index in range(1, VIEWS))
    return modification, [sample_view(spec, key, exposure.SEED, index, modification) for index in (first, *others)]
