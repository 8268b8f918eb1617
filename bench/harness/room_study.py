"""A room rendered, networks trained on it, and their images of views that none was trained on.

Everything lies in one folder and is gone on with where it ended: jobs that are committed, runs that are trained. Both
are dealt out to processes of one thread each.

Shape letters: N views, H W image.
"""

from __future__ import annotations

import argparse
import ctypes
import hashlib
import math
import multiprocessing
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from numpy.typing import NDArray
from torch.nn.functional import avg_pool2d

from bench.harness.results import ROOT
from experiments.experiment import Experiment, list_names
from photonfarm.core.keys import Key
from photonfarm.core.records import F32
from photonfarm.core.statistics import clean_error
from photonfarm.plan.hold_out import rows_held_out, units_of
from photonfarm.plan.request import Request
from photonfarm.plan.top_up import TopUp
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec
from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.read.merge import merge_view
from photonfarm.trainer.compare.evaluation_samples import HeldOutSamples
from photonfarm.trainer.data.feed import Feed, SampleSource
from photonfarm.trainer.metrics import metric_space
from photonfarm.trainer.predict.evaluation import read_batches
from photonfarm.trainer.predict.trained import TrainedRun
from photonfarm.trainer.runs import checkpoint
from photonfarm.trainer.runs.run_folder import CHECKPOINT
from photonfarm.trainer.runs.settings import Architecture, TrainSettings, make_preset
from photonfarm.trainer.runs.user_code import is_own
from photonfarm.trainer.training.loop import train

if TYPE_CHECKING:
    from photonfarm.renderer.jobs.render import ShardRenderer

CODE = ("services/trainer", "shared")  # what a trained network follows from, beside its settings and samples
SHARD_ROWS = 64
HELD_OUT = 1 / 16


def tell(line: str) -> None:
    """A line about what goes on, with the time."""
    print(f"{time.strftime('%H:%M:%S')} {line}", file=sys.stderr, flush=True)


def named_room(name: str) -> SceneSpec:
    """A built-in spec, or the scene of an experiment in its small size; raises SpecError for any other name."""
    return Experiment.load(name, "small").spec() if name in list_names() else load_spec(name)


def render(spec: SceneSpec, store: Store, requests: Sequence[Request | TopUp], processes: int) -> None:
    """Plan what is not planned yet of the requests, and render all that is missing."""
    scene = planned(spec, store, requests, SHARD_ROWS)
    jobs = [(str(store.root), spec.scene_id, job) for job in scene.missing_jobs()]
    in_processes(render_job, jobs, processes, "rendered")


def planned(spec: SceneSpec, store: Store, requests: Sequence[Request | TopUp], shard_rows: int) -> SceneStore:
    """The scene in a store, with all requests planned; a store of an experiment keeps its jobs."""
    scene = store.add(spec)
    for request in requests:
        scene.plan(request, shard_rows=None if scene.plans() else shard_rows)
    return scene


def render_job(root: str, scene_id: str, job: int) -> None:
    """One job of the store in a folder, by the renderer that this process keeps for it."""
    _renderer(root).render(scene_id, job)


@cache
def _renderer(root: str) -> ShardRenderer:
    from photonfarm.renderer.jobs.render import ShardRenderer

    return ShardRenderer(Store(root), worker="bench")


# ---------------------------------------------------------------------------------------------------------- processes


def in_processes(task: Callable[..., Any], items: Sequence[tuple[Any, ...]], processes: int, what: str) -> list[Any]:
    """The task's result for each item, from so many processes at a time, which end with this one; says how far."""
    if not items:
        return []
    context = multiprocessing.get_context("spawn")  # Dr.Jit does not outlive a fork
    with ProcessPoolExecutor(processes, mp_context=context, initializer=_end_with_parent) as pool:
        started = [pool.submit(task, *item) for item in items]
        try:
            for count, done in enumerate(as_completed(started), 1):
                done.result()
                tell(f"{what} {count} of {len(started)}")
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        return [done.result() for done in started]


def _end_with_parent() -> None:
    if sys.platform == "linux":  # an executor's processes wait for ever for one that was killed
        ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG


# ----------------------------------------------------------------------------------------------------------- training


