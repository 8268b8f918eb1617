"""`photonfarm buffers`: a network's inputs for views without samples, such as those of a camera path."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import IncompleteError
from photonfarm.core.keys import view_key
from photonfarm.core.records import BasePointCloud, Guides, ViewBuffers, Visibility, arrays_of
from photonfarm.renderer.jobs.estimates import photons_of
from photonfarm.renderer.jobs.render import (
    SceneLoader,
    lit_points,
    load_scene,
    visibility_of,
)
from photonfarm.scene.arrangement import Arrangement
from photonfarm.scene.camera_path import CameraPath, Cameras, Frames, check_clear, orbit
from photonfarm.scene.groups import names_of_ids
from photonfarm.scene.modification import Modification, rebuild
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import View
from photonfarm.store import SceneStore, Store
from photonfarm.store.read.find import find_start, scene_named


def find_views(
    store: str | Path,
    scene: str,
    asked: Arrangement,
    path: CameraPath | Cameras | int,
    row: int | None = None,
    like: str | None = None,
) -> tuple[SceneStore, Modification, list[View]]:
    """The scene in the store, the configuration, and the views of a path or of an orbit of so many frames.

    The configuration begins with that of `find_start`, then a path's file changes it, and then what is `asked`. Raises
    StoreError for a scene or a start that the store does not hold, SpecError for an impossible configuration or path.
    """
    opened = Store(store)
    stored = opened.scene(scene_named(opened, scene))
    start = find_start(store, stored.scene_id, row, like)
    return stored, *list_views(stored.spec, asked, path, start[0] if start else None)


def list_views(
    spec: SceneSpec, asked: Arrangement, path: CameraPath | Cameras | int, begin: Modification | None = None
) -> tuple[Modification, list[View]]:
    """The configuration and the views of `find_views`, from the one to `begin` with, or the scene at rest."""
    configuration = begin if isinstance(path, int) else path.apply(spec, begin)
    configuration = asked.apply(spec, configuration)
    if isinstance(path, int):
        return configuration, orbit(spec, path, configuration)
    views = path.sample() if isinstance(path, CameraPath) else path.sample(spec)
    return configuration, check_clear(spec, views, configuration)


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
    photons, _ = photons_of(scene, key := modification.key(spec.radiance_id))
    cloud = cloud or scene.base()[1]
    points, lit = rebuild(cloud, modification), lit_points(cloud, modification)
    buffers, guides, seen, groups = [], [], [], []
    for first in range(0, len(views), scene.samples_at_once):
        together = views[first : first + scene.samples_at_once]
        keys = [view_key(key, view.vector) for view in together]
        for of_view in scene.inputs(together, keys, spec.guides, lit):
            buffers.append(of_view[0])
            guides.append(of_view[1])
        seen += visibility_of(scene, together, points, photons)
        groups += [*scene.find_groups(together)]
    images = _stack(buffers)
    for name, values in images.items():
        if not np.isfinite(values).all():
            raise IncompleteError(f"{name} of these views came out non-finite; move the camera a little")
    visible = _stack(seen)
    images |= {"point_seen": visible["points"], "photon_seen": visible["photons"], "group": np.stack(groups)}
    stacked = Guides(**_stack(guides))
    names = tuple(names_of_ids(spec.groups))
    return Frames(spec.scene_id, modification, tuple(views), photons=photons, guides=stacked, names=names, **images)


def _stack(records: Sequence[ViewBuffers] | Sequence[Guides] | Sequence[Visibility]) -> dict[str, NDArray[Any]]:
    """The arrays of all views by name, stacked."""
    arrays = [arrays_of(record) for record in records]
    return {name: np.stack([each[name] for each in arrays]) for name in arrays[0]}
