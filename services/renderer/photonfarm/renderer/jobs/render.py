"""One job: one shard of samples, rendered in the order that edits the scene least, and committed.

Samples of one configuration are rendered together, as many as the device likes at once.
"""

from __future__ import annotations

import gc
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import CorruptError, IncompleteError, QueueError
from photonfarm.core.keys import Key, view_key
from photonfarm.core.records import (
    F32,
    LIT_POINTS,
    BasePointCloud,
    Photons,
    Visibility,
    arrays_of,
)
from photonfarm.renderer.jobs.estimates import halves_of, photons_of
from photonfarm.renderer.scene import backend
from photonfarm.scene.modification import Modification, rebuild, rebuild_surfaces
from photonfarm.scene.spec import SceneSpec, Transport
from photonfarm.scene.spec_loading import locate
from photonfarm.scene.view import View
from photonfarm.store import Figures, JobRows, JobWriter, SampleRow, SceneReader, SceneStore, Store
from photonfarm.store.model.lease import announce_work

if TYPE_CHECKING:
    from photonfarm.renderer.scene.loaded_scene import LoadedScene

SCENES_KEPT = 2
"""The number of loaded scenes kept: jobs of two scenes may alternate in the queue."""

LOADS = "loads the scene"
COMPILES = "compiles kernels, renders samples"
RENDERS_SAMPLES = "renders samples"
COMMITS = "commits"

_PACKAGES = ("photonfarm", "mitsuba", "drjit", "numpy", "zarr")

log = logging.getLogger(__name__)


SceneLoader = Callable[[SceneSpec], "LoadedScene"]

OnProgress = Callable[[str, int, int], object]
"""A callback with the phase of a job in words, how many of its parts are done, and how many it has, or 0."""


def load_scene(spec: SceneSpec) -> LoadedScene:
    """The scene of a spec, loaded into Mitsuba on this process's device, with a thread pool of one."""
    from photonfarm.renderer.scene.loaded_scene import LoadedScene

    backend.load(threads=1)
    return LoadedScene.load(spec)


@dataclass(slots=True, eq=False)
class _Loaded:
    """A loaded scene, and its place in the store."""

    stored: SceneStore
    scene: LoadedScene
    transport: Transport  # that it was loaded with
    compiled: bool = False  # its first image compiles the kernels
    _cloud: BasePointCloud | None = None

    def cloud(self) -> BasePointCloud:
        """The stored base point cloud; it is written first, with the geometry, if it is missing."""
        if not self.stored.has_base():
            self.stored.write_base(*self.scene.base())
            self._cloud = None
        if self._cloud is None:
            self._cloud = self.stored.base()[1]
        return self._cloud


