"""A small store to damage and check, and what the tests of `photonfarm store check` do with it."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import store_samples as samples

from photonfarm.plan.request import Request
from photonfarm.store import SceneStore, Store
from photonfarm.store.check.check import StoreReport, check_store

_MADE: dict[str, Path] = {}
"""Stores that are made once, and copied for each test: that takes a third of the time."""


@pytest.fixture
def scene(store: Store, tmp_path_factory: pytest.TempPathFactory) -> SceneStore:
    """Three jobs of 4, 4 and 2 samples, all committed, one of them in radiance_wide; and the base."""

    def make(scene: SceneStore) -> None:
        commit_all(scene)
        scene.write_base(*samples.base())

    return copied("scene", make, store, tmp_path_factory)


def copied(
    name: str, make: Callable[[SceneStore], None], store: Store, tmp_path_factory: pytest.TempPathFactory
) -> SceneStore:
    """A planned scene of which something was made, in an empty store that keeps its own identity."""
    request = Request(modifications=5, views_per_modification=2)
    if name not in _MADE:
        first = Store(tmp_path_factory.mktemp("made") / "store", create=True)
        make(first.scene(first.plan(samples.small_spec(), request, shard_rows=4).scene_id))
        _MADE[name] = Path(first.root)
    shutil.copytree(_MADE[name] / "scenes", Path(store.root) / "scenes", dirs_exist_ok=True)
    return store.scene(samples.small_spec().scene_id)


def outputs(scene: SceneStore, job: int) -> Any:
    given = samples.outputs(scene, job)
    if job == 1:
        given.radiance[5][0, 0, 0, 0] = 1e9
    for buffers in given.buffers.values():
        buffers.normal[::2] *= -1  # no view sees everything from behind
    for row, photons in given.photons.items():
        photons.power[0] += row  # no two modifications alike
    return given


def commit_all(scene: SceneStore) -> None:
    for job in scene.missing_jobs():
        assert samples.commit(scene, job, outputs(scene, job))


def checked(store: Store, **options: Any) -> StoreReport:
    return check_store(Store(store.root), when="now", **options)


def found(report: StoreReport) -> dict[str, int]:
    """How many findings of each cause that is not only worth a look."""
    (scene,) = report.scenes
    return {group.cause.label: group.count for group in scene.groups if group.cause.remedy.name != "LOOK"}


def noted(report: StoreReport) -> dict[str, int]:
    (scene,) = report.scenes
    return {group.cause.label: group.count for group in scene.groups}


def data(scene: SceneStore) -> dict[str, bytes]:
    files = [p for part in ("plans", "base") for p in (scene.folder / part).rglob("*") if p.is_file()]
    return {str(p.relative_to(scene.folder)): p.read_bytes() for p in files}


def shard(scene: SceneStore, name: str, job: int = 0) -> Path:
    (path,) = (scene.folder / "plans/000000" / name).glob(f"c.{job}.*")
    return path


def flip(path: Path, place: int) -> None:
    content = bytearray(path.read_bytes())
    content[place] ^= 0x10
    path.write_bytes(content)


def marker(scene: SceneStore, job: int) -> Path:
    return scene.folder / f"committed/{job:012d}.json"


def recommitted(scene: SceneStore, job: int, change: Callable[[Any], None]) -> None:
    """Commit a job once more with other outputs, as a faulty worker might have."""
    for name in scene.marker(job)["files"]:
        (scene.folder / name).unlink()
    marker(scene, job).unlink()
    given = outputs(scene, job)
    change(given)
    assert samples.commit(scene, job, given)
