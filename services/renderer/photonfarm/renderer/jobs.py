"""One job: one shard of samples, rendered in the order that edits the scene least, and committed.

Seeds are functions of content keys: sample key and "half A" or "half B", modification key and "photons". A render with
a non-finite value is thrown away and drawn again with the next seed of its kind; nothing is replaced or clamped.
"""

from __future__ import annotations

import gc
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from itertools import count, groupby, islice
from typing import Protocol

import numpy as np

from photonfarm.shared.errors import IncompleteError, QueueError, SceneNotHereError, SpecError
from photonfarm.shared.keys import Key, seed_of
from photonfarm.shared.modification import Modification
from photonfarm.shared.records import F32, BasePointCloud, Geometry, Photons, ViewBuffers, arrays_of
from photonfarm.shared.scene import SceneSpec, parse_spec
from photonfarm.shared.store import Figures, JobRows, JobWriter, SampleRow, SceneStore, Store
from photonfarm.shared.view import View

ATTEMPTS = 3
"""Seeds tried for one render; three non-finite renders in a row are a fault of the scene, not bad luck."""

SCENES_KEPT = 2
"""Loaded scenes kept warm: jobs of two scenes may alternate in the queue."""

_PACKAGES = ("photonfarm-renderer", "photonfarm-shared", "mitsuba", "drjit", "numpy", "zarr")

log = logging.getLogger(__name__)


class SceneRenderer(Protocol):
    """A loaded scene that is edited in place: what a job needs of `photonfarm.renderer.scenes.LoadedScene`."""

    def apply(self, modification: Modification) -> None:
        """Put the scene into a configuration."""

    def render_halves(self, view: View, seeds: Sequence[int]) -> F32:
        """Independent noisy estimates of radiance, one for each seed, (K, H, W, 3) linear."""

    def buffers(self, view: View) -> ViewBuffers:
        """The image-space buffers of a view."""

    def photons(self, seed: int) -> Photons | None:
        """Light sub-paths of the current configuration; None if the spec wants none."""

    def base(self) -> tuple[Geometry, BasePointCloud]:
        """Geometry and base point cloud of the scene at rest."""


SceneLoader = Callable[[SceneSpec], SceneRenderer]


def load_scene(spec: SceneSpec) -> SceneRenderer:
    """The scene of a spec, loaded into Mitsuba with a thread pool of one."""
    from photonfarm.renderer import backend
    from photonfarm.renderer.scenes import LoadedScene

    backend.load(threads=1)
    return LoadedScene.load(spec)


# ------------------------------------------------------------------------------------------- the function in the queue

_serving: ShardRenderer | None = None


def serve(renderer: ShardRenderer) -> None:
    """Make `render_shard` work in this process; the store is the worker's own choice and never comes from the queue."""
    global _serving  # RQ calls a module's function, and what is loaded lives as long as the process
    _serving = renderer


def render_shard(scene_id: str, job: int) -> None:
    """Render and commit one job: the one function that the queue may name."""
    if _serving is None:
        raise IncompleteError("render_shard runs inside `photonfarm work` only, which says where the store is")
    _serving.render(scene_id, job)


class ShardRenderer:
    """Renders jobs of a store, keeping the scenes it has loaded last."""

    def __init__(self, store: Store, *, worker: str, load: SceneLoader = load_scene) -> None:
        """Take a store; `worker` is the name that markers get."""
        self._store = store
        self._worker = worker
        self._load = load
        self._scenes: dict[str, tuple[SceneStore, SceneRenderer]] = {}  # last used last

    def render(self, scene_id: str, job: int) -> bool:
        """Render and commit one job; False if it was committed already, or by another worker meanwhile.

        False too if a repair took its files meanwhile: it is missing then, and comes again.

        Raises QueueError for a job that is not planned in this store, SceneNotHereError if the scene file here is not
        the planned one, IncompleteError if renders stay non-finite or buffers are.
        """
        if not self._store.has_scene(scene_id) or job >= (stored := self._store.scene(scene_id)).jobs():
            raise QueueError(f"scene {scene_id}, job {job}: is not of the store {self._store.root}")
        if stored.is_committed(job):
            return False
        stored, scene = self._scene(scene_id)
        wall, core = time.monotonic(), time.process_time()
        if not stored.has_base():
            stored.write_base(*scene.base())
        with stored.job_writer(job) as out:
            redrawn = _Rendering(scene, scene_id, out).run(stored.job_rows(job))
            figures = Figures(
                core_s=time.process_time() - core,
                wall_s=time.monotonic() - wall,
                redrawn=redrawn,
                worker=self._worker,
                versions=versions(),
            )
            committed = out.commit(figures)
        if not committed:
            what = "was committed by another worker while it was rendered here; that one stays"
            if not stored.is_committed(job):
                what = "its files were set aside by a repair while it was committed here; it will be rendered again"
            log.warning("scene %s, job %d: %s", scene_id, job, what)
        return committed

    def _scene(self, scene_id: str) -> tuple[SceneStore, SceneRenderer]:
        if scene_id in self._scenes:
            self._scenes[scene_id] = self._scenes.pop(scene_id)
        else:
            stored = self._store.scene(scene_id)
            spec = located(stored.spec)  # before another scene is let go for it
            while len(self._scenes) >= SCENES_KEPT:
                self._scenes.pop(next(iter(self._scenes)))
            gc.collect()  # Dr.Jit finds no kernel in its cache while an older scene is still half alive
            self._scenes[scene_id] = stored, self._load(spec)
        return self._scenes[scene_id]


