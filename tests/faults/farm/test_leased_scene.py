"""A worker leaves a scene to whoever has it for itself, says so, and comes back."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.queue.connection import connect
from photonfarm.queue.job import TRIES
from photonfarm.queue.rq_adapter import open_queue, queue_status
from photonfarm.store import SceneStore, Store
from photonfarm.store.model.lease import hold_lease


@pytest.mark.parametrize("share", [None, pytest.param("0/1", marks=pytest.mark.slow)])
def test_a_worker_leaves_a_scene_that_somebody_has_for_itself_until_it_is_free(
    analytic: ModuleType,
    planned: Callable[..., SceneStore],
    redis_server: EmbeddedRedis,
    tmp_path: Path,
    share: str | None,
) -> None:
    scene, connection, log = planned(4), connect(redis_server.url), tmp_path / "log"
    store, url = Store(scene.folder.parent.parent), None if share else redis_server.url
    with analytic.start_worker(
        store.root, url, analytic.command(0.15), log, share=share, until_complete=True, name="ada"
    ) as worker:
        try:
            analytic.wait_for(lambda: len(scene.committed_jobs()) == 1, 60)
            with hold_lease(store.storage, scene.scene_id, "store check --repair", lambda _: None):
                done = len(scene.committed_jobs())
                analytic.wait_for(lambda: "takes no jobs of scene" in log.read_text(), 30)
                if not share:
                    analytic.wait_for(lambda: queue_status(connection).skipped)
                    (reason,) = queue_status(connection).skipped[scene.scene_id].values()
                    assert "store check --repair" in reason
                    jobs = open_queue(connection)
                    assert {jobs.fetch_job(name).retries_left for name in jobs.job_ids} == {TRIES - 1}
                assert len(scene.committed_jobs()) == done
                assert worker.poll() is None
            assert worker.wait(60) == 0
        except BaseException:
            worker.kill()
            raise
    assert scene.missing_jobs() == []
    assert "takes jobs of scene" in log.read_text()
    assert not store.storage.names("failures")
