"""Runs to report on."""

import pytest

from photonfarm.plan.request import Request
from photonfarm.store import SceneReader
from photonfarm.store.read.find import Query
from photonfarm.store.read.merge import merge_views
from photonfarm.trainer.training.loop import train


@pytest.fixture
def measured(scene, commit, tiny, tmp_path):
    """A store of 16 configurations of two passes, references of all views, and two runs."""
    scene.plan(Request(modifications=16, passes=2), shard_rows=8)
    for job in range(scene.jobs()):
        commit(scene, job)
    store, references = scene.folder.parent.parent, tmp_path / "references"
    references.mkdir()
    for key, merged in merge_views(scene, Query()):
        merged.write(references / f"{key}.npz")
    runs = []
    for architecture in ("light_transport", "denoise_4"):
        settings = tiny(max_steps=4, hold_out=0.4, network={"width": 4, "architecture": architecture})
        train(SceneReader(store, scene.scene_id), settings, tmp_path / architecture)
        runs.append(tmp_path / architecture)
    return store, runs, references