def located(spec: SceneSpec) -> SceneSpec:
    """The spec, once its scene file has been found on this machine and is the one that was planned.

    Raises SceneNotHereError otherwise: that is the machine's fault and not the job's, which others may do.
    """
    try:
        here = parse_spec(spec.model_dump(mode="json"), where=f"scene {spec.scene_id} ({spec.name})")
    except SpecError as error:
        raise SceneNotHereError(f"this machine cannot render {error}") from error
    if here.scene_id != spec.scene_id:
        raise SceneNotHereError(
            f"scene {spec.scene_id} ({spec.name}): the scene file here is another one than was planned (its files' "
            f"digest is {here.content[:12]}…, planned was {spec.content[:12]}…); give every worker the same files"
        )
    return here


@cache
def versions() -> Mapping[str, str]:
    """Versions of what renders, by package."""
    found = {}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:  # run from a checkout
            continue
    return found


# -------------------------------------------------------------------------------------------------------- rendering


class _Rendering:
    """One pass over a job's samples: each modification applied once, each view's buffers made once."""

    def __init__(self, scene: SceneRenderer, scene_id: str, out: JobWriter) -> None:
        self._scene = scene
        self._scene_id = scene_id
        self._out = out
        self._redrawn = 0

    def run(self, rows: JobRows) -> int:
        """Hand every row of the job to its writer; how many renders were thrown away."""
        viewed: set[int] = set()
        for modification_row, samples in groupby(rows.samples, key=lambda sample: sample.modification_row):
            modification = rows.modifications[modification_row]
            self._scene.apply(modification)
            if modification_row in rows.new_modifications:
                photons = self._photons(modification.key(self._scene_id))
                if photons is not None:
                    self._out.photons(modification_row, photons)
            for sample in samples:
                view = rows.views[sample.view_row]
                if sample.view_row in rows.new_views - viewed:
                    self._out.buffers(sample.view_row, self._buffers(sample, view))
                    viewed.add(sample.view_row)
                self._out.radiance(sample.row, self._halves(sample, view))
        return self._redrawn

    def _buffers(self, sample: SampleRow, view: View) -> ViewBuffers:
        """They know no seed, so that another try would not help."""
        buffers = self._scene.buffers(view)
        for name, values in arrays_of(buffers).items():
            if not np.isfinite(values).all():
                raise IncompleteError(
                    f"{name} of view {sample.view_row} came out non-finite (sample {sample.key.hex()})"
                )
        return buffers

    def _halves(self, sample: SampleRow, view: View) -> F32:
        """Two independent estimates, (2, H, W, 3)."""
        purposes = ("half A", "half B")
        seed_a = next(_seeds(sample.key, purposes[0], ()))
        seed_b = next(_seeds(sample.key, purposes[1], (seed_a,)))
        halves = self._scene.render_halves(view, (seed_a, seed_b))
        for half, purpose in enumerate(purposes):
            if not np.isfinite(halves[half]).all():
                halves[half] = self._again(sample.key, purpose, view, (seed_a, seed_b))
        return halves

    def _again(self, key: Key, purpose: str, view: View, taken: tuple[int, int]) -> F32:
        """Another estimate for one that came out non-finite; other seeds than those that are `taken`."""
        self._throw_away(key, purpose)
        for seed in islice(_seeds(key, purpose, taken), ATTEMPTS - 1):
            image = self._scene.render_halves(view, (seed,))[0]
            if np.isfinite(image).all():
                return image
            self._throw_away(key, purpose)
        raise IncompleteError(f"{purpose} of sample {key.hex()} came out non-finite {ATTEMPTS} times")

    def _photons(self, key: Key) -> Photons | None:
        for seed in islice(_seeds(key, "photons", ()), ATTEMPTS):
            photons = self._scene.photons(seed)
            if photons is None or all(np.isfinite(values).all() for values in arrays_of(photons).values()):
                return photons
            self._throw_away(key, "photons")
        raise IncompleteError(f"photons of modification {key.hex()} came out non-finite {ATTEMPTS} times")

    def _throw_away(self, key: Key, purpose: str) -> None:
        self._redrawn += 1
        log.warning("%s of %s is not finite; drawn again with another seed", purpose, key.hex())


def _seeds(key: Key, purpose: str, taken: tuple[int, ...]) -> Iterator[int]:
    """The seeds to try in turn, without end, none of them `taken`: equal seeds would make the halves equal."""
    for attempt in count():
        seed = seed_of(key, purpose if attempt == 0 else f"{purpose}, attempt {attempt}")
        if seed not in taken:
            yield seed
