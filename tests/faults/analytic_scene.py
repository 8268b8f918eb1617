"""A scene that is rendered by formulas in microseconds, behind the interface that jobs use; run as a script, a
worker's child that renders it. Arguments: seconds that each half takes, and a purpose ("broken": never finite,
"no backend": does not load).
"""

import contextlib
import json
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import BackendError
from photonfarm.core.records import F32, BasePointCloud, Geometry, Guides, Photons, ViewBuffers
from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.scene.modification import Modification, rest
from photonfarm.scene.spec import GuideSpec, SceneSpec
from photonfarm.scene.spec_loading import parse_spec
from photonfarm.scene.view import View
from photonfarm.store import SceneStore, Store
from photonfarm.store.format.schema import output_arrays
from photonfarm.store.format.shards import NOISY_GUIDES

FOLDER = Path(__file__).parent  # on sys.path, it makes this module known to a process of its own


def small_spec(**changes: Any) -> SceneSpec:
    """A dynamic scene of one object at 8 × 8 pixels."""
    unit = {"min": [0, 0, 0], "max": [1, 1, 1]}
    movable = {"name": "object", "shapes": ["tall-block"], "at": [0, 0, 0], "box": unit, "removal_probability": 0}
    described = {
        "name": "analytic",
        "scene": {"builtin": "cornell"},
        "objects": [movable],
        "points": 16,
        "view": {"origin": unit, "look_at": unit},
        "film": {"width": 8, "height": 8},
        "photons": {"paths": 4, "depth": 2},
    }
    return parse_spec({**described, **changes}, where="test")


class AnalyticScene:
    """Radiance, buffers and photons that depend on the configuration, the view and the seed, and on nothing else."""

    samples_at_once: ClassVar[int] = 1
    pause_s: ClassVar[float] = 0.0
    broken: ClassVar[bool] = False

    def __init__(self, spec: SceneSpec) -> None:
        self.spec = spec
        self.modification = rest(spec)
        self.renders = 0

    @classmethod
    def load(cls, spec: SceneSpec) -> "AnalyticScene":
        return cls(spec)

    def apply(self, modification: Modification) -> None:
        self.modification = modification

    def _level(self, view: View) -> float:
        return float(np.abs(self.modification.vector).sum() + np.abs(view.vector).sum())

    def render_halves(self, view: View, seeds: Sequence[int]) -> F32:
        return np.stack([self.render_half(view, seed) for seed in seeds])

    def render_images(self, views: Sequence[View], seeds: Sequence[int]) -> F32:
        return np.stack([self.render_half(view, seed) for view, seed in zip(views, seeds, strict=True)])

    def render_half(self, view: View, seed: int) -> F32:
        time.sleep(self.pause_s)
        self.renders += 1
        size = (self.spec.film.height, self.spec.film.width, 3)
        noise = np.random.default_rng(seed).gamma(1.0, 1.0, size)
        return np.full(size, np.nan, np.float32) if self.broken else (self._level(view) * noise).astype(np.float32)

    def buffers(self, view: View) -> ViewBuffers:
        size = (self.spec.film.height, self.spec.film.width)
        depth = np.full(size, self._level(view), np.float32)
        return ViewBuffers(depth, np.full((*size, 3), 0.5, np.float32), np.full((*size, 3), 0.6, np.float32))

    def inputs(
        self, views: Sequence[View], keys: Sequence[bytes], wanted: GuideSpec, lit: tuple[F32, F32]
    ) -> list[tuple[ViewBuffers, Guides]]:
        return [
            (self.buffers(view), self.guides(view, key, wanted, lit)) for view, key in zip(views, keys, strict=True)
        ]

    def guides(self, view: View, key: bytes, wanted: GuideSpec, lit: tuple[F32, F32]) -> Guides:
        """All that `schema` has, of the view's level; what is noisy follows from the key."""
        arrays = output_arrays(self.spec)
        shapes = {field.name: arrays[field.name].shape for field in fields(Guides)}
        found = {name: np.full(shape, self._level(view), np.float32) for name, shape in shapes.items()}
        found["point_light"] += np.abs(lit[0])
        for number, name in enumerate(NOISY_GUIDES):
            noise = np.random.default_rng([number, *key]).gamma(1.0, 1.0, shapes[name])
            found[name] *= noise.astype(np.float32) if wanted.light_samples else 0
        return Guides(**found)

    def sees(self, views: Sequence[View], position: F32) -> NDArray[np.bool_]:
        levels = np.array([[self._level(view)] for view in views])
        return np.asarray(np.floor(position @ np.array([7.1, 13.7, 29.3]) + levels) % 2 == 0)

    def photons(self, seed: int) -> Photons | None:
        count = self.spec.photons.slots
        if not count:
            return None
        values = np.random.default_rng(seed).random((4, count, 3), dtype=np.float32)
        values[0] += np.float32(np.abs(self.modification.vector).sum())
        return Photons(*values, bounce=np.zeros(count, np.int8))

    def base(self) -> tuple[Geometry, BasePointCloud]:
        corners = np.eye(3, dtype=np.float32)
        geometry = Geometry(corners, np.array([[0, 1, 2]], np.uint32), np.zeros(1, np.int32), np.array([-1], np.int16))
        points = np.tile(corners, (self.spec.points, 1))[: self.spec.points]
        index = np.zeros(self.spec.points)
        return geometry, BasePointCloud(points, points, points, points, index.astype(np.int16), index.astype(np.uint32))


