"""Rendered contents for stores that are measured: each configuration and view once, whatever asks for it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from photonfarm.core.keys import Key, view_key
from photonfarm.core.records import (
    F32,
    BasePointCloud,
    Geometry,
    Guides,
    Photons,
    ViewBuffers,
    Visibility,
    arrays_of,
)
from photonfarm.scene.modification import Modification, rebuild
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import View
from photonfarm.store import Figures, JobRows, JobWriter, SampleRow, SceneStore
from photonfarm.store.format.schema import RowKind

FIGURES = Figures(core_s=0.0, wall_s=0.0, redrawn=0, worker="bench", versions={})


class Contents:
    """What a worker renders, kept. All passes of a view have the same half-estimates: noise is stored raw."""

    def __init__(self, spec: SceneSpec) -> None:
        from photonfarm.renderer.scene import backend

        backend.load(threads=1)
        from photonfarm.renderer.scene.loaded_scene import LoadedScene

        self.spec = spec
        self._scene = LoadedScene.load(spec)
        self._made: dict[tuple[str, Key], Any] = {}
        self._applied: Key = b""
        self.base: tuple[Geometry, BasePointCloud] = self._scene.base()

    def halves(self, modification: Modification, view: View) -> F32:
        """Half-estimates A and B, (2, H, W, 3)."""
        return self._get("halves", modification, view, lambda: self._scene.render_halves(view, (1, 2)))

    def buffers(self, modification: Modification, view: View) -> ViewBuffers:
        """The image-space buffers."""
        return self._get("buffers", modification, view, lambda: self._inputs(modification, view)[0])

    def visibility(self, modification: Modification, view: View) -> Visibility:
        """What the view sees."""
        from photonfarm.renderer.jobs.render import visibility_of

        photons = self.photons(modification) if self.spec.photons.paths else None
        points = rebuild(self.base[1], modification)
        make = partial(visibility_of, self._scene, [view], points, photons)
        return self._get("visibility", modification, view, lambda: make()[0])

    def photons(self, modification: Modification) -> Photons:
        """The photons."""
        return self._get("photons", modification, None, lambda: self._scene.photons(3))

    def guides(self, modification: Modification, view: View) -> Guides:
        """The guides of a view."""
        return self._get("guides", modification, view, lambda: self._inputs(modification, view)[1])

    def _inputs(self, modification: Modification, view: View) -> tuple[ViewBuffers, Guides]:
        from photonfarm.renderer.jobs.render import lit_points

        key, lit = modification.key(self.spec.radiance_id), lit_points(self.base[1], modification)
        make = partial(self._scene.inputs, [view], [view_key(key, view.vector)], self.spec.guides, lit)
        return self._get("inputs", modification, view, make)[0]

    def _get(self, what: str, modification: Modification, view: View | None, make: Any) -> Any:
        key = modification.key(self.spec.radiance_id)
        name = (what, key + (view.vector.tobytes() if view else b""))
        if name not in self._made:
            if self._applied != key:
                self._scene.apply(modification)
                self._applied = key
            self._made[name] = make()
        return self._made[name]

    def pool(self) -> Pool:
        """All that has been made so far, in no relation to each other."""
        of = {what: [value for (kind, _), value in self._made.items() if kind == what] for what in _KINDS}
        return Pool(**of)


_KINDS = ("halves", "buffers", "guides", "visibility", "photons")


class Pool:
    """Contents for any number of samples, dealt in turn; goes through a file, for other processes."""

    def __init__(
        self,
        halves: list[F32],
        buffers: list[ViewBuffers],
        guides: list[Guides],
        visibility: list[Visibility],
        photons: list[Photons],
    ) -> None:
        self._of: dict[str, list[Any]] = dict(zip(_KINDS, (halves, buffers, guides, visibility, photons), strict=True))
        self._dealt = dict.fromkeys(self._of, 0)

    def halves(self, *_: Any) -> F32:
        """The next half-estimates."""
        return self._next("halves")

    def buffers(self, *_: Any) -> ViewBuffers:
        """The next buffers."""
        return self._next("buffers")

    def guides(self, *_: Any) -> Guides:
        """The next guides."""
        return self._next("guides")

    def visibility(self, *_: Any) -> Visibility:
        """What the next view sees."""
        return self._next("visibility")

    def photons(self, *_: Any) -> Photons:
        """The next photons."""
        return self._next("photons")

    def _next(self, what: str) -> Any:
        self._dealt[what] += 1
        return self._of[what][self._dealt[what] % len(self._of[what])]

    def save(self, path: Path) -> None:
        """Write all into one .npz file."""
        arrays = {f"halves/{i}": values for i, values in enumerate(self._of["halves"])}
        for what in _KINDS[1:]:
            for i, record in enumerate(self._of[what]):
                arrays |= {f"{what}/{i}/{field.name}": getattr(record, field.name) for field in fields(record)}
        np.savez(path, **arrays)

    @classmethod
    def load(cls, path: Path) -> Pool:
        """What `save` has written."""
        with np.load(path) as file:
            arrays = dict(file)

        def records(what: str, kind: Any) -> Iterator[Any]:
            for i in range(sum(name.startswith(f"{what}/") for name in arrays) // len(fields(kind))):
                yield kind(**{field.name: arrays[f"{what}/{i}/{field.name}"] for field in fields(kind)})

        halves = [values for name, values in arrays.items() if name.startswith("halves/")]
        kinds = (("buffers", ViewBuffers), ("guides", Guides), ("visibility", Visibility), ("photons", Photons))
        return cls(halves, *(list(records(*kind)) for kind in kinds))


def commit(scene: SceneStore, job: int, contents: Contents | Pool) -> None:
    """Give a job its contents in the order that a worker has, as fast as they are taken."""
    rows = scene.job_rows(job)
    with JobWriter(scene, rows) as out:
        for kind, row, sample in in_order(rows):
            modification, view = rows.modifications[sample.modification_row], rows.views[sample.view_row]
            if kind == "modification" and scene.spec.photons.paths:
                out.photons(row, contents.photons(modification))
            elif kind == "view":
                of = modification, view
                out.view(row, contents.buffers(*of), contents.guides(*of), contents.visibility(*of))
            elif kind == "sample":
                out.radiance(row, contents.halves(modification, view))
        out.commit(FIGURES)


def in_order(rows: JobRows) -> Iterator[tuple[RowKind, int, SampleRow]]:
    """A job's rows as a worker comes by them: of each sample first what is new of its modification and its view."""
    seen: set[tuple[RowKind, int]] = set()
    for sample in rows.samples:
        wanted: list[tuple[RowKind, int]] = [("sample", sample.row)]
        if sample.view_row in rows.new_views:
            wanted.insert(0, ("view", sample.view_row))
        if sample.modification_row in rows.new_modifications:
            wanted.insert(0, ("modification", sample.modification_row))
        for kind, row in wanted:
            if (kind, row) not in seen:
                seen.add((kind, row))
                yield kind, row, sample


def view_row(buffers: ViewBuffers, visibility: Visibility) -> dict[str, Any]:
    """What is stored of a view beside its guides, by array."""
    seen = {"point_seen": visibility.points, "photon_seen": visibility.photons}
    bits = {name: np.packbits(values, bitorder="little") for name, values in seen.items() if len(values)}
    return arrays_of(buffers) | bits
