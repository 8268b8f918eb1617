"""What precision, memory layout and compilation do to the time of a step, and precision to what is learned.

    python -m bench.trainer.arithmetic [--seeds 6] [--steps 400] [--turns 9] [--out DIR]

Times: whole steps on made-up samples, all ways by turns, as ratios within a turn. Bias: networks of the preset `small`
on `room` at 64², rendered here. Gradients of every precision on the same batches at the same weights, and networks
trained on the same batches from the same weights. TF32 is only of cards; here it is convolutions whose factors are
rounded to it (`rounded_convolutions`). Exit code 0.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bench.harness import results
from bench.harness.contents import Contents, commit
from bench.harness.scenes import square
from bench.trainer.rounded_convolutions import round_factors
from photonfarm.core.records import F32
from photonfarm.core.statistics import Estimate, clean_error
from photonfarm.plan.request import Request
from photonfarm.scene.spec_loading import load_spec
from photonfarm.store import SceneReader, Store
from photonfarm.trainer.data.batch import ResidentSamples, TrainingBatch
from photonfarm.trainer.data.batch_stream import RoundSampler
from photonfarm.trainer.data.feed import Feed
from photonfarm.trainer.dry_run.made_up import MadeUpScene
from photonfarm.trainer.metrics.image_metrics import confidence_interval
from photonfarm.trainer.networks import predict_image
from photonfarm.trainer.networks.network import Network
from photonfarm.trainer.runs.settings import Precision, TrainSettings, make_preset
from photonfarm.trainer.training.learner import Learner

AS_IT_IS = "float32, activations channels-last"
OTHERS: tuple[Precision, ...] = ("tf32", "bfloat16")
SAMPLES = 96

# --------------------------------------------------------------------------------------------------------------- times


@dataclass(frozen=True, slots=True)
class Times:
    """Steps of one size."""

    preset: str
    size: int
    batch: int
    ms: dict[str, float]  # processor milliseconds of a step, the median
    ratio: dict[str, tuple[float, float, float]]  # to AS_IT_IS in the same turn: median, least, most
    first_s: dict[str, float]  # of the first step, with what is compiled for it; wall time


def ways(scene: MadeUpScene, settings: TrainSettings) -> dict[str, Learner]:
    """Learners that take the same steps in other ways."""
    short = {"network": settings.network.model_copy(update={"precision": "bfloat16"})}
    made = {
        AS_IT_IS: Learner(scene, settings),
        "float32, activations channels-first": Learner(scene, settings),
        "float32, weights channels-last too": Learner(scene, settings),
        "float32, compiled": Learner(scene, settings.model_copy(update={"compile": "on"})),
        "bfloat16, activations channels-last": Learner(scene, settings.model_copy(update=short)),
        "bfloat16, compiled": Learner(scene, settings.model_copy(update={**short, "compile": "on"})),
    }
    first = made["float32, activations channels-first"].network

    def channels_first(channels: Tensor) -> Tensor:
        return first.image_synthesis(channels.permute(0, 3, 1, 2).contiguous()).permute(0, 2, 3, 1)

    first.synthesise = channels_first  # type: ignore[method-assign]
    made["float32, weights channels-last too"].network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return made


def times(name: str, size: int, settings: TrainSettings, turns: int) -> Times:
    """All ways, by turns."""
    scene = MadeUpScene.of(square(load_spec("room"), size))
    batch, learners = scene.batch(settings.batch, settings), ways(scene, settings)

    def seconds(learner: Learner, now: Callable[[], float]) -> float:
        began = now()
        learner.step(1, batch)
        return now() - began

    first = {way: seconds(learner, time.perf_counter) for way, learner in learners.items()}
    for learner in learners.values():
        learner.step(1, batch)
    taken = [{way: seconds(one, time.process_time) for way, one in learners.items()} for _ in range(turns)]
    ratios = {way: sorted(turn[way] / turn[AS_IT_IS] for turn in taken) for way in learners}
    return Times(
        name, size, settings.batch,
        {way: 1e3 * statistics.median(turn[way] for turn in taken) for way in learners},
        {way: (statistics.median(found), found[0], found[-1]) for way, found in ratios.items()},
        first,
    )  # fmt: skip


# ---------------------------------------------------------------------------------------------------------------- bias


@dataclass(frozen=True, slots=True)
class GradientDifference:
    """Gradients at the same weights on the same batches, less those of float32; shares of the mean gradient's length.

    The mean over N batches of differences that are noise of mean zero is shorter than one, by √N.
    """

    one: float  # root mean square over batches
    mean: float  # of the mean over all batches
    noise: float  # of float32's mean gradient, its standard error by the noise of samples

    @classmethod
    def of(
        cls, learners: Mapping[Precision, Learner], feed: Feed, rows: Sequence[int]
    ) -> dict[Precision, GradientDifference]:
        """The difference of each precision but float32."""
        size, exact = 2, learners["float32"]
        sums = {name: torch.zeros(0) for name in learners}
        squares = dict.fromkeys(learners, 0.0)
        groups = [rows[i : i + size] for i in range(0, len(rows), size)]
        for group in groups:
            feed.ask(group)
            batch = feed.take()
            wanted = gradient(exact, batch)
            for name, learner in learners.items():
                found = wanted if learner is exact else gradient(learner, batch) - wanted
                sums[name] = found + sums[name] if len(sums[name]) else found
                squares[name] += float(found.square().sum())
        count = len(groups)
        length = float(sums["float32"].norm()) / count
        noise = max(squares["float32"] / count - length**2, 0.0) / (count - 1)
        return {
            name: cls(
                (squares[name] / count) ** 0.5 / length, float(sums[name].norm()) / count / length, noise**0.5 / length
            )
            for name in OTHERS
        }


def gradient(learner: Learner, batch: TrainingBatch) -> Tensor:
    """The gradient of the loss on a batch, all weights as one, float64."""
    learner.optimiser.zero_grad()
    loss = learner._loss(predict_image(learner.network, batch.inputs), batch.target)
    torch.autograd.backward(loss)
    return torch.cat(
        [weight.grad.double().flatten() for weight in learner.network.parameters() if weight.grad is not None]
    )


@dataclass(frozen=True, slots=True, eq=False)
class Trained:
    """What networks of one seed learned, by precision."""

    brightness: dict[Precision, float]  # mean prediction on views that were held out, linear radiance × exposure
    error: dict[Precision, float]  # squared, the noise taken out
    apart: dict[Precision, float]  # root mean square difference to float32's images, over their mean brightness
    gradients: dict[str, dict[Precision, GradientDifference]]  # at the first and at the last weights


def learner_of(feed: Feed, settings: TrainSettings, precision: Precision) -> Learner:
    """A learner whose convolutions have a precision."""
    own = "bfloat16" if precision == "bfloat16" else "float32"
    network = settings.network.model_copy(update={"precision": own})
    learner = Learner(feed, settings.model_copy(update={"network": network}))
    if precision == "tf32":
        for each in {id(net): net for net in (learner.network, learner.predicting)}.values():
            round_factors(each)
    return learner


def trained(feed: Feed, settings: TrainSettings, rows: Sequence[int], held_out: Sequence[int]) -> Trained:
    """Networks of one seed, trained on the same batches, and what they show of the held-out views."""
    precisions: tuple[Precision, ...] = ("float32", *OTHERS)
    learners = {name: learner_of(feed, settings, name) for name in precisions}
    gradients = {"first": GradientDifference.of(learners, feed, rows)}
    for learner in learners.values():
        sampler = RoundSampler(settings.seed, 0)
        sampler.add(rows)
        for number in range(settings.max_steps):
            feed.ask(sampler.draw(settings.batch))
            learner.step(number, feed.take())
    images, errors = {}, {}
    for name, learner in learners.items():
        images[name], errors[name] = shown(learner.predicting.eval(), feed, held_out)
    exact, last = images["float32"], learners["float32"].network.state_dict()
    for learner in learners.values():
        learner.network.load_state_dict(last)
    gradients["last"] = GradientDifference.of(learners, feed, rows)
    brightness = {name: float(found.mean()) for name, found in images.items()}
    apart = {name: float(np.sqrt(np.mean((images[name] - exact) ** 2))) / brightness["float32"] for name in OTHERS}
    return Trained(brightness, errors, apart, gradients)


@torch.no_grad()
def shown(network: Network, feed: Feed, rows: Sequence[int]) -> tuple[F32, float]:
    """Images of rows (N, H, W, 3), and their mean squared error with the noise taken out."""
    images, errors = [], []
    for row in rows:
        feed.ask([row])
        batch = feed.take()
        (image,) = predict_image(network, batch.inputs).numpy()
        half_a, half_b = batch.target[0].numpy()
        images.append(image)
        errors.append(clean_error(image, half_a, half_b))
    return np.stack(images), float(np.mean(errors))


def bias(seeds: int, steps: int) -> list[Trained]:
    """Every seed, on one store of `room`."""
    with tempfile.TemporaryDirectory() as folder:
        spec = square(load_spec("room"), 64)
        scene = Store(Path(folder), create=True).add(spec)
        contents = Contents(spec)
        scene.write_base(*contents.base)
        scene.plan(Request(modifications=SAMPLES // 2, views_per_modification=2), shard_rows=32)
        for job in range(scene.jobs()):
            commit(scene, job, contents)
        found = []
        for seed in range(seeds):
            settings = make_preset("small", seed=seed, max_steps=steps, hold_out=0.25, device="cpu")
            resident = ResidentSamples(torch.device("cpu"), 1.0)
            with Feed(SceneReader(folder, scene.scene_id), settings, resident=resident) as feed:
                arrived = feed.arrivals()[0]
                rows, held_out = ([row for row, held in arrived if held is side] for side in (False, True))
                found.append(trained(feed, settings, rows, held_out))
    return found


# ---------------------------------------------------------------------------------------------------------------- page


def page(measured: Sequence[Times], found: Sequence[Trained], steps: int) -> str:
    """All of it as Markdown."""
    parts = [
        """# Precision, memory layout and compilation