def render_missing(store: Store, scene_id: str, load: Callable[[SceneSpec], Any] = AnalyticScene) -> SceneStore:
    """Render and commit every missing job of a scene in this process, by the formulas of `load`."""
    renderer, scene = ShardRenderer(store, worker="test", load=load), store.scene(scene_id)
    for job in scene.missing_jobs():
        renderer.render(scene_id, job)
    return scene


def command(pause_s: float = 0.0, purpose: str = "") -> tuple[str, ...]:
    """The child's command for `run_worker`."""
    return (sys.executable, str(Path(__file__)), str(pause_s), purpose)


def start_worker(
    store: Path, url: str, child: tuple[str, ...], log: Path | None = None, **settings: Any
) -> subprocess.Popen[bytes]:
    """A supervisor in a process of its own; its exit code is that of the command line. It talks to `log` or a pipe."""
    code = """
import json, sys
from photonfarm.renderer.worker.worker import run_worker
from photonfarm.core.errors import PhotonfarmError
store, url, child, settings = json.loads(sys.argv[1])
try:
    run_worker(store, url, child=child, **settings)
except PhotonfarmError as error:
    sys.exit(error.exit_code)
"""
    settings = {"heartbeat_ttl_s": 2.0, "idle_s": 1, "reserve_bytes": 0, **settings}
    arguments = json.dumps([str(store), url, child, settings])
    with log.open("ab") if log else contextlib.nullcontext(subprocess.PIPE) as stderr:
        return subprocess.Popen([sys.executable, "-c", code, arguments], stderr=stderr)


def child_of(supervisor: subprocess.Popen[bytes]) -> int | None:
    """The process that a supervisor supervises now."""
    children = Path(f"/proc/{supervisor.pid}/task/{supervisor.pid}/children")
    found = children.read_text().split() if children.exists() else []
    return int(found[0]) if found else None


def wait_for(condition: Callable[[], object], timeout_s: float = 30.0) -> None:
    """Return as soon as the condition holds; fail if it does not come to hold."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.02)


def refuse_to_load(spec: SceneSpec) -> AnalyticScene:
    raise BackendError("no libLLVM was found; install LLVM 19")


def main() -> int:
    from photonfarm.renderer.worker import child as worker_child

    pause_s, purpose = sys.argv[1:]
    AnalyticScene.pause_s = float(pause_s)
    AnalyticScene.broken = purpose == "broken"
    return worker_child.child(refuse_to_load if purpose == "no backend" else AnalyticScene.load)


if __name__ == "__main__":
    sys.exit(main())