class ShardRenderer:
    """Renders jobs of a store, keeping the most recently used scenes loaded."""

    def __init__(
        self,
        store: Store,
        *,
        worker: str,
        load: SceneLoader = load_scene,
        on_progress: OnProgress = lambda *_: None,
    ) -> None:
        """Take a store; `worker` is the name written into markers."""
        self._store = store
        self._on_progress = on_progress
        self._worker = worker
        self._load = load
        self._scenes: dict[str, _Loaded] = {}  # in the order of their last use
        self._others: dict[str, OtherHalves] = {}  # by the id of the scene whose halves they are

    def render(self, scene_id: str, job: int) -> bool:
        """Render and commit a job; False if it was committed, withdrawn or forgotten already, or is meanwhile.

        Raises LeasedError while somebody has the scene for itself, QueueError for a job that is not planned,
        SceneNotHereError if the scene file here is not the planned one, IncompleteError if renders stay non-finite or
        buffers are.
        """
        what = f"worker {self._worker} at job {job}"
        with announce_work(self._store.storage, scene_id, what):
            if not self._store.has_scene(scene_id):  # forgotten while its jobs were queued
                return False
            stored = self._store.scene(scene_id)
            if job >= stored.jobs():
                raise QueueError(f"store {self._store.root} has no job {job} of scene {scene_id}")
            if not stored.is_to_do(job):
                return False
            stored.reread()
            return self._render(self._scene(stored), stored.job_rows(job))

    def _render(self, loaded: _Loaded, rows: JobRows) -> bool:
        stored, wall_s, core_s = loaded.stored, time.monotonic(), time.process_time()
        cloud = loaded.cloud()
        with JobWriter(stored, rows) as out:
            if (other := rows.plan.halves_from) is not None and other not in self._others:
                self._others[other] = OtherHalves(self._store.root, other)
            rendering = _Rendering(loaded, cloud, out, self._on_progress, self._others.get(other or ""))
            rendering.run(rows)
            loaded.compiled = True
            self._on_progress(COMMITS, len(rows.samples), len(rows.samples))
            figures = Figures(
                core_s=time.process_time() - core_s,
                wall_s=time.monotonic() - wall_s,
                redrawn=rendering.redrawn,
                worker=self._worker,
                versions=versions(),
                device=backend.device().name,
                driver=backend.device().driver,
                strategy=loaded.scene.spec.strategy(),
                taken_over=rendering.taken_over,
            )
            committed = out.commit(figures)
        if not committed:
            what = "was committed by another worker while it was rendered here; that one stays"
            log.warning("scene %s, job %d: %s", stored.scene_id, rows.job, what)
        return committed

    def _scene(self, stored: SceneStore) -> _Loaded:
        """The scene, loaded; anew if it is to be rendered by another strategy than before."""
        scene_id = stored.scene_id
        known = self._scenes.pop(scene_id, None)
        if known is not None and known.transport == stored.spec.transport:
            self._scenes[scene_id] = known
        else:
            known = None  # freed before the next one is loaded
            spec = locate(stored.spec)  # before another scene is unloaded for it
            while len(self._scenes) >= SCENES_KEPT:
                self._scenes.pop(next(iter(self._scenes)))
            self._on_progress(LOADS, 0, 0)
            gc.collect()  # while an older scene is still partly alive, Dr.Jit finds no kernel in its cache
            self._scenes[scene_id] = _Loaded(stored, self._load(spec), spec.transport)
        return self._scenes[scene_id]


@cache
def versions() -> Mapping[str, str]:
    """The versions of the packages that affect renders."""
    installed = {}
    for package in _PACKAGES:
        try:
            installed[package] = version(package)
        except PackageNotFoundError:  # run from a checkout
            continue
    return installed


# -------------------------------------------------------------------------------------------------------- rendering


def lit_points(cloud: BasePointCloud, modification: Modification) -> tuple[F32, F32]:
    """Positions and normals (L, 3) of the points of a configuration whose irradiance is among the guides."""
    position, normal = rebuild(cloud, modification)[0], rebuild_surfaces(cloud, modification)[0]
    return position[:LIT_POINTS], normal[:LIT_POINTS]


def visibility_of(
    scene: LoadedScene, views: Sequence[View], points: tuple[F32, NDArray[np.bool_]], photons: Photons | None
) -> list[Visibility]:
    """Which points views see in the current configuration: of its cloud, as `rebuild` returns it, and its photons."""
    position, present = points
    if photons is not None:
        position, present = np.concatenate([position, photons.position]), np.append(present, photons.bounce >= 0)
    of_cloud, of_photons = np.split(scene.sees(views, position) & present, [len(points[0])], axis=1)
    return [Visibility(*seen) for seen in zip(of_cloud, of_photons, strict=True)]


