"""`room` rendered, networks trained on it, and their images of views that none was trained on.

Everything lies in one folder and is gone on with where it ended: jobs that are committed, runs that are trained.

Shape letters: N views, H W image.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import avg_pool2d

from photonfarm.shared.estimate import Estimate, clean_error, group_means
from photonfarm.shared.keys import Key
from photonfarm.shared.plan import Request
from photonfarm.shared.records import F32
from photonfarm.shared.scene import SceneSpec, load_spec
from photonfarm.shared.store import Store
from photonfarm.shared.store.merge import merge_view
from photonfarm.shared.store.reader import SceneReader
from photonfarm.shared.top_up import TopUp
from photonfarm.trainer import checkpoint
from photonfarm.trainer.animation import enlarged
from photonfarm.trainer.dataset import SampleSource
from photonfarm.trainer.evaluation import batches
from photonfarm.trainer.evaluation_samples import Samples
from photonfarm.trainer.feed import Feed
from photonfarm.trainer.loop import CHECKPOINT, train
from photonfarm.trainer.metrics import metric_space
from photonfarm.trainer.metrics.intervals import t_975
from photonfarm.trainer.settings import Loss, TrainSettings, preset
from photonfarm.trainer.store_source import StoreSource
from photonfarm.trainer.trained import TrainedRun

if TYPE_CHECKING:
    from PIL import Image

ROOT = Path(__file__).parents[1]
EXPERIMENTS = ROOT / "experiments"
CODE = ("services/trainer", "shared")  # what a trained network follows from, beside its settings and samples
SHARD_ROWS = 64
HELD_OUT = 1 / 16


def tell(line: str) -> None:
    """A line about what goes on, with the time."""
    print(f"{time.strftime('%H:%M:%S')} {line}", file=sys.stderr, flush=True)


def find_experiments() -> None:
    """Make the modules of experiments/ importable."""
    if str(EXPERIMENTS) not in sys.path:
        sys.path.insert(0, str(EXPERIMENTS))


def named_room(name: str) -> SceneSpec:
    """A built-in spec, or the scene of an experiment in its small size; raises SpecError for any other name."""
    find_experiments()
    from experiment import Experiment, names

    return Experiment.load(name, "small").spec() if name in names() else load_spec(name)


def in_passes(spec: SceneSpec, half_spp: int) -> SceneSpec:
    """The scene with so many samples per pixel in a half-estimate."""
    return spec.model_copy(update={"transport": spec.transport.model_copy(update={"half_spp": half_spp})})


def render(spec: SceneSpec, store: Store, requests: Sequence[Request | TopUp]) -> None:
    """Plan what is not planned yet of the requests, and render all that is missing, in this process."""
    from photonfarm.renderer.jobs import ShardRenderer

    scene = store.add(spec)
    for request in requests:
        scene.plan(request, shard_rows=SHARD_ROWS)
    renderer = ShardRenderer(store, worker="bench")
    for job in (missing := scene.missing_jobs()):
        renderer.render(spec.scene_id, job)
        tell(f"rendered job {job} of {missing[-1]}")


# ----------------------------------------------------------------------------------------------------------- training


def add_options(parser: argparse.ArgumentParser, name: str) -> None:
    """What is equal for all runs of a study, and where it works; `parser.set_defaults` may change the defaults."""
    parser.add_argument("--steps", type=int, default=1500, help="of each run (%(default)s)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1], help="of the networks (%(default)s)")
    parser.add_argument("--plan-seed", type=int, default=1, help="of configurations and views (%(default)s)")
    parser.add_argument("--reference-spp", type=int, default=256, help="of the held-out views (%(default)s)")
    parser.add_argument("--batch", type=int, default=2, help="samples a step (%(default)s)")
    parser.add_argument("--rate", type=float, default=5e-4, help="learning rate (%(default)s)")
    parser.add_argument("--decay", type=float, default=0.93, help="of the rate, per 256 samples (%(default)s)")
    parser.add_argument("--loss", choices=get_args(Loss), default="relative", help="(%(default)s)")
    parser.add_argument(
        "--demodulation", type=float, default=0.0, help="ε; outputs × (albedo + ε) are the images; 0: off (%(default)s)"
    )
    parser.add_argument(
        "--precision", choices=("float32", "bfloat16"), default="float32", help="of the U-Net (%(default)s)"
    )
    parser.add_argument(
        "--work", type=Path, default=ROOT / "build" / name, help=f"where what is made stays (build/{name})"
    )


def opened(told: argparse.Namespace, size: str) -> tuple[Path, Store]:
    """The folder of a study of this size and plan seed, and its store; looks at `code` before time goes by."""
    tell(f"code {code()}")
    folder = told.work / f"{size}-plan-{told.plan_seed}"
    folder.mkdir(parents=True, exist_ok=True)
    return folder, Store(folder / "store", create=True)


def settings_of(architecture: str, seed: int, told: argparse.Namespace, hold_out: float = HELD_OUT) -> TrainSettings:
    """Equal in all but the architecture and the seed."""
    network = {
        "architecture": architecture, "precision": told.precision, "demodulation": told.demodulation or None,
        "occlusion": "exact",
    }  # fmt: skip
    return preset(
        "small", network=network, seed=seed, loss=told.loss, batch=told.batch, learning_rate=told.rate,
        decay=told.decay, max_steps=told.steps, hold_out=hold_out, validate_every=told.steps, validation_samples=1,
        minimum_samples=1, checkpoint_every=1000,
    )  # fmt: skip


def described(settings: TrainSettings) -> str:
    """Settings of `settings_of` in words, for a page."""
    network = settings.network
    demodulated = "not demodulated" if network.demodulation is None else f"× (albedo + {network.demodulation:g})"
    return (
        f"{settings.optimiser}, rate {settings.learning_rate:g}, times {settings.decay:g} every "
        f"{settings.epoch_samples} samples; loss `{settings.loss}`; outputs {demodulated}; U-Net in "
        f"{network.precision}; maxima `{network.maxima}`; occlusion `{network.occlusion}`"
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


def trained(
    source: Callable[[], SampleSource], settings: TrainSettings, folder: Path, name: str = ""
) -> tuple[TrainedRun, float]:
    """A run trained to its end, in a folder named by `name`, all its settings and `code`; and its steps' seconds.

    One that was cut goes on from its last checkpoint, and one at its end is as it is.
    """
    digest = hashlib.sha256(f"{settings.model_dump_json()} {code()}".encode()).hexdigest()[:8]
    run = folder / f"{name or settings.network.architecture}-{settings.seed}-{digest}"
    last = run / CHECKPOINT
    if not last.is_file() or checkpoint.load(last)["step"] < settings.max_steps:
        train(source(), settings, run)
    return TrainedRun.load(run), float(checkpoint.load(last)["seconds"]["train"])


# --------------------------------------------------------------------------------------------------------- evaluation


@dataclass(frozen=True, slots=True, eq=False)
class References:
    """Views of held-out configurations with all their passes merged, in two halves that are independent."""

    rows: tuple[int, ...]  # the first sample of each view
    units: tuple[Key, ...]  # its configuration
    halves: F32  # (N, 2, H, W, 3) linear radiance × exposure
    spp: int  # of both halves together, of the view that has fewest

    @classmethod
    def of(cls, store: Store, spec: SceneSpec, spp: int, share: float = HELD_OUT) -> References:
        """Those of held-out configurations that have `spp` at least; `share` of all are held out."""
        reader, source = SceneReader(store.root, spec.scene_id), StoreSource(store.root, spec.scene_id)
        reader.refresh()
        first = {reader.view_row(row): row for row in reversed(Samples.of(source, share, sys.maxsize).rows)}
        passes = {view: len(reader.rows_of_view(view)) for view in sorted(first)}
        enough = [view for view, count in passes.items() if 2 * spec.transport.half_spp * count >= spp]
        merged = {first[view]: merge_view(reader, view) for view in enough}
        halves = np.stack([np.stack([view.half_a, view.half_b]) for view in merged.values()])
        exposed = (spec.exposure * halves).astype(np.float32)
        fewest = 2 * spec.transport.half_spp * min(view.passes for view in merged.values())
        return cls(tuple(merged), tuple(source.modification_keys(list(merged))), exposed, fewest)

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
        return np.concatenate([predict(batch).copy() for batch in batches(feed, rows, run.settings.batch)])


def photon_maps(run: TrainedRun, source: SampleSource, rows: Sequence[int]) -> F32:
    """What a run's network adds its output to, of complete rows, likewise: nothing in it is learned."""
    with Feed(source, run.settings, needs=run.needs) as feed, torch.no_grad():
        network, made = run.network(feed.spec, (feed.geometry, feed.cloud)), []
        for batch in batches(feed, rows, run.settings.batch):
            known = torch.as_tensor(network.known(batch.inputs, network.further(batch.inputs)))
            made.append(known.expand_as(batch.inputs.albedo).numpy())
        return np.concatenate(made)


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """Errors of images that networks of one kind made, one from each seed, and what is concluded from them; S seeds."""

    values: NDArray[np.float64]  # (S, N)
    units: tuple[Key, ...]  # what each view's configuration is: views of one are not independent

    def less(self, other: Errors) -> Errors:
        """Differences from the same seeds on the same views."""
        return Errors(self.values - other.values, self.units)

    def of_views(self) -> NDArray[np.float64]:
        """Means over seeds, (N,)."""
        means: NDArray[np.float64] = self.values.mean(axis=0)
        return means

    def of_seeds(self) -> NDArray[np.float64]:
        """Means over configurations, (S,)."""
        return np.array([group_means(values, self.units).mean() for values in self.values])

    def estimate(self) -> Estimate:
        """Mean and standard error, se² = se²(configurations) + var(seeds) / S.

        The first is of means over seeds. From one seed there is no second: it is of this network then.
        """
        over_units, over_seeds = self._parts()
        if over_units.standard_error is None or over_seeds.standard_error is None:
            return over_units
        error = math.hypot(over_units.standard_error, over_seeds.standard_error)
        return Estimate(over_units.mean, error, over_units.count)

    def interval(self) -> tuple[float, float]:
        """The 95 % interval of the mean; raises ValueError where one configuration is all there is.

        By Student's t with Satterthwaite's degrees of freedom, se⁴ / Σ seᵢ⁴ / νᵢ [Satterthwaite 1946], rounded down:
        where the seeds' variance leads, little is known of it.
        """
        found = self.estimate()
        if found.standard_error is None:
            raise ValueError("an interval needs two configurations at least")
        known = [(part.standard_error, part.count - 1) for part in self._parts() if part.standard_error]
        apart = sum(error**4 / freedom for error, freedom in known)
        reach = t_975(int(found.standard_error**4 / apart + 1e-9)) * found.standard_error if apart else 0.0
        return found.mean - reach, found.mean + reach

    def _parts(self) -> tuple[Estimate, Estimate]:
        """Over configurations, and over seeds."""
        return Estimate.of(group_means(self.of_views(), self.units)), Estimate.of(self.of_seeds())


