"""What a soak is judged by: what the children say, what a reader beside them sees, and what an undisturbed worker does.

`differences` puts all of it into sentences; none is what a soak must end with.
"""

import random
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import analytic_scene as analytic
import numpy as np

from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.format.markers import marker_name

CHILD = """
import os, sys
from photonfarm.renderer.jobs import render as jobs
from photonfarm.renderer.worker import child as worker_child
sys.path.append(sys.argv[1])
import analytic_scene as analytic
analytic.AnalyticScene.pause_s = float(sys.argv[3])
journal = os.open(f"{sys.argv[2]}/{os.getpid()}", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
plain = jobs.ShardRenderer.render

def telling(renderer, scene_id, job):
    os.write(journal, f"begins {job}\\n".encode())
    end = "leaves"
    try:
        committed = plain(renderer, scene_id, job)
        end = "commits" if committed else "finds"
        return committed
    finally:
        os.write(journal, f"{end} {job}\\n".encode())

jobs.ShardRenderer.render = telling
sys.exit(worker_child.child(analytic.AnalyticScene.load))
"""
"""A worker's child as `analytic_scene` has it, which keeps a journal: a job that it begins, and whether it has
committed it then, has found it committed by another, or leaves it with an error."""


class Journal:
    """What all children have said of their jobs."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self._folder = folder

    def command(self, pause_s: float) -> tuple[str, ...]:
        """The command of a child that writes here; each half of a sample takes `pause_s`."""
        return (sys.executable, "-c", CHILD, str(analytic.FOLDER), str(self._folder), str(pause_s))

    def in_hand(self, child: int) -> int | None:
        """The job that a child has begun and not ended."""
        word, job = (self.of(child) or [("", -1)])[-1]
        return job if word == "begins" else None

    def of(self, child: int) -> list[tuple[str, int]]:
        """What a child, by its process, has said so far, in order."""
        file = self._folder / str(child)
        written = file.read_text() if file.exists() else ""
        whole = written[: written.rfind("\n") + 1]  # a line may be under way
        return [(word, int(job)) for word, job in map(str.split, whole.splitlines())]

    def twice(self) -> dict[int, int]:
        """Jobs that more than one child has said to have committed, and how many; who is killed may not get so far."""
        said = [entry for file in self._folder.iterdir() for entry in self.of(int(file.name))]
        commits = Counter(job for word, job in said if word == "commits")
        return {job: times for job, times in commits.items() if times > 1}


class Watcher:
    """A reader beside it all: whatever it is shown must read whole, stay, and be right."""

    def __init__(self, root: str | Path, scene_id: str) -> None:
        self._reader = SceneReader(root, scene_id)
        self._scene = Store(root).scene(scene_id)
        self._random = random.Random(1)
        self._error: Exception | None = None
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self.markers: dict[int, bytes] = {}  # of every job, as they were seen first
        self.images: dict[int, np.ndarray] = {}  # of every row that was shown, as it was read first
        self.reads = 0

    def __enter__(self) -> "Watcher":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def check(self) -> None:
        """Raise what it has found wrong."""
        if self._error is not None:
            raise self._error

    def _watch(self) -> None:
        try:
            while not self._ended.wait(0.05):
                self._look()
            self._look()
        except Exception as error:
            self._error = error

    def _look(self) -> None:
        committed = self._scene.committed_jobs()
        assert self.markers.keys() <= committed, f"jobs {self.markers.keys() - committed} are not committed any more"
        for job in committed - self.markers.keys():
            self.markers[job] = marker_of(self._scene, job)
        rows = list(self._reader.refresh())
        everywhere = self._reader.rows
        rows += [everywhere[self._random.randrange(len(everywhere))] for _ in range(4 if len(everywhere) else 0)]
        for row in map(int, rows):
            image = self._reader.read(row).radiance
            np.testing.assert_array_equal(image, self.images.setdefault(row, image))
            self.reads += 1


def marker_of(scene: SceneStore, job: int) -> bytes:
    """A job's marker, byte for byte: it names the worker and the seconds, in which two commits of a job differ."""
    return scene.storage.read(marker_name(scene.name, job))


def differences(scene: SceneStore, clean: Path, journal: Journal, watcher: Watcher) -> list[str]:
    """What is not as an undisturbed worker, who works in the folder `clean`, would have left it."""
    return [
        *_committed_twice(scene, journal, watcher),
        *_unlike(scene, rendered_undisturbed(scene, clean), watcher),
        *_not_once(scene, watcher),
        *(f"{name} is left half-written" for name in scene.storage.names("tmp")),
    ]


def rendered_undisturbed(scene: SceneStore, clean: Path) -> SceneStore:
    """The same plans, rendered in order by one worker."""
    store = Store(clean, create=True)
    for plan in scene.plans():
        store.plan(scene.spec, plan.request, shard_rows=2)
    twin = store.scene(scene.scene_id)
    renderer = ShardRenderer(store, worker="clean", load=analytic.AnalyticScene.load)
    for job in twin.missing_jobs():
        renderer.render(twin.scene_id, job)
    return twin


def _committed_twice(scene: SceneStore, journal: Journal, watcher: Watcher) -> Iterator[str]:
    committed = scene.committed_jobs()
    yield from (f"job {job} is not committed" for job in scene.missing_jobs())
    yield from (f"job {job} was committed, and nobody saw it" for job in committed - watcher.markers.keys())
    for job in committed & watcher.markers.keys():
        if marker_of(scene, job) != watcher.markers[job]:
            yield f"job {job} has another marker than it had first"
    yield from (f"job {job} was committed {times} times" for job, times in journal.twice().items())


def _unlike(scene: SceneStore, twin: SceneStore, watcher: Watcher) -> Iterator[str]:
    ours, theirs = _data(scene), _data(twin)
    for name in sorted(ours.keys() | theirs.keys()):
        if ours.get(name) != theirs.get(name):
            yield f"{name} is not what an undisturbed worker writes"
    for job in scene.committed_jobs():
        if scene.marker(job)["files"] != twin.marker(job)["files"]:
            yield f"job {job}: its marker does not tell the files that an undisturbed worker's tells"
    reader = SceneReader(twin.storage.where, twin.scene_id)
    reader.refresh()
    for row, image in watcher.images.items():
        if not np.array_equal(image, reader.read(row).radiance):
            yield f"row {row} was shown, and is not what an undisturbed worker renders"


def _not_once(scene: SceneStore, watcher: Watcher) -> Iterator[str]:
    keys = [plan.rows.sample_key[plan.rows.sample_pass >= 0] for plan in scene.plans()]
    planned = sum(map(len, keys))
    for what, count in {
        "different keys are planned": len(np.unique(np.concatenate(keys), axis=0)),
        "are complete": scene.progress().committed_samples,
        "are shown by a reader that comes afterwards": SceneReader(scene.storage.where, scene.scene_id).refresh().size,
        "were shown by the reader beside it": len(watcher.images),
    }.items():
        if count != planned:
            yield f"{planned} samples are planned, and {count} {what}"


def _data(scene: SceneStore) -> dict[str, bytes]:
    """Every shard of a scene and its base."""
    files = [path for path in scene.folder.rglob("c.*") if path.is_file()]
    return {str(path.relative_to(scene.folder)): path.read_bytes() for path in files}
