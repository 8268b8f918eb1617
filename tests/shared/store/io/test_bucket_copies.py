"""A bucket that is gone, and commits past copies of its objects on this machine that are damaged."""

from typing import Any

import obstore
import pytest
import store_samples as samples
from obstore.store import from_url

from photonfarm.core.errors import CorruptError, StoreError
from photonfarm.plan.request import Request
from photonfarm.store import SceneReader, SceneStore, Store


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
