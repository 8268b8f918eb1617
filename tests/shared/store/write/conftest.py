"""Stores that tests of writing begin with."""

from pathlib import Path

import pytest
import store_samples as samples
from older_store import REQUEST

from photonfarm.shared.store import Store


@pytest.fixture(scope="module")
def older(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An older store: three jobs of 4, 4 and 2 samples, all committed, and the base; nobody has asked for guides."""
    store = Store(tmp_path_factory.mktemp("older") / "store", create=True)
    scene = store.scene(store.plan(samples.small_spec(), REQUEST, shard_rows=4).scene_id)
    samples.commit_all(scene)
    scene.write_base(*samples.base())
    return Path(store.root)
