"""Bytes per sample: what stores hold, against storing point cloud, buffers and photons with every sample.

Shape letters: P points, R rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.harness.contents import Contents, Pool, commit, view_row
from photonfarm.core.keys import Key
from photonfarm.core.records import arrays_of
from photonfarm.plan.request import Request
from photonfarm.scene.modification import rebuild
from photonfarm.scene.spec import SceneSpec
from photonfarm.store import SceneStore, Store
from photonfarm.store.format import schema
from photonfarm.store.format.schema import ArraySchema
from photonfarm.store.format.shards import ShardWriter, encode
from photonfarm.store.read.batch import GUIDE_NAMES

COUNTS = (1, 2, 4, 8)


@dataclass(frozen=True, slots=True)
class StoreSize:
    """One store: a request's shape, and the bytes of its files without the base, over its samples."""

    views_per_modification: int
    passes: int
    samples: int
    bytes_per_sample: float
    with_guides: float  # bytes per sample with the guides of its views
    saving: float  # how many times less than with everything in every sample, without guides


@dataclass(frozen=True, slots=True)
class Whole:
    """Bytes of one sample that holds all it is trained on, in the same shards with the same codecs."""

    radiance: float
    buffers: float  # with what the view sees
    cloud: float
    photons: float

    @property
    def total(self) -> float:
        """All of it."""
        return self.radiance + self.buffers + self.cloud + self.photons


def measure(
    spec: SceneSpec, contents: Contents, modifications: int, folder: Path
) -> tuple[list[StoreSize], Whole, int]:
    """The stores of every pair of counts; what whole samples take; and the bytes of the base, stored once."""
    rows: list[StoreSize] = []
    for views in COUNTS:
        for passes in COUNTS:
            request = Request(modifications=modifications, views_per_modification=views, passes=passes)
            scene = filled(spec, contents, request, folder / f"{views}-{passes}")
            samples = scene.progress().committed_samples
            whole_bytes = (size(scene.folder) - size(scene.folder / "base")) / samples
            rows.append(StoreSize(views, passes, samples, whole_bytes - guided(scene) / samples, whole_bytes, 0.0))
    whole = whole_samples(scene, contents, folder / "whole")
    rows = [replace(row, saving=whole.total / row.bytes_per_sample) for row in rows]
    return rows, whole, size(scene.folder / "base")


def planned(spec: SceneSpec, request: Request, folder: Path) -> SceneStore:
    """A new store with a plan for a request."""
    store = Store(folder, create=True)
    return store.scene(store.plan(spec, request).scene_id)


def filled(spec: SceneSpec, contents: Contents | Pool, request: Request, folder: Path) -> SceneStore:
    """A store with all that a request names."""
    scene = planned(spec, request, folder)
    if isinstance(contents, Contents):
        scene.write_base(*contents.base)
    for job in scene.missing_jobs():
        commit(scene, job, contents)
    return scene


def guided(scene: SceneStore) -> int:
    """Bytes of the guides of all views of a store."""
    return sum(size(folder) for folder in scene.folder.glob("plans/*/*") if folder.name in GUIDE_NAMES)


def size(folder: Path) -> int:
    """Bytes of all files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def whole_samples(scene: SceneStore, contents: Contents, folder: Path) -> Whole:
    """Every view of a scene once, with the cloud, buffers and photons of its own."""
    spec, base = scene.spec, contents.base[1]
    outputs = schema.output_arrays(spec)
    points = (len(base.position), 3)
    cloud = {
        "position": ArraySchema("position", "sample", points, np.dtype("<f4"), True),
        "normal": ArraySchema("normal", "sample", points, np.dtype("<f2"), True),
        "albedo": ArraySchema("albedo", "sample", points, np.dtype("<f2"), True),
        "emission": ArraySchema("emission", "sample", points, np.dtype("<f4"), True),
        "visible": ArraySchema("visible", "sample", points[:1], np.dtype("|b1"), True),
    }
    kept: dict[str, list[Mapping[str, Any]]] = {"radiance": [], "buffers": [], "cloud": [], "photons": []}
    seen: set[Key] = set()
    for job in range(scene.jobs()):
        rows = scene.job_rows(job)
        for sample in (s for s in rows.samples if not s.pass_):
            modification, view = rows.modifications[sample.modification_row], rows.views[sample.view_row]
            key = modification.key(spec.radiance_id) + view.vector.tobytes()
            if key in seen:
                continue
            seen.add(key)
            position, present = rebuild(base, modification)
            photons = contents.photons(modification) if spec.photons.paths else None
            kept["radiance"].append({"radiance": contents.halves(modification, view)})
            shown = contents.buffers(modification, view), contents.visibility(modification, view)
            kept["buffers"].append(view_row(*shown))
            kept["cloud"].append(
                {
                    "position": position,
                    "normal": base.normal,
                    "albedo": base.albedo,
                    "emission": base.emission,
                    "visible": present,
                }
            )
            kept["photons"].append(
                {f"photon_{name}": values for name, values in arrays_of(photons).items()} if photons else {}
            )
    folder.mkdir(parents=True)
    return Whole(
        **{
            part: _bytes_per_row(folder / part, of, {**outputs, **(cloud if part == "cloud" else {})})
            for part, of in kept.items()
        }
    )


def _bytes_per_row(path: Path, rows: list[Mapping[str, Any]], arrays: Mapping[str, ArraySchema]) -> float:
    """Bytes per row of shards with these rows, one shard for each array."""
    total = 0
    for name in rows[0]:
        writer = ShardWriter(path.with_suffix(f".{name}"), arrays[name], len(rows))
        for i, row in enumerate(rows):
            with np.errstate(over="ignore", under="ignore"):
                writer.append(i, encode(arrays[name], row[name]))
        total += writer.finish()["size"]
    return total / len(rows)
