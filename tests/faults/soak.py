"""A soak: workers, Redis and submitters are killed, stopped and made to forget at random, while a reader looks on.

Invariants, checked all the time: the committed set only grows, and what is committed reads whole and is what an
undisturbed worker renders. In the end every slot is there once, bit for bit, through zarr-python too.
"""

import contextlib
import importlib.util
import os
import random
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import redis
import zarr

from photonfarm.renderer.jobs import ShardRenderer
from photonfarm.shared.plan import Request
from photonfarm.shared.queue import connect, reconcile
from photonfarm.shared.redis_server import EmbeddedRedis
from photonfarm.shared.store import SceneReader, SceneStore, Store

_spec = importlib.util.spec_from_file_location("analytic_scene", Path(__file__).with_name("analytic_scene.py"))
analytic = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(analytic)

HEARTBEAT_TTL_S = 2.0
STOPPED_S = (3.0, 5.0)  # longer than the heartbeat lasts, so that another worker takes the slot
STEADY_S = 0.5  # a child that is killed is started again at once, however often that happens


@dataclass
class Toll:
    """How often each thing was done."""

    kills: int = 0  # workers' children, by SIGKILL
    stops: int = 0  # workers' children, by SIGSTOP, until another one may have taken their job
    races: int = 0  # jobs that a stopped worker went on with, and finished after another one had committed them
    redis_kills: int = 0  # by SIGKILL; back after up to 3 s, once after 40 s
    flushes: int = 0  # FLUSHALL
    submitters: int = 0  # pairs of submitters at once

    def left(self, wanted: "Toll") -> list[str]:
        """The names of what has not been done often enough, each as often as it is missing."""
        done = asdict(self)
        return [name for name, count in asdict(wanted).items() for _ in range(count - done[name])]


@dataclass(frozen=True)
class Outcome:
    """What a soak showed."""

    toll: Toll
    jobs: int
    samples: int
    reads: int  # samples read and compared while it went on
    seconds: float


