"""Samples of the analytic room: as a source that grows, and as jobs of a store."""

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any

import numpy as np
from analytic_room import analytic_base, render, sees, trace, visibility
from numpy.typing import NDArray

from photonfarm.core.keys import Key, make_key
from photonfarm.core.records import (
    F32,
    LIT_POINTS,
    BasePointCloud,
    Geometry,
    Guides,
    Photons,
    ViewBuffers,
)
from photonfarm.plan.request import sample_key
from photonfarm.scene.modification import Modification, rebuild, sample_modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import View, sample_view
from photonfarm.store import Figures, JobWriter, Sample, SceneStore
from photonfarm.store.read.batch import Batch


class AnalyticSource:
    """Samples of the analytic scene, `views` of each configuration, released `per_look` rows at each refresh."""

    def __init__(self, spec: SceneSpec, samples: int, *, views: int = 1, noise: float = 1.0, per_look: int = 1 << 30):
        self.spec, self._samples, self._views, self._noise, self._per_look = spec, samples, views, noise, per_look
        self._base = analytic_base(spec)
        self._released = 0
        self.reads: list[int] = []

    def ready(self) -> bool:
        return True

    def base(self) -> tuple[Geometry, BasePointCloud]:
        return self._base

    @property
    def rows(self) -> NDArray[np.int64]:
        return np.arange(self._released)

    def doubt(self) -> None: ...

    def lease(self) -> None: ...

    def at_work(self, _what: str) -> AbstractContextManager[None]:
        return nullcontext()

    @property
    def planned(self) -> int:
        return self._samples

    @property
    def plan_requests(self) -> list[dict[str, Any]]:
        return [{"samples": self._samples}]

    def refresh(self) -> NDArray[np.int64]:
        before = self._released
        self._released = min(self._samples, before + self._per_look)
        return np.arange(before, self._released)

    def modification(self, row: int) -> Modification:
        return sample_modification(self.spec, 0, row // self._views)

    def view(self, row: int) -> View:
        return sample_view(self.spec, self.modification(row).key(self.spec.radiance_id), 0, row)

    def modification_key(self, row: int) -> Key:
        return self.modification(row).key(self.spec.radiance_id)

    def view_key(self, row: int) -> Key:
        return make_key(self.modification_key(row), self.view(row).vector)

    def modification_keys(self, rows: Sequence[int]) -> list[Key]:
        return [self.modification_key(row) for row in rows]

    def are_uniform(self, rows: Sequence[int]) -> list[bool]:
        return [True] * len(rows)

    def earlier_passes(self, row: int) -> NDArray[np.int64]:
        return np.arange(row, row)  # each row is a view of its own

    def read_radiance(self, row: int) -> F32:
        return self.read(row).radiance

    def view_keys(self, rows: Sequence[int]) -> list[Key]:
        return [self.view_key(row) for row in rows]

    def sample_keys(self, rows: Sequence[int]) -> list[Key]:
        return [sample_key(self.spec.radiance_id, self.modification(row), self.view(row).vector, 0) for row in rows]

    def cloud_at(self, row: int) -> tuple[F32, NDArray[np.bool_]]:
        """The cloud of a row's configuration: positions, and which points are present."""
        return rebuild(self._base[1], self.modification(row))

    def sees(self, row: int, position: F32) -> NDArray[np.bool_]:
        """Which points the eye of a row sees, by an exact query: nothing lies between, (P,)."""
        return sees(self.spec, self.modification(row), self.view(row), position)

    def clean(self, row: int) -> F32:
        return render(self.spec, self.modification(row), self.view(row))[0]

    def read(self, row: int) -> Sample:
        self.reads.append(row)
        modification, view = self.modification(row), self.view(row)
        clean, buffers = render(self.spec, modification, view)
        photons = self.read_photons(row) if self.spec.photons.paths else None
        seen = visibility(self.spec, self._base[1], modification, view, photons)
        guides = known(clean, buffers, min(LIT_POINTS, self.spec.points))
        halves, (key,) = noisy(clean, row, self._noise), self.sample_keys([row])
        shared = (lambda: self._base[1]), partial(self.read_photons, row)
        return Sample(row, key, modification, view, 0, halves, buffers, seen, guides, 1.0, *shared)

    def read_samples(self, rows: Sequence[int], _out: Batch | None = None) -> list[Sample]:
        return [self.read(row) for row in rows]

    def read_photons(self, row: int) -> Photons:
        return trace(self.spec, self.modification(row), row // self._views)


class ScarceSource(AnalyticSource):
    """One that gives `lot` rows more whenever nothing has been drawn for `patience` looks; `count` is for training."""

    def __init__(self, spec: SceneSpec, samples: int, *, lot: int, patience: int, **how: Any):
        super().__init__(spec, samples, **how)
        self._lot, self._patience, self._looks, self._draws = lot, patience, 0, 0
        self.stalls: list[int] = []  # draws by each lot

    def refresh(self) -> NDArray[np.int64]:
        self._looks += 1
        self._per_look = self._lot if self._looks >= self._patience else 0
        if self._per_look:
            self._looks = 0
            self.stalls.append(self._draws)
        return super().refresh()

    def count(self, draws: int, _samples: int) -> None:
        self._draws, self._looks = draws, 0


def commit_job(scene: SceneStore, job: int) -> bool:
    """Write one job of a store, its images analytic; as a render worker does."""
    rows, cloud, photons = scene.job_rows(job), scene.base()[1], {}
    new_views = set(rows.new_views)
    if scene.spec.photons.paths:
        photons = {row: trace(scene.spec, modification, row) for row, modification in rows.modifications.items()}
    with JobWriter(scene, rows) as out:
        for sample in rows.samples:
            shown = rows.modifications[sample.modification_row], rows.views[sample.view_row]
            clean, buffers = render(scene.spec, *shown)
            out.radiance(sample.row, noisy(clean, sample.row, 1.0))
            if sample.view_row in new_views:
                seen = visibility(scene.spec, cloud, *shown, photons.get(sample.modification_row))
                guides = known(clean, buffers, min(LIT_POINTS, scene.spec.points))
                out.view(sample.view_row, buffers, guides, seen)
                new_views.remove(sample.view_row)
        for row in rows.new_modifications & photons.keys():
            out.photons(row, photons[row])
        return out.commit(Figures(core_s=0.5, wall_s=0.6, redrawn=0, worker="test", versions={"test": "1"}))


def known(clean: F32, buffers: ViewBuffers, lit: int) -> Guides:
    """Half of the light, which is all direct; and what a diffuse surface without mirrors has to tell."""
    dark, none = np.zeros_like(clean), np.zeros_like(buffers.depth)
    return Guides(
        emission=dark,
        direct=clean / 2,
        gloss=dark,
        specular=dark,
        roughness=none + 1,
        mean_depth=buffers.depth,
        mean_normal=buffers.normal,
        throughput=dark,
        beyond_albedo=dark,
        beyond_normal=dark,
        beyond_depth=none,
        point_light=np.ones((lit, 3), np.float32),
    )


def noisy(clean: F32, seed: int, noise: float) -> F32:
    """Half-estimates A and B, (2, H, W, 3): the clean image times gamma noise of mean 1 and deviation `noise`."""
    factor = np.random.default_rng(seed).gamma(1 / noise**2, noise**2, (2, *clean.shape))
    return (clean * factor).astype(np.float32)