class _Rendering:
    """One walk over a job's samples: each modification is applied once, and each new view's inputs rendered once."""

    def __init__(
        self,
        loaded: _Loaded,
        cloud: BasePointCloud,
        out: JobWriter,
        on_progress: OnProgress,
        others: OtherHalves | None,
    ) -> None:
        self._scene, self._spec, self._compiled = loaded.scene, loaded.stored.spec, loaded.compiled
        self._cloud = cloud
        self._out = out
        self._on_progress = on_progress
        self._others = others
        self.redrawn = 0  # renders that were discarded
        self.taken_over = 0  # samples whose halves another scene has

    def run(self, rows: JobRows) -> None:
        """Pass every row of the job to its writer.

        Photons that another job stores, with the modification, are traced again for this job's new views: their seed
        follows from the modification's key, so that they are equal. That job counts the renders discarded for them.
        """
        new_views, done = set(rows.new_views), 0
        if self._others is not None:
            self._others.refresh()
        for modification_row, group in groupby(rows.samples, key=lambda sample: sample.modification_row):
            modification, samples = rows.modifications[modification_row], list(group)
            self._scene.apply(modification)
            is_new = modification_row in rows.new_modifications
            wants_photons = is_new or any(sample.view_row in new_views for sample in samples)
            photons, discarded = (
                photons_of(self._scene, modification.key(self._spec.radiance_id)) if wants_photons else (None, 0)
            )
            if is_new:
                self.redrawn += discarded
                if photons is not None:
                    self._out.photons(modification_row, photons)
            for first in range(0, len(samples), self._scene.samples_at_once):
                together = samples[first : first + self._scene.samples_at_once]
                phase = RENDERS_SAMPLES if self._compiled or done else COMPILES
                self._on_progress(phase, done, len(rows.samples))
                done += len(together)
                of_new = {sample.view_row: sample for sample in together if sample.view_row in new_views}
                if of_new:
                    self._render_inputs(list(of_new.values()), rows, modification, photons)
                    new_views -= of_new.keys()
                self._render_halves(together, rows)

    def _render_halves(self, samples: Sequence[SampleRow], rows: JobRows) -> None:
        """Render the halves of samples together, or take them over."""
        left = []
        for sample in samples:
            halves = None if self._others is None else self._others.find(sample.key)
            if halves is None:
                left.append(sample)
            else:
                self._out.radiance(sample.row, halves)
                self.taken_over += 1
        estimates = halves_of(self._scene, [(sample.key, rows.views[sample.view_row]) for sample in left])
        for sample, (halves, discarded) in zip(left, estimates, strict=True):
            self.redrawn += discarded
            self._out.radiance(sample.row, halves)

    def _render_inputs(
        self, samples: Sequence[SampleRow], rows: JobRows, modification: Modification, photons: Photons | None
    ) -> None:
        """Render the inputs of the samples' views together, without a second attempt: buffers depend on no seed."""
        views, key = [rows.views[sample.view_row] for sample in samples], modification.key(self._spec.radiance_id)
        keys = [view_key(key, view.vector) for view in views]
        visible = visibility_of(self._scene, views, rebuild(self._cloud, modification), photons)
        inputs = self._scene.inputs(views, keys, self._spec.guides, lit_points(self._cloud, modification))
        for sample, (buffers, guides), seen in zip(samples, inputs, visible, strict=True):
            _check_finite(arrays_of(buffers) | arrays_of(guides), sample)
            self._out.view(sample.view_row, buffers, guides, seen)


def _check_finite(arrays: Mapping[str, NDArray[np.generic]], sample: SampleRow) -> None:
    """Raise IncompleteError unless all values of arrays of a sample's view are finite."""
    for name, values in arrays.items():
        if not np.isfinite(values.astype(np.float32)).all():
            what = f"view {sample.view_row} (sample {sample.key.hex()})"
            raise IncompleteError(f"{name} of {what} came out non-finite")


class OtherHalves:
    """The complete samples of a scene with the same radiance id, by their content keys.

    What is damaged there, or gone meanwhile, is not found, and so it is rendered.
    """

    def __init__(self, store: str | Path, scene_id: str) -> None:
        """Take the scene; `refresh` looks what is complete."""
        self._scene_id, self._reader = scene_id, SceneReader(store, scene_id)
        self._rows: dict[Key, int] = {}

    def refresh(self) -> None:
        """Look what is complete now."""
        try:
            if len(self._reader.refresh()):
                self._rows = self._reader.rows_by_key()
        except (CorruptError, IncompleteError) as error:
            self._rows = {}
            log.warning("no halves are taken over from scene %s: %s", self._scene_id, error)

    def find(self, key: Key) -> F32 | None:
        """The halves of a sample, (2, H, W, 3) linear, unscaled, every byte checked; None if they are not there."""
        row = self._rows.get(key)
        if row is None:
            return None
        try:
            return self._reader.read_radiance(row)
        except (CorruptError, IncompleteError) as error:
            log.warning("halves of sample %s are rendered: %s", key.hex(), error)
            return None