class Soak:
    """One soak, in a folder of its own."""

    def __init__(self, folder: Path, *, jobs: int, workers: int, pause_s: float, seed: int) -> None:
        """Plan `jobs` jobs of two samples; each half takes `pause_s` to render."""
        self._folder = folder
        self._random = random.Random(seed)
        self._workers = workers
        self._pause_s = pause_s
        self._store = Store(folder / "store", create=True)
        self._request = Request(modifications=max(1, jobs // 4), views_per_modification=4, passes=2)
        plan = self._store.plan(analytic.small_spec(), self._request, shard_rows=2)
        self.scene: SceneStore = self._store.scene(plan.scene_id)
        self._running: list[subprocess.Popen[bytes]] = []
        self._stopped: list[threading.Thread] = []
        self._had_outage = False
        self.toll = Toll()

    # ----------------------------------------------------------------------------------------------------- what happens

    def run(self, wanted: Toll, *, pace_s: tuple[float, float], long_outage_s: float) -> Outcome:
        """Do all that is wanted, in random order, and wait until every job is committed."""
        begun = time.monotonic()
        with EmbeddedRedis(self._folder / "redis") as server, contextlib.ExitStack() as stack:
            watcher = stack.enter_context(_Watcher(self._store.root, self.scene.scene_id))
            reconcile(self._store, connect(server.url))
            for number in range(self._workers):
                self._running.append(stack.enter_context(self._start(server, number)))
                stack.callback(self._running[-1].kill)
            analytic.wait_for(lambda: all(map(analytic.child_of, self._running)))  # they want a Redis to begin with
            while left := self.toll.left(wanted):
                time.sleep(self._random.uniform(*pace_s))
                getattr(self, f"_do_{self._random.choice(left)}")(server, long_outage_s)
                self._keep_busy()
                self.toll.races = self._races()
                watcher.check()
                assert [process.poll() for process in self._running] == [None] * self._workers
            for thread in self._stopped:
                thread.join()
            analytic.wait_for(lambda: watcher.check() or not self.scene.missing_jobs(), 600)
            for process in self._running:
                process.send_signal(signal.SIGTERM)
            assert [process.wait(60) for process in self._running] == [0] * self._workers
            watcher.check()
        self._store.sweep(stray_age_s=0)
        reads = self._compare(watcher)
        samples = self.scene.progress().committed_samples
        return Outcome(self.toll, self.scene.jobs(), samples, reads, time.monotonic() - begun)

    def _start(self, server: EmbeddedRedis, number: int) -> subprocess.Popen[bytes]:
        return analytic.start_worker(
            self._store.root, server.url, analytic.command(self._pause_s), name=f"worker-{number}",
            heartbeat_ttl_s=HEARTBEAT_TTL_S, steady_s=STEADY_S, log=self._folder / f"worker-{number}.log",
        )  # fmt: skip

    def _keep_busy(self) -> None:
        """Plan more if what is planned is nearly done before all has happened."""
        if len(self.scene.missing_jobs()) < 4 * self._workers:
            self._submit_more()

    def _submit_more(self) -> list[threading.Thread]:
        self._request = self._request.model_copy(update={"modifications": self._request.modifications + 8})
        racers = [
            threading.Thread(target=Store(self._store.root).plan, args=(analytic.small_spec(), self._request))
            for _ in range(2)
        ]
        for racer in racers:
            racer.start()
        for racer in racers:
            racer.join()
        return racers

    def _child(self) -> int | None:
        return analytic.child_of(self._random.choice(self._running))

    def _do_kills(self, *_: Any) -> None:
        child = self._child()
        with contextlib.suppress(ProcessLookupError):
            if child is not None:
                os.kill(child, signal.SIGKILL)
                self.toll.kills += 1

    def _do_stops(self, *_: Any) -> None:
        child = self._child()
        with contextlib.suppress(ProcessLookupError):
            if child is not None:
                os.kill(child, signal.SIGSTOP)
                thread = threading.Thread(target=_go_on, args=(child, self._random.uniform(*STOPPED_S)))
                thread.start()
                self._stopped.append(thread)
                self.toll.stops += 1

    def _do_races(self, *_: Any) -> None:
        self._do_stops()

    def _do_redis_kills(self, server: EmbeddedRedis, long_outage_s: float) -> None:
        os.kill(server.pid, signal.SIGKILL)
        time.sleep(self._random.uniform(0, 3) if self._had_outage else long_outage_s)
        self._had_outage = True
        server.keep_running()
        self.toll.redis_kills += 1

    def _do_flushes(self, server: EmbeddedRedis, _: float) -> None:
        with contextlib.suppress(redis.RedisError):
            connect(server.url).flushall()
            self.toll.flushes += 1

    def _do_submitters(self, *_: Any) -> None:
        self._submit_more()
        self.toll.submitters += 1

    # -------------------------------------------------------------------------------------------------- what must hold

    def _compare(self, watcher: "_Watcher") -> int:
        """Compare every file with an undisturbed worker's, and zarr-python's reading with ours; samples read before."""
        clean = Store(self._folder / "clean", create=True)
        for plan in self.scene.plans():
            clean.plan(self.scene.spec, plan.request, shard_rows=2)
        twin = clean.scene(self.scene.scene_id)
        renderer = ShardRenderer(clean, worker="clean", load=analytic.AnalyticScene.load)
        for job in twin.missing_jobs():
            renderer.render(twin.scene_id, job)
        ours, theirs = _data(self.scene), _data(twin)
        assert ours.keys() == theirs.keys()
        assert [name for name in ours if ours[name] != theirs[name]] == []
        assert not self.scene.storage.names("tmp"), "nothing half-written is left"
        reader = SceneReader(self._store.root, self.scene.scene_id)
        rows = reader.refresh()
        keys = [plan.rows.sample_key[plan.rows.sample_pass >= 0] for plan in self.scene.plans()]
        assert len(np.unique(np.concatenate(keys), axis=0)) == sum(map(len, keys)) == len(rows), "every key once"
        for plan in self.scene.plans():
            group = zarr.open_group(str(self.scene.storage.local(plan.folder)), mode="r")
            stored = group["radiance"][:].astype(np.float32)
            scale = np.float32(2.0 ** -group["radiance"].attrs["radiance_exponent"])
            for row in rows[(rows >= plan.first_row) & (rows < plan.end_row)]:
                np.testing.assert_array_equal(stored[row - plan.first_row] * scale, reader.read(int(row)).radiance)
        watcher.compare(twin)
        return watcher.reads

    def _races(self) -> int:
        """Jobs that more than one worker finished, as the workers' logs tell."""
        logs = [path.read_text(errors="replace") for path in self._folder.glob("worker-*.log")]
        return sum(log.count("was committed by another worker") for log in logs)


class _Watcher:
    """A reader beside it all: whatever it is shown must read whole, stay, and be right."""

    def __init__(self, root: Any, scene_id: str) -> None:
        self._reader = SceneReader(root, scene_id)
        self._markers: Callable[[], set[int]] = Store(root).scene(scene_id).committed_jobs
        self._seen: set[int] = set()
        self._images: dict[int, np.ndarray] = {}
        self._error: Exception | None = None
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self.reads = 0

    def __enter__(self) -> "_Watcher":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def check(self) -> None:
        """Raise what it has found wrong."""
        if self._error is not None:
            raise self._error

    def compare(self, twin: SceneStore) -> None:
        """What it read while it all went on, with the undisturbed samples."""
        reader = SceneReader(twin.storage.where, twin.scene_id)
        reader.refresh()
        for row, image in self._images.items():
            np.testing.assert_array_equal(image, reader.read(row).radiance)

    def _watch(self) -> None:
        choose = random.Random(1)
        try:
            while not self._ended.wait(0.05):
                markers = self._markers()
                assert self._seen <= markers, f"jobs {self._seen - markers} are not committed any more"
                self._seen = markers
                rows = list(self._reader.refresh())
                everywhere = self._reader.rows
                rows += [everywhere[choose.randrange(len(everywhere))] for _ in range(4 if len(everywhere) else 0)]
                for row in map(int, rows):
                    image = self._reader.read(row).radiance
                    if row in self._images:
                        np.testing.assert_array_equal(image, self._images[row])
                    self._images[row] = image
                    self.reads += 1
        except Exception as error:
            self._error = error


def _go_on(child: int, after_s: float) -> None:
    time.sleep(after_s)
    with contextlib.suppress(ProcessLookupError):
        os.kill(child, signal.SIGCONT)


def _data(scene: SceneStore) -> dict[str, bytes]:
    """Every shard of a scene and its base."""
    files = [p for p in scene.folder.rglob("c.*") if p.is_file()]
    return {str(p.relative_to(scene.folder)): p.read_bytes() for p in files}