class ChosenSamples(SceneReader):
    """Samples of a store that are chosen once, to be trained on, and one that is held out.

    A trainer wants one to look at. Whoever derives from it sets `chosen`.
    """

    def __init__(self, root: str | Path, scene_id: str, share: float) -> None:
        """Look at what is there now; `share` of all is held out. Raises ValueError where none is."""
        super().__init__(root, scene_id)
        complete = super().refresh().tolist()
        held_out = rows_held_out(self, complete, share)
        self.trainable = [row for row, held in zip(complete, held_out, strict=True) if not held]
        self.chosen: list[int] = []
        self._looked_at = [row for row, held in zip(complete, held_out, strict=True) if held][:1]
        self._has_answered = False
        if not self._looked_at:
            raise ValueError(f"{root}: none of {len(complete)} samples is held out")

    def refresh(self) -> NDArray[np.int64]:
        """The chosen samples at the first call, and the one that is held out; none after it."""
        new = [] if self._has_answered else [*self.chosen, *self._looked_at]
        self._has_answered = True
        return np.array(new, np.int64)

    @property
    def planned(self) -> int:
        """The number of samples that were chosen, and the one that is held out."""
        return len(self.chosen) + 1


def add_options(parser: argparse.ArgumentParser, name: str) -> None:
    """What is equal for all runs of a study, and where it works; `parser.set_defaults` may change the defaults."""
    parser.add_argument(
        "--architecture", choices=get_args(Architecture), default="guided_transport", help="(%(default)s)"
    )
    parser.add_argument("--processes", type=int, default=2, help="that render or train at a time (%(default)s)")
    parser.add_argument("--steps", type=int, default=1500, help="of each run (%(default)s)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1], help="of the networks (%(default)s)")
    parser.add_argument("--plan-seed", type=int, default=1, help="of configurations and views (%(default)s)")
    parser.add_argument("--reference-spp", type=int, default=256, help="of the held-out views (%(default)s)")
    parser.add_argument(
        "--work", type=Path, default=ROOT / "build" / name, help=f"where what is made stays (build/{name})"
    )


def opened(options: argparse.Namespace, size: str) -> tuple[Path, Store]:
    """The folder of a study of this size and plan seed, and its store; looks at `code` before time goes by."""
    tell(f"code {code()}")
    folder = options.work / f"{size}-plan-{options.plan_seed}"
    folder.mkdir(parents=True, exist_ok=True)
    return folder, Store(folder / "store", create=True)


def settings_of(options: argparse.Namespace, seed: int, hold_out: float = HELD_OUT) -> TrainSettings:
    """The preset `small` from a seed, judged after its last step alone."""
    return make_preset(
        "small", network={"architecture": options.architecture}, seed=seed, max_steps=options.steps, hold_out=hold_out,
        recover=False, validate_every=options.steps, validation_samples=1, minimum_samples=1, checkpoint_every=1000,
    )  # fmt: skip


def described(settings: TrainSettings) -> str:
    """Settings of `settings_of` in words, for a page."""
    return (
        f"`{settings.network.architecture}` by the preset `small`, {settings.max_steps} steps of {settings.batch} "
        f"samples; loss `{settings.loss}`"
    )


@cache
def code() -> str:
    """Names the code that trains: the trees of `CODE` in git's HEAD, and a digest of what is changed there since.

    Raises CalledProcessError outside a git checkout.
    """

    def git(*arguments: str) -> bytes:
        return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, check=True).stdout

    trees = git("rev-parse", *(f"HEAD:{folder}" for folder in CODE)).decode().split()
    new = git("ls-files", "-z", "--others", "--exclude-standard", "--", *CODE).decode().split("\0")[:-1]
    changed = git("diff", "--no-ext-diff", "--binary", "HEAD", "--", *CODE)
    for file in new:
        changed += file.encode() + (ROOT / file).read_bytes()
    mark = [f"changed {hashlib.sha256(changed).hexdigest()[:8]}"] if changed else []
    return " ".join([*(tree[:12] for tree in trees), *mark])


def code_of(settings: TrainSettings) -> str:
    """`code`, and a digest of each module that holds a network or loss of a user's own."""
    own = [name for name in (settings.network.architecture, settings.loss) if is_own(name)]
    files = [Path(str(import_module(name.partition(":")[0]).__file__)) for name in own]
    return " ".join([code(), *(hashlib.sha256(file.read_bytes()).hexdigest()[:8] for file in files)])


@dataclass(frozen=True, slots=True)
class Run:
    """A network to be trained, in a folder named by `name`, all settings and `code_of` these."""

    source: Callable[[], SampleSource]  # another process can be given it
    settings: TrainSettings
    within: Path
    name: str

    @property
    def folder(self) -> Path:
        """The folder that it is trained in."""
        digest = hashlib.sha256(f"{self.settings.model_dump_json()} {code_of(self.settings)}".encode()).hexdigest()[:8]
        return self.within / f"{self.name}-{self.settings.seed}-{digest}"

    def is_at_its_end(self) -> bool:
        """Whether all its steps are done."""
        last = self.folder / CHECKPOINT
        return last.is_file() and checkpoint.load(last)["step"] >= self.settings.max_steps

    def trained(self) -> TrainedRun:
        """What was trained."""
        return TrainedRun.load(self.folder)

    def seconds(self) -> float:
        """Wall time of its steps."""
        return float(checkpoint.load(self.folder / CHECKPOINT)["seconds"]["train"])


