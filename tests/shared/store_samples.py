"""A small scene and made-up outputs for the tests of plan and store."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import pytest

from photonfarm.core.records import F32, BasePointCloud, Geometry, Guides, Photons, ViewBuffers, Visibility
from photonfarm.farm.watch import FarmWatch
from photonfarm.plan.request import Request
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import parse_spec
from photonfarm.store import Figures, JobWriter, SceneReader, SceneStatus, SceneStore, Store
from photonfarm.store.format.schema import output_arrays

FIGURES = Figures(core_s=2.0, wall_s=1.0, redrawn=1, worker="test", versions={"numpy": np.__version__})


@dataclass(frozen=True)
class Outputs:
    """All that a job renders, by row number."""

    radiance: dict[int, F32]
    buffers: dict[int, ViewBuffers]
    guides: dict[int, Guides]
    visibility: dict[int, Visibility]
    photons: dict[int, Photons]


def small_spec(**changes: Any) -> SceneSpec:
    """One movable object, 8 × 8 pixels; content is not looked for on disk."""
    unit = {"min": [0, 0, 0], "max": [1, 1, 1]}
    movable = {"name": "object", "shapes": ["tall-block"], "at": [0, 0, 0], "box": unit, "removal_probability": 0.2191}
    described = {
        "name": "small",
        "scene": {"builtin": "cornell"},
        "objects": [movable],
        "points": 16,
        "view": {"origin": unit, "look_at": unit},
        "film": {"width": 8, "height": 8},
        "photons": {"paths": 4, "depth": 2},
    }
    return parse_spec({**described, **changes}, where="test")


ALWAYS = {"objects": [{**small_spec().objects[0].model_dump(), "removal_probability": 0.0}]}
"""What makes the object of `small_spec` be always there, so that no two configurations are equal."""


@pytest.fixture
def scene(store: Store) -> SceneStore:
    """Three jobs of 4, 4 and 2 samples: 5 modifications, 2 views each."""
    request = Request(modifications=5, views_per_modification=2)
    return store.scene(store.plan(small_spec(), request, shard_rows=4).scene_id)


def reader_of(scene: SceneStore) -> SceneReader:
    """A reader that has looked."""
    reader = SceneReader(scene.folder.parent.parent, scene.scene_id)
    reader.refresh()
    return reader


def statuses(store: Store) -> list[SceneStatus]:
    """What `photonfarm status` says of the scenes of a store without a queue."""
    return [scene.status for scene in FarmWatch(store, "unix:///none").look().scenes]


def outputs(scene: SceneStore, job: int) -> Outputs:
    """Outputs of the right rows and shapes, a function of the row numbers."""
    rows, spec = scene.job_rows(job), scene.spec
    size = (spec.film.height, spec.film.width)
    return Outputs(
        {s.row: values(s.row, (2, *size, 3)) for s in rows.samples},
        {
            row: ViewBuffers(values(row, size), values(row + 1, (*size, 3)), values(row + 2, (*size, 3)))
            for row in rows.new_views
        },
        {row: guides(spec, row) for row in rows.new_views},
        {row: visibility(spec, row) for row in rows.new_views},
        {row: photons(spec, row) for row in rows.new_modifications if spec.photons.paths},
    )


def values(seed: int, shape: tuple[int, ...]) -> F32:
    """Random numbers in [0, 1), multiples of 2^-8, which float16 holds exactly."""
    return np.random.default_rng(seed).integers(0, 256, shape).astype(np.float32) / np.float32(256)


def photons(spec: SceneSpec, row: int) -> Photons:
    """Photons of which the last slot is empty."""
    count = spec.photons.slots
    position, direction, normal, power = (values(row + i, (count, 3)) for i in range(4))
    bounce = np.zeros(count, np.int8)
    for array in (position, direction, normal, power):
        array[-1] = 0
    bounce[-1] = -1
    return Photons(position, direction, normal, power, bounce)


def visibility(spec: SceneSpec, row: int) -> Visibility:
    """Half of the points and photons seen, but for the last slot, which is empty."""
    points, photons = (values(row + i, (count,)) < 0.5 for i, count in enumerate((spec.points, spec.photons.slots)))
    photons[-1:] = False
    return Visibility(points, photons)


def base() -> tuple[Geometry, BasePointCloud]:
    """One triangle with three points."""
    corners = np.eye(3, dtype=np.float32)
    geometry = Geometry(corners, np.array([[0, 1, 2]], np.uint32), np.zeros(1, np.int32), np.array([-1], np.int16))
    group, face = np.array([-1, 0, 0], np.int16), np.zeros(3, np.uint32)
    return geometry, BasePointCloud(corners, corners, corners, corners, group, face)


def commit(scene: SceneStore, job: int, given: Outputs, figures: Figures = FIGURES, **options: Any) -> bool:
    """Hand a job's outputs to the store, and commit them."""
    with JobWriter(scene, scene.job_rows(job)) as out:
        give(out, given)
        return out.commit(figures, **options)


def give(out: JobWriter, given: Outputs) -> None:
    """Hand a job's outputs to its writer."""
    for row, photons_ in given.photons.items():
        out.photons(row, photons_)
    for row, buffers in given.buffers.items():
        out.view(row, buffers, given.guides[row], given.visibility[row])
    for row, halves in given.radiance.items():
        out.radiance(row, halves)


def commit_all(scene: SceneStore) -> None:
    """Commit every job that is missing."""
    for job in scene.missing_jobs():
        assert commit(scene, job, outputs(scene, job))


def guides(spec: SceneSpec, row: int) -> Guides:
    """Guides that their types hold exactly, a function of the row of their view; of all that `schema` has."""
    found, arrays = {}, output_arrays(spec)
    for i, name in enumerate(field.name for field in fields(Guides)):
        array = arrays[name]
        found[name] = values(100 * row + i, array.shape)
        if array.dtype.itemsize == 4:
            found[name] += np.float32(1 / 3)  # what is rounded to fewer bits shows it
    return Guides(**found)