On a CPU, one thread; no card was at hand. Whole steps, forward, backward and optimiser, all ways by turns; ratios are
within a turn: the median, and the least and the most of {turns} turns. The first step includes what is compiled for
it. Nothing here tells what a card gains by TF32, by compilation or by CUDA graphs."""
    ]
    for each in measured:
        rows = [
            [way, f"{ms:.1f}", f"{each.ratio[way][0]:.2f} ({each.ratio[way][1]:.2f} … {each.ratio[way][2]:.2f})",
             f"{each.first_s[way]:.1f}"]
            for way, ms in each.ms.items()
        ]  # fmt: skip
        title = f"## `{each.preset}`: {each.size}², batches of {each.batch}"
        parts += [title, results.table(("way", "ms a step", "ratio", "first step, s"), rows)]
    parts += [bias_section(found, steps)]
    return "\n\n".join(parts)


def bias_section(found: Sequence[Trained], steps: int) -> str:
    """Gradients and what was learned, as Markdown."""
    gradients, learned = [], []
    for name in OTHERS:
        for when in ("first", "last"):
            each = [one.gradients[when][name] for one in found]
            mean, one, noise = (float(np.mean([getattr(g, f) for g in each])) for f in ("mean", "one", "noise"))
            gradients.append([name, when, f"{one:.3%}", f"{mean:.3%}", f"{noise:.1%}", f"1/{noise / mean:.0f}"])
        brighter = np.array([one.brightness[name] / one.brightness["float32"] - 1 for one in found])
        error = np.array([one.error[name] / one.error["float32"] - 1 for one in found])
        apart = float(np.mean([one.apart[name] for one in found]))
        learned.append([name, _interval(brighter), _interval(error), f"{apart:.2%}"])
    spread = np.std([one.brightness["float32"] for one in found], ddof=1) / np.mean(
        [one.brightness["float32"] for one in found]
    )
    return f"""## Does precision bias?

