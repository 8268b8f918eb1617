"""A scene whose samples are all there."""

import shutil
from pathlib import Path

import pytest
from exports import commit, planned

from photonfarm.store import SceneStore, Store


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """10 samples in jobs of 2, of 5 configurations with 2 views each; all committed."""
    place: Path = tmp_path_factory.mktemp("made") / "store"
    scene = planned(place, modifications=5, views=2)
    for job in range(scene.jobs()):
        commit(scene, job)
    return place


@pytest.fixture
def scene(made: Path, tmp_path: Path) -> SceneStore:
    """That scene, in a store of the test's own."""
    shutil.copytree(made, tmp_path / "store")
    (scene,) = Store(tmp_path / "store").scenes()
    return scene
