"""`photonfarm buffers`: a network's inputs for views without samples, such as those of a camera path."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from photonfarm.core.errors import IncompleteError
from photonfarm.core.keys import view_key
from photonfarm.core.records import BasePointCloud, Guides, arrays_of
from photonfarm.farm.configuration import find_configuration
from photonfarm.renderer.jobs.estimates import photons_of
from photonfarm.renderer.jobs.render import (
    SceneLoader,
    lit_points,
    load_scene,
    locate,
    visibility_of,
)
from photonfarm.scene.camera_path import CameraPath, Frames, check_clear, orbit
from photonfarm.scene.modification import Modification, rebuild
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import View
from photonfarm.store import Store
from photonfarm.store.read.find import scene_named

if TYPE_CHECKING:
    from photonfarm.renderer.scene.loaded_scene import LoadedScene


def render_path(store: str | Path, scene: str, modification: str | None, path: CameraPath | int) -> Frames:
    """The buffers of a camera path, or of an orbit of so many frames.

    Raises StoreError for a scene that the store does not hold, SceneNotHereError if its files are not on this machine,
    SpecError for an impossible configuration.
    """
    opened = Store(store)
    stored = opened.scene(scene_named(opened, scene))
    configuration = find_configuration(opened, stored, modification)
    spec = locate(stored.spec)
    if isinstance(path, int):
        views = orbit(spec, path, configuration)
    else:
        views = check_clear(spec, path.sample(), configuration)
    return frames_of(spec, configuration, views, stored.base()[1] if stored.has_base() else None)


def frames_of(
    spec: SceneSpec,
    modification: Modification,
    views: Sequence[View],
    cloud: BasePointCloud | None = None,
    load: SceneLoader = load_scene,
) -> Frames:
    """The buffers and guides of views of one configuration, and its photons, if the scene has some.

    The photons are those that the store holds of the configuration, or would: their seed follows from its key. `cloud`
    is the stored base cloud; without one it is sampled, as a job would. Raises IncompleteError for values that are not
    finite.
    """
    scene = load(spec)
    scene.apply(modification)
    buffers = [scene.buffers(view) for view in views]
    depth, albedo, normal = (np.stack([getattr(b, name) for b in buffers]) for name in ("depth", "albedo", "normal"))
    photons, _ = photons_of(scene, modification.key(spec.radiance_id))
    arrays = {"depth": depth, "albedo": albedo, "normal": normal}
    for name, values in arrays.items():
        if not np.isfinite(values).all():
            raise IncompleteError(f"{name} of these views came out non-finite; move the camera a little")
    cloud = cloud or scene.base()[1]
    points = rebuild(cloud, modification)
    guides = _guides(scene, modification, views, spec, cloud)
    seen = [visibility_of(scene, view, points, photons) for view in views]
    arrays |= {"point_seen": np.stack([s.points for s in seen]), "photon_seen": np.stack([s.photons for s in seen])}
    return Frames(spec.scene_id, modification, tuple(views), photons=photons, guides=guides, **arrays)


def _guides(
    scene: LoadedScene, modification: Modification, views: Sequence[View], spec: SceneSpec, cloud: BasePointCloud
) -> Guides:
    """The guides of all views, stacked."""
    key, lit = modification.key(spec.radiance_id), lit_points(cloud, modification)
    guides = [arrays_of(scene.guides(view, view_key(key, view.vector), spec.guides, lit)) for view in views]
    return Guides(**{name: np.stack([each[name] for each in guides]).astype(np.float32) for name in guides[0]})
