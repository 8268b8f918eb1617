"""What a store of made-up samples should hold, as dictionaries: `test_store_model` compares the two."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import store_samples as samples

from photonfarm.core.records import BasePointCloud, Geometry, Guides, ViewBuffers, Visibility, arrays_of
from photonfarm.plan.request import UNUSED, PlannedContent, Request, expand, sample_key
from photonfarm.scene.modification import Modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.store import JobWriter, SceneReader, SceneStore
from photonfarm.store.format.shards import NOISY_GUIDES, round_to_8_bits

# ------------------------------------------------------------------------------ what is rendered: a function of content


def radiance_of(spec: SceneSpec, key: bytes) -> np.ndarray:
    """A sample's halves; every fourth has a value that float16 cannot hold."""
    halves = samples.values(_seed(key), (2, spec.film.height, spec.film.width, 3))
    if key[0] % 4 == 0:
        halves[:, 0, 0, 0] = 70000
    return halves


def buffers_of(spec: SceneSpec, modification: bytes, view: bytes) -> ViewBuffers:
    size = (spec.film.height, spec.film.width)
    seed = _seed(modification + view)
    return ViewBuffers(*(samples.values(seed + i, shape) for i, shape in enumerate([size, (*size, 3), (*size, 3)])))


def visibility_of(spec: SceneSpec, modification: bytes, view: bytes) -> Visibility:
    return samples.visibility(spec, _seed(modification + view))


def guides_of(spec: SceneSpec, modification: bytes, view: bytes) -> Guides:
    """The guides as they are given, not as they are stored."""
    return samples.guides(spec, _seed(modification + view) >> 8)


def photons_of(spec: SceneSpec, modification: bytes) -> Any:
    return samples.photons(spec, _seed(modification))


def base_of(spec: SceneSpec) -> tuple[Geometry, BasePointCloud]:
    geometry, cloud = samples.base()
    return geometry, cloud if spec.groups else replace(cloud, group=np.full_like(cloud.group, -1))


def _seed(content: bytes) -> int:
    return int.from_bytes(hashlib.blake2b(content, digest_size=7).digest(), "little")


# ------------------------------------------------------------------------------------------------------------ the model


@dataclass(frozen=True)
class Planned:
    """A sample of the model."""

    modification: bytes  # vectors
    view: bytes
    pass_: int
    row: int
    view_row: int
    modification_row: int


@dataclass
class Model:
    """A scene: what is planned, and which jobs are committed."""

    spec: SceneSpec
    shard_rows: int
    planned: dict[bytes, Planned] = field(default_factory=dict)  # by sample key
    plans: int = 0
    jobs: int = 0
    committed: set[int] = field(default_factory=set)

    def missing(self) -> list[int]:
        """The jobs that workers are to take."""
        return [job for job in range(self.jobs) if job not in self.committed]

    def jobs_of(self, sample: Planned) -> set[int]:
        """The jobs that must be committed for a sample to be complete."""
        return {row // self.shard_rows for row in (sample.row, sample.view_row, sample.modification_row)}

    def complete(self) -> dict[int, bytes]:
        """The keys of the complete samples, by row."""
        return {s.row: key for key, s in self.planned.items() if self.jobs_of(s) <= self.committed}

    def views(self) -> dict[tuple[bytes, bytes], list[Planned]]:
        """The passes of each view, by modification and view, in the order of the views' rows."""
        found: dict[tuple[bytes, bytes], list[Planned]] = {}
        for sample in sorted(self.planned.values(), key=lambda s: s.view_row):
            found.setdefault((sample.modification, sample.view), []).append(sample)
        return found

    def key(self, modification: bytes, view: bytes, pass_: int) -> bytes:
        vector = np.frombuffer(modification, np.float32).reshape(-1, 4)
        return sample_key(
            self.spec.radiance_id, Modification.from_vector(vector), np.frombuffer(view, np.float32), pass_
        )

    def named(self, request: Request) -> set[bytes]:
        """The keys that a request names, whatever is planned."""
        rows = expand(self.spec, request, PlannedContent(), first_job=0, shard_rows=self.shard_rows).rows
        return {key.tobytes() for key in rows.sample_key[rows.sample_modification != UNUSED]}


class Writer:
    """What takes a job's rows, and those that it still wants."""

    def __init__(self, number: int, scene: SceneStore, job: int) -> None:
        self.number, self.job, self.spec = number, job, scene.spec
        self.out = JobWriter(scene, scene.job_rows(job))
        rows = scene.job_rows(job)
        vectors = {row: modification.vector.tobytes() for row, modification in rows.modifications.items()}
        views = {
            s.view_row: (vectors[s.modification_row], rows.views[s.view_row].vector.tobytes()) for s in rows.samples
        }
        self.left: list[tuple[Callable[..., None], int, Callable[[], Any]]] = []
        for row in sorted(rows.new_modifications if scene.spec.photons.paths else ()):
            self.left.append((self.out.photons, row, lambda row=row: photons_of(self.spec, vectors[row])))
        for row in sorted(rows.new_views):
            self.left.append((self._view, row, lambda row=row: views[row]))
        for s in rows.samples:
            self.left.append((self.out.radiance, s.row, lambda key=s.key: radiance_of(self.spec, key)))

    def _view(self, row: int, view: tuple[bytes, bytes]) -> None:
        rendered = (of(self.spec, *view) for of in (buffers_of, guides_of, visibility_of))
        self.out.view(row, *rendered)

    def give(self, count: int, choose: int = 0) -> None:
        """Hand over so many of the rows, in some order."""
        for _ in range(min(count, len(self.left))):
            take, row, values = self.left.pop(choose % len(self.left))
            take(row, values())


@dataclass
class Reader:
    """A SceneReader, and what it has been shown."""

    number: int
    reader: SceneReader
    seen: set[int] = field(default_factory=set)
    disturbed: set[int] = field(default_factory=set)  # jobs damaged or taken back since it refreshed


def compare(reader: SceneReader, row: int, model: Model) -> bytes:
    """Read a row, and compare it bit for bit with what the model has under its key; the key."""
    sample = reader.read(row, guides=True)
    modification, view = sample.modification.vector.tobytes(), sample.view.vector.tobytes()
    key = model.key(modification, view, sample.pass_number)
    assert model.complete().get(row, key) == key
    assert model.planned[key].row == row
    np.testing.assert_array_equal(sample.radiance, radiance_of(model.spec, key))
    for name, values in arrays_of(buffers_of(model.spec, modification, view)).items():
        np.testing.assert_array_equal(getattr(sample.buffers, name), values, name)
    for name, values in arrays_of(guides_of(model.spec, modification, view)).items():
        expected = round_to_8_bits(values) if name in NOISY_GUIDES else values
        np.testing.assert_array_equal(getattr(sample.guides, name), expected, name)
    if model.spec.photons.paths:
        stored = arrays_of(reader.read_photons(row))
        for name, values in arrays_of(photons_of(model.spec, modification)).items():
            np.testing.assert_array_equal(stored[name], values, name)
    return key
