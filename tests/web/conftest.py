"""A farm with something of all that can be watched."""

import json
from pathlib import Path

import pytest
import queue_samples
import redis
import store_samples as samples

from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.farm.watch import FarmWatch
from photonfarm.plan.request import Request
from photonfarm.queue.reconciliation import reconcile
from photonfarm.queue.workers import Activity, WorkerReport
from photonfarm.store import SceneStore, Store


@pytest.fixture
def scene(store: Store) -> SceneStore:
    """Four jobs of two samples, two of them committed."""
    found = store.scene(store.plan(samples.small_spec(), Request(modifications=8), shard_rows=2).scene_id)
    found.write_base(*samples.base())
    for job in range(2):
        samples.commit(found, job, samples.outputs(found, job))
    return found


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The folder of a run that has been validated."""
    folder = tmp_path / "run"
    folder.mkdir()
    spent = {"train": 15.0, "wait_data": 4.0}
    records = [
        {"kind": "train", "step": 40, "loss": 0.25, "seconds": {"train": 12.0}},
        {"kind": "validation", "step": 50, "error": 0.5, "standard_error": 0.125, "held_out": 3, "seconds": spent},
    ]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    (folder / "settings.json").write_text('{"max_steps": 200}')
    return folder


@pytest.fixture
def farm(scene: SceneStore, run: Path, store: Store, connection: redis.Redis, common_redis: EmbeddedRedis) -> FarmWatch:
    """A farm with a queue, three workers, a failure and a run."""
    reconcile(store, connection)
    name = queue_samples.taken(connection, "ada").job_id
    doing = Activity("renders samples", 1, 2, name)
    left = {scene.scene_id: "room.xml is missing"}
    for worker, report in (
        ("ada", {"doing": doing}),
        ("bob", {"paused": "the disk is full", "left": left}),
        ("eve", {}),
    ):
        queue_samples.told(connection, worker, WorkerReport(host="elsewhere", process=1, **report))
    queue_samples.failed(connection, "ValueError: 7 is odd")
    return FarmWatch(store, common_redis.url, [run])
