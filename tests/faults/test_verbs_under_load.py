"""Repair, withdraw, join and forget while workers render, are killed, and Redis forgets: nothing is lost or twice.

Each verb runs as a user runs it, in a process of its own, and has its scene for itself; who is at work is waited for.
"""

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.plan.request import Request
from photonfarm.queue.connection import connect
from photonfarm.queue.reconciliation import reconcile
from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.check.check import check_store
from photonfarm.store.model.lease import read_leases

pytestmark = pytest.mark.skipif(not Path("/proc").is_dir(), reason="finds the workers' children through /proc")

VERB = """
import sys
from photonfarm.cli.main import main
sys.argv = ['photonfarm', *sys.argv[1:]]
sys.exit(main())
"""
REQUEST = Request(modifications=6, views_per_modification=4)
MORE = Request(modifications=9, views_per_modification=4)


class Load:
    """Two scenes of a store under workers, and what is done to them."""

    def __init__(self, analytic: ModuleType, folder: Path, seed: int) -> None:
        self._analytic, self._random = analytic, random.Random(seed)
        self.store, self.other = Store(folder / "store", create=True), Store(folder / "other", create=True)
        self.specs = analytic.small_spec(), analytic.small_spec(points=24)
        for spec in self.specs:
            self.plan(self.store, spec, REQUEST)
            self.plan(self.other, spec, MORE)
            analytic.render_missing(self.other, spec.scene_id)
        self.done: Counter[str] = Counter()

    @staticmethod
    def plan(store: Store, spec: object, request: Request) -> None:
        Store(store.root).plan(spec, request, shard_rows=2)

    def scene(self, which: int) -> SceneStore:
        return Store(self.store.root).scene(self.specs[which].scene_id)

    def verb(self, *arguments: str, codes: tuple[int, ...] = (0,)) -> None:
        command = [sys.executable, "-c", VERB, "store", *arguments, "--store", str(self.store.root)]
        ended = subprocess.run(command, capture_output=True, text=True, timeout=90)
        assert ended.returncode in codes, ended.stdout + ended.stderr

    def repair(self) -> None:
        """Flip a byte of a committed job's file, and have it set aside; other work goes on meanwhile."""
        scene = self.scene(0)
        if committed := sorted(scene.committed_jobs()):
            job = self._random.choice(committed)
            file = scene.storage.local(f"{scene.name}/{sorted(scene.marker(job)['files'])[0]}")
            content = bytearray(file.read_bytes())
            content[len(content) // 2] ^= 1
            file.write_bytes(content)
            self.verb("check", "--repair", codes=(7,))
            self.done["repair"] += 1

    def withdraw(self) -> None:
        scene = self.scene(0)
        if scene.missing_jobs():
            self.verb("withdraw", "--scene", scene.scene_id)
            self.done["withdraw"] += 1
        self.plan(self.store, self.specs[0], REQUEST)

    def join(self) -> None:
        self.verb("join", str(self.other.root))
        self.done["join"] += 1

    def forget(self) -> None:
        self.verb("forget", "--yes", "--scene", self.specs[1].scene_id)
        self.plan(self.store, self.specs[1], REQUEST)
        self.done["forget"] += 1


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_a_farm_whose_store_is_mended_undone_and_joined_under_load_has_everything_once(
    analytic: ModuleType, tmp_path: Path
) -> None:
    load = Load(analytic, tmp_path, seed=3)
    clean = {spec.scene_id: (reader := _reader(load.other, spec.scene_id), reader.rows_by_key()) for spec in load.specs}
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(EmbeddedRedis(tmp_path / "redis"))
        reconcile(load.store, connect(server.url))
        workers = []
        for number in range(3):
            worker = analytic.start_worker(
                Path(load.store.root),
                server.url,
                analytic.command(0.1),
                name=f"w{number}",
                steady_s=0.5,
                log=tmp_path / f"w{number}.log",
            )
            stack.enter_context(worker)
            stack.callback(worker.kill)
            workers.append(worker)
        for name in ("repair", "withdraw", "forget", "join", "repair", "withdraw", "join"):
            time.sleep(random.Random(name).uniform(0.3, 1.5))
            if (child := analytic.child_of(workers[0])) is not None:
                os.kill(child, signal.SIGKILL)
            if name == "join":
                connect(server.url).flushall()
            getattr(load, name)()
        for spec in load.specs:
            load.plan(load.store, spec, MORE)
        analytic.wait_for(lambda: not any(load.scene(which).missing_jobs() for which in range(2)), 120)
        for worker in workers:
            worker.send_signal(signal.SIGTERM)
        assert [worker.wait(60) for worker in workers] == [0, 0, 0]
    assert all(load.done[name] for name in ("repair", "withdraw", "join", "forget")), load.done
    assert read_leases(load.store.storage) == {}
    report = check_store(Store(load.store.root), when="now")
    assert report.exit_code == 0, report
    for spec in load.specs:
        there, rows = clean[spec.scene_id]
        here = _reader(load.store, spec.scene_id)
        found = here.rows_by_key()
        assert len(found) == len(here.rows) == MORE.modifications * MORE.views_per_modification, "everything, once"
        for key, row in found.items():
            np.testing.assert_array_equal(here.read(row).radiance, there.read(rows[key]).radiance)


def _reader(store: Store, scene_id: str) -> SceneReader:
    reader = SceneReader(store.root, scene_id)
    reader.refresh()
    return reader
