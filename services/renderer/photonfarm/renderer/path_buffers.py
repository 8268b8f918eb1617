"""`photonfarm buffers`: what a network needs to show views that nobody rendered, such as those of a camera path."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from photonfarm.renderer.jobs import SceneLoader, load_scene, located, photons_of, visibility_of
from photonfarm.shared.camera_path import CameraPath, orbit
from photonfarm.shared.configuration import named_configuration
from photonfarm.shared.errors import IncompleteError
from photonfarm.shared.frames import Frames
from photonfarm.shared.modification import Modification
from photonfarm.shared.pointcloud import rebuild
from photonfarm.shared.records import BasePointCloud
from photonfarm.shared.scene import SceneSpec
from photonfarm.shared.store import Store
from photonfarm.shared.store.find import scene_named
from photonfarm.shared.view import View


def write_buffers(store: str | Path, scene: str, modification: str | None, path: CameraPath | int, out: Path) -> int:
    """Render what a camera path shows, or an orbit of so many frames, into a file; how many frames it has.

    Raises StoreError for a scene that the store does not hold, SceneNotHereError where its files are not here,
    SpecError for a configuration that the scene cannot have.
    """
    opened = Store(store)
    stored = opened.scene(scene_named(opened, scene))
    configuration = named_configuration(opened, stored, modification)
    spec = located(stored.spec)
    views = orbit(spec, path) if isinstance(path, int) else path.sampled()
    cloud = stored.base()[1] if stored.has_base() else None
    frames_of(spec, configuration, views, cloud).write(out)
    return len(views)


def frames_of(
    spec: SceneSpec,
    modification: Modification,
    views: Sequence[View],
    cloud: BasePointCloud | None = None,
    load: SceneLoader = load_scene,
) -> Frames:
    """The buffers of views of one configuration, its photons if the scene has some, and what the views see of them.

    The photons are those that the store holds of the configuration, or would: their seed follows from its key. `cloud`
    is the stored base cloud; without one it is sampled, as a job would. Raises IncompleteError for values that are not
    finite.
    """
    scene = load(spec)
    scene.apply(modification)
    buffers = [scene.buffers(view) for view in views]
    depth, albedo, normal = (np.stack([getattr(b, name) for b in buffers]) for name in ("depth", "albedo", "normal"))
    photons, _ = photons_of(scene, modification.key(spec.scene_id))
    arrays = {"depth": depth, "albedo": albedo, "normal": normal}
    for name, values in arrays.items():
        if not np.isfinite(values).all():
            raise IncompleteError(f"{name} of these views came out non-finite; move the camera a little")
    points = rebuild(cloud or scene.base()[1], modification)
    seen = [visibility_of(scene, view, points, photons) for view in views]
    arrays |= {"point_seen": np.stack([s.points for s in seen]), "photon_seen": np.stack([s.photons for s in seen])}
    return Frames(spec.scene_id, modification, tuple(views), photons=photons, **arrays)