`guided_transport` of `small` on `room` at 64², {SAMPLES} samples, {len(found)} seeds. Gradients of the same weights on
the same batches of 2, less those of float32, as shares of the length of float32's mean gradient: of one batch (root
mean square), of the mean over all batches, and beside it the standard error of float32's own mean by the noise of
samples. TF32 is rounded here, in every convolution of the U-Net and of its gradient. At the last weights the mean
gradient is almost 0, so that shares of it are large; the last column, mean over noise, is the one to compare.

{results.table(("precision", "weights", "one batch", "mean of all", "noise of the mean", "mean over noise"), gradients)}

Networks after {steps} steps on the same batches from the same weights, on held-out views, relative to float32's; 95 %
intervals over seeds. Between seeds float32's own mean brightness has a standard deviation of {spread:.2%}.

{results.table(("precision", "mean brightness", "squared error, noise taken out", "images apart (RMS)"), learned)}"""


def _interval(values: NDArray[np.float64]) -> str:
    """The mean and its 95 % interval over seeds, in percent."""
    interval = confidence_interval(Estimate.of(values))
    if interval is None:
        return f"{values.mean():+.2%}"
    return f"{values.mean():+.2%} ({interval[0]:+.2%} … {interval[1]:+.2%})"


def main() -> int:
    """Run the benchmark; returns the exit code."""
    parser = results.parser(__doc__)
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--turns", type=int, default=9, help="of the small steps; of the paper's a third (9)")
    options = parser.parse_args()
    torch.set_num_threads(1)
    small, paper = make_preset("small", device="cpu"), make_preset("paper-dynamic", device="cpu", batch=1)
    measured = [times("small", 64, small, options.turns), times("paper-dynamic", 256, paper, -(-options.turns // 3))]
    found = bias(options.seeds, options.steps)
    values = {"times": [asdict(each) for each in measured], "bias": [asdict(each) for each in found]}
    text = page(measured, found, options.steps).replace("{turns}", f"{options.turns} and {-(-options.turns // 3)}")
    results.write("arithmetic", text, values, options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
