from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from photonfarm.plan.request import Request
from photonfarm.store import SceneStore, Store


@pytest.fixture
def planned(tmp_path: Path, analytic: ModuleType) -> Callable[..., SceneStore]:
    """A scene with a plan of `jobs` jobs, of two samples each."""

    def plan(jobs: int, name: str = "store") -> SceneStore:
        store = Store(tmp_path / name, create=True)
        request = Request(modifications=-(-jobs // 2), views_per_modification=2, passes=2)
        return store.scene(store.plan(analytic.small_spec(), request, shard_rows=2).scene_id)

    return plan


@pytest.fixture
def clean_bytes(planned: Callable[..., SceneStore], analytic: ModuleType) -> Callable[[int], dict[str, bytes]]:
    """What one process leaves that renders all jobs in order, undisturbed: bytes by path within the scene."""
    from photonfarm.renderer.jobs.render import ShardRenderer

    def render(jobs: int) -> dict[str, bytes]:
        scene = planned(jobs, "clean")
        renderer = ShardRenderer(Store(scene.folder.parent.parent), worker="clean", load=analytic.AnalyticScene.load)
        for job in scene.missing_jobs():
            renderer.render(scene.scene_id, job)
        return data_of(scene)

    return render


def data_of(scene: SceneStore) -> dict[str, bytes]:
    """Every data file of a scene, without the markers."""
    files = [p for part in ("plans", "base") for p in (scene.folder / part).rglob("*") if p.is_file()]
    return {str(p.relative_to(scene.folder)): p.read_bytes() for p in files}


@pytest.fixture
def stored_bytes() -> Callable[[SceneStore], dict[str, bytes]]:
    """The function `data_of`."""
    return data_of