def stated(errors: Errors, digits: int = 5) -> str:
    """Mean and 95 % interval."""
    low, high = errors.interval()
    return f"{errors.estimate().mean:.{digits}f} ({low:.{digits}f} … {high:.{digits}f})"


def each_seed(errors: Errors, form: str = ".5f") -> str:
    """The mean of each seed."""
    return " · ".join(f"{mean:{form}}" for mean in errors.of_seeds())


def counted(count: int, what: str) -> str:
    """A number of things, in words."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def of_intervals(seeds: int) -> str:
    """What a page says of its intervals."""
    if seeds == 1:
        return "Intervals are over configurations, for these networks: those of another seed may lie outside."
    return (
        f"Intervals are for networks of any seed: se² = se²(configurations) + var(seeds) / {seeds}, the first after "
        "the mean over seeds; Student's t with Satterthwaite's degrees of freedom."
    )


def document(settings: TrainSettings, told: argparse.Namespace, references: References) -> dict[str, Any]:
    """What a study's JSON says beside its figures."""
    return {
        "settings": settings.model_dump(mode="json"),
        "code": code(),
        "seeds": told.seeds,
        "plan_seed": told.plan_seed,
        "reference_spp": references.spp,
        "reference_noise": references.noise(references.spp),
        "units": [unit.hex() for unit in references.units],
    }


# ----------------------------------------------------------------------------------------------------------- pictures

GAP = 4
LINE = 16  # height of a caption

Column = tuple[str, F32, NDArray[np.float64] | None]
"""A caption, images (N, H, W, 3) linear radiance × exposure, and a number for each or none."""


def mosaic(columns: Sequence[Column]) -> Image.Image:
    """Images side by side, N lines of them, the column's caption above and each image's number below it."""
    from PIL import Image, ImageDraw

    count = len(columns[0][1])
    height, width = enlarged(columns[0][1][0]).shape[:2]
    across, down = width + GAP, height + LINE
    whole = Image.new("RGB", (GAP + across * len(columns), LINE + GAP + down * count), "white")
    draw = ImageDraw.Draw(whole)
    for place, (caption, images, numbers) in enumerate(columns):
        x = GAP + across * place
        draw.text((x, 2), caption, fill="black")
        for line, image in enumerate(images):
            y = LINE + GAP + down * line
            whole.paste(Image.fromarray(enlarged(image)), (x, y))
            if numbers is not None:
                draw.text((x, y + height + 1), f"{numbers[line]:.4f}", fill="black")
    return whole
