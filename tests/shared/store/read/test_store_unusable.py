"""Stores that are missing, damaged, full or of another version: one sentence, and nothing is lost."""

import errno
import os
import resource
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import store_samples as samples

from photonfarm.core.errors import CorruptError, StoreError
from photonfarm.plan.request import Request
from photonfarm.store import SceneStore, Store

scene, reader_of = samples.scene, samples.reader_of


def test_a_missing_store_and_a_folder_that_is_none_are_refused(tmp_path: Path) -> None:
    with pytest.raises(StoreError):
        Store(tmp_path)
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(StoreError):
        Store(tmp_path, create=True)


def test_a_store_under_a_file_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError):
        Store(tmp_path / "file" / "store", create=True)


def test_a_disk_that_is_full_in_the_middle_is_a_store_error_and_leaves_no_trace(scene: SceneStore) -> None:
    """A limit on the size of files stands for the full disk: the shard of radiance does not fit."""
    given = samples.outputs(scene, 0)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, before[1]))
    try:
        with pytest.raises(StoreError):
            samples.commit(scene, 0, given)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert scene.missing_jobs() == [0, 1, 2]
    assert list(scene.storage.local("tmp").iterdir()) == []
    assert samples.commit(scene, 0, given)
    assert reader_of(scene).read(0).radiance.shape == (2, 8, 8, 3)


def test_a_disk_that_turns_read_only_in_the_middle_of_a_job_is_a_store_error(
    scene: SceneStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its files can then be neither named nor removed; a sweep removes them, once the disk can be written."""

    def refuse(path: Any, *_: Any, **__: Any) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))

    with monkeypatch.context() as patch:
        patch.setattr(os, "link", refuse)
        patch.setattr(Path, "unlink", refuse)
        with pytest.raises(StoreError):
            samples.commit(scene, 0, samples.outputs(scene, 0))
    assert scene.missing_jobs() == [0, 1, 2]
    assert samples.commit(scene, 0, samples.outputs(scene, 0))


# ------------------------------------------------------------------------------------------------- plans that are lost


LOSSES: dict[str, Callable[[Path], None]] = {
    "zarr.json of the first": lambda plans: (plans / "000000/zarr.json").unlink(),
    "zarr.json of the last": lambda plans: (plans / "000002/zarr.json").unlink(),
    "all files of the last": lambda plans: [shutil.rmtree(plans / "000002"), (plans / "000002").mkdir()],
    "one between others": lambda plans: shutil.rmtree(plans / "000001"),
}


@pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)
def test_a_plan_that_is_lost_is_an_error_that_names_it_and_nothing_is_read_or_planned_without_it(
    store: Store, scene: SceneStore, loss: Callable[[Path], None]
) -> None:
    requests = [Request(modifications=n, views_per_modification=2) for n in (6, 7, 8)]
    for request in requests[:2]:
        scene.plan(request)
    samples.commit_all(scene)
    loss(scene.folder / "plans")
    for look in (
        lambda: reader_of(scene),
        lambda: scene_of(store).jobs(),
        lambda: scene_of(store).plan(requests[2]),
    ):
        with pytest.raises(CorruptError, match=r"plans/00000\d.*put the folder back"):
            look()


def scene_of(store: Store) -> SceneStore:
    """The scene as a new process sees it."""
    (scene,) = Store(store.root).scenes()
    return scene


def test_no_plan_takes_the_number_of_jobs_that_are_committed(store: Store, scene: SceneStore) -> None:
    """The folder of the last plan is gone, and only the marker of its job tells of it."""
    scene.plan(Request(modifications=6, views_per_modification=2))
    samples.commit_all(scene)
    shutil.rmtree(scene.folder / "plans/000001")
    with pytest.raises(CorruptError):
        scene_of(store).plan(Request(modifications=7, views_per_modification=2))
    assert not (scene.folder / "plans/000001").exists()


# ----------------------------------------------------------------------------------------------------------- sweeping
