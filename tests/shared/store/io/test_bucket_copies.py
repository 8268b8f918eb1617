"""A bucket that is gone, and commits past copies of its objects on this machine that are damaged."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import obstore
import pytest
import store_samples as samples
from obstore.store import from_url

from photonfarm.core.errors import CorruptError, StoreError
from photonfarm.plan.request import Request
from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.format import markers


@pytest.fixture
def store(url: str) -> Store:
    return Store(url, create=True)


@pytest.fixture
def scene(store: Store) -> SceneStore:
    """Two jobs of two samples, the first of them committed."""
    scene = store.scene(store.plan(samples.small_spec(), Request(modifications=4), shard_rows=2).scene_id)
    assert samples.commit(scene, 0, samples.outputs(scene, 0))
    return scene


def objects_below(url: str) -> tuple[Any, list[str]]:
    bucket = from_url(url, client_options={"allow_http": True})
    return bucket, [about["path"] for batch in obstore.list(bucket) for about in batch]


# ------------------------------------------------------------------------------------------------- a store that is gone


@pytest.fixture
def folders_end_with_their_objects(monkeypatch: pytest.MonkeyPatch) -> None:
    """Folders end as in S3: SeaweedFS goes on listing an empty folder for some time."""
    plain = obstore.list_with_delimiter

    def without_empty_ones(bucket: Any, prefix: str | None = None) -> Any:
        found = plain(bucket, prefix)
        full = [folder for folder in found["common_prefixes"] if any(obstore.list(bucket, folder))]
        return {**found, "common_prefixes": full}

    monkeypatch.setattr(obstore, "list_with_delimiter", without_empty_ones)


@pytest.mark.usefixtures("folders_end_with_their_objects")
def test_nothing_of_a_bucket_that_was_emptied_is_taken_for_missing(url: str, store: Store, scene: SceneStore) -> None:
    reader = SceneReader(url, scene.scene_id)
    assert reader.refresh().tolist() == [0, 1]
    given = samples.outputs(scene, 1)
    obstore.delete(*objects_below(url))
    for look in (
        store.scene_ids,
        scene.missing_jobs,
        reader.refresh,
        lambda: reader.read(0),
        lambda: scene.write_base(*samples.base()),
        lambda: scene.plan(Request(modifications=9)),
        lambda: samples.commit(scene, 1, given),
    ):
        with pytest.raises(StoreError, match="gone") as caught:
            look()
        assert not isinstance(caught.value, CorruptError)
    assert objects_below(url)[1] == [], "nothing of it is begun anew"


# ------------------------------------------------------------------------------------------------------ damaged copies


def index(copy: Path) -> None:
    """A damage that is seen when the copy is opened."""
    content = bytearray(copy.read_bytes())
    content[-7] ^= 1
    copy.write_bytes(content)


def checksum_of_a_row(copy: Path) -> None:
    """A damage that is seen when a row is read; until then the file's own checksum is another one."""
    row_bytes = 2 * 8 * 8 * 3 * 2
    content = bytearray(copy.read_bytes())
    content[row_bytes + 1] ^= 1
    copy.write_bytes(content)


def damage(scene: SceneStore, harm: Callable[[Path], None]) -> None:
    """Harm this machine's copy of the radiance of job 1."""
    copy = scene.storage.local(f"{scene.name}/plans/000000/radiance/c.1.0.0.0.0")
    harm(copy)


def read(url: str, scene: SceneStore) -> dict[int, np.ndarray]:
    reader = SceneReader(url, scene.scene_id)
    return {row: reader.read(row).radiance for row in reader.refresh().tolist()}


@pytest.mark.parametrize("harm", [index, checksum_of_a_row])
def test_a_marker_is_not_taken_back_for_a_copy_that_is_damaged_on_this_machine(
    url: str, scene: SceneStore, harm: Callable[[Path], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another worker announces the files of ours before we do, and our copies of them rot."""
    another, place = Store(url).scene(scene.scene_id), markers.place_marker

    def meanwhile(*about: Any) -> bool:
        monkeypatch.setattr(markers, "place_marker", place)
        assert samples.commit(another, 1, samples.outputs(another, 1))
        damage(scene, harm)
        return place(*about)

    monkeypatch.setattr(markers, "place_marker", meanwhile)
    assert not samples.commit(scene, 1, samples.outputs(scene, 1))
    assert scene.storage.names("quarantine") == []
    assert scene.missing_jobs() == []
    for row, radiance in samples.outputs(scene, 1).radiance.items():
        np.testing.assert_array_equal(read(url, scene)[row], radiance)


@pytest.mark.parametrize("harm", [index, checksum_of_a_row])
def test_whole_files_of_a_dead_writer_are_kept_though_their_copies_on_this_machine_are_damaged(
    url: str, scene: SceneStore, harm: Callable[[Path], None]
) -> None:
    theirs = samples.outputs(scene, 1)
    assert samples.commit(scene, 1, theirs)
    obstore.delete(objects_below(url)[0], markers.marker_name(scene.name, 1))
    damage(scene, harm)
    ours = {row: halves + 1 for row, halves in theirs.radiance.items()}
    assert samples.commit(scene, 1, replace(theirs, radiance=ours))
    for row, radiance in theirs.radiance.items():
        np.testing.assert_array_equal(read(url, scene)[row], radiance)
