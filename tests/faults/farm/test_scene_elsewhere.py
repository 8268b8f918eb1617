"""A scene whose files are not on this machine: it is looked for again, and costs no other one."""

import sys
from pathlib import Path
from types import ModuleType

import pytest

from photonfarm.core.errors import SceneNotHereError
from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.plan.request import Request
from photonfarm.renderer.jobs import render as jobs
from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.store import SceneStore, Store

XML = '<scene version="3.0.0"><shape type="cube" id="tall-block"/></scene>'


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The scene's file, where it is looked for."""
    (tmp_path / "scenes").mkdir()
    monkeypatch.setenv("PHOTONFARM_SCENES", str(tmp_path / "scenes"))
    found = tmp_path / "scenes/late.xml"
    found.write_text(XML)
    return found


@pytest.fixture
def elsewhere(analytic: ModuleType, store: Store, file: Path) -> SceneStore:
    """A scene of one job that was planned where its file is; here it is missing."""
    spec = analytic.small_spec(scene={"file": file.name})
    scene = store.scene(store.plan(spec, Request(modifications=2), shard_rows=2).scene_id)
    file.unlink()
    return scene


def test_files_that_come_later_are_found_by_a_worker_that_is_at_work(
    analytic: ModuleType, store: Store, elsewhere: SceneStore, file: Path, redis_server: EmbeddedRedis, tmp_path: Path
) -> None:
    code = """
import runpy, sys
from photonfarm.renderer.worker import child
child.NOT_HERE_S = 3.0
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""
    log, child = tmp_path / "log", (sys.executable, "-c", code, *analytic.command()[1:])
    with analytic.start_worker(store.root, redis_server.url, child, log) as running:
        try:
            analytic.wait_for(lambda: "takes no jobs of scene" in log.read_text(), 120)
            assert elsewhere.missing_jobs() == [0]
            file.write_text(XML)
            analytic.wait_for(lambda: not elsewhere.missing_jobs(), 60)
        finally:
            running.terminate()
    assert "starting again" not in log.read_text()


def test_a_scene_that_is_not_here_costs_no_scene_that_is_loaded(
    analytic: ModuleType, store: Store, elsewhere: SceneStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jobs, "SCENES_KEPT", 1)
    loaded = []

    def load(spec: object) -> object:
        loaded.append(spec)
        return analytic.AnalyticScene(spec)

    here = store.plan(analytic.small_spec(), Request(modifications=4), shard_rows=2).scene_id
    renderer = ShardRenderer(store, worker="test", load=load)
    assert renderer.render(here, 0)
    with pytest.raises(SceneNotHereError):
        renderer.render(elsewhere.scene_id, 0)
    assert renderer.render(here, 1)
    assert len(loaded) == 1