def train_all(runs: Sequence[Run], processes: int) -> None:
    """Train each run to its end; one that was cut goes on from its last checkpoint.

    Folders are named here: what another process found as `code` might be newer.
    """
    left = [(run.source, run.settings, run.folder) for run in runs if not run.is_at_its_end()]
    in_processes(_train, left, processes, "trained")


def _train(source: Callable[[], SampleSource], settings: TrainSettings, folder: Path) -> None:
    train(source(), settings, folder)


# --------------------------------------------------------------------------------------------------------- evaluation


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceViews:
    """Views of held-out configurations with all their passes merged, in two halves that are independent."""

    rows: tuple[int, ...]  # the first sample of each view
    units: tuple[Key, ...]  # its configuration or, of a static scene, the view itself
    halves: F32  # (N, 2, H, W, 3) linear radiance × exposure
    spp: int  # of both halves together, of the view that has fewest

    @classmethod
    def of(cls, store: Store, spec: SceneSpec, spp: int, share: float = HELD_OUT) -> ReferenceViews:
        """Those of held-out configurations that have `spp` at least; `share` of all are held out."""
        reader, source = SceneReader(store.root, spec.scene_id), SceneReader(store.root, spec.scene_id)
        reader.refresh()
        first = {reader.view_row(row): row for row in reversed(HeldOutSamples.of(source, share, sys.maxsize).rows)}
        passes = {view: len(reader.rows_of_view(view)) for view in sorted(first)}
        enough = [view for view, count in passes.items() if 2 * spec.transport.half_spp * count >= spp]
        merged = {first[view]: merge_view(reader, view) for view in enough}
        halves = np.stack([np.stack([view.half_a, view.half_b]) for view in merged.values()])
        exposed = (spec.exposure * halves).astype(np.float32)
        fewest = 2 * spec.transport.half_spp * min(view.passes for view in merged.values())
        return cls(tuple(merged), tuple(units_of(source, list(merged))), exposed, fewest)

    @property
    def mean(self) -> F32:
        """(N, H, W, 3)."""
        images: F32 = self.halves.mean(axis=1)
        return images

    def linear_errors(self, made: F32) -> NDArray[np.float64]:
        """Squared errors in exposed linear radiance of images (N, H, W, 3), of each view (N,), noise taken out."""
        return np.array([clean_error(image, a, b) for image, (a, b) in zip(made, self.halves, strict=True)])

    def shown_errors(self, made: F32, block: int = 1) -> NDArray[np.float64]:
        """Squared errors in the metric space, likewise: mean (f − A)(f − B) of what a display shows of all three.

        With `block`, of the means of so many by so many pixels, in which fine texture and edges play no part.

        The noise of A and that of B multiply to nothing. What stays is the shift δ that the display's curve makes of
        their noise on average, E A = E B = I + δ, of second order in the noise: the expectation is mean (f − I)²
        − 2 δ (f − I) + δ². Its cross term is of f, and so differs between networks.
        """
        images = (metric_space(image).double() for image in (made, self.halves[:, 0], self.halves[:, 1]))
        shown, a, b = (avg_pool2d(image.movedim(-1, 1), block) for image in images)
        errors: NDArray[np.float64] = ((shown - a) * (shown - b)).mean(dim=(1, 2, 3)).numpy()
        return errors

    def noise(self, spp: int) -> float:
        """Standard deviation of a pixel with so many samples, root mean square over all, exposed linear radiance."""
        variance = float(np.mean((self.halves[:, 0] - self.halves[:, 1]) ** 2) / 4)  # of the mean of both
        return math.sqrt(variance * self.spp / spp)


def images(run: TrainedRun, source: SampleSource, rows: Sequence[int]) -> F32:
    """A run's images of complete rows, (N, H, W, 3) linear radiance × exposure."""
    with Feed(source, run.settings, needs=run.needs) as feed:
        predict = run.predictor(feed.spec, (feed.geometry, feed.cloud), "cpu")
        return np.concatenate([predict(batch).copy() for batch in read_batches(feed, rows, run.settings.batch)])


def counted(count: int, what: str) -> str:
    """A number of things, in words."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def document(settings: TrainSettings, options: argparse.Namespace, references: ReferenceViews) -> dict[str, Any]:
    """What a study's JSON says beside its figures."""
    return {
        "settings": settings.model_dump(mode="json"),
        "code": code(),
        "seeds": options.seeds,
        "plan_seed": options.plan_seed,
        "reference_spp": references.spp,
        "reference_noise": references.noise(references.spp),
        "units": [unit.hex() for unit in references.units],
    }
