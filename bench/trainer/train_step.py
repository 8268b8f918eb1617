"""What a training step and an image cost by architecture, and whether reading keeps up.

    python -m bench.trainer.train_step [--device cpu] [--steps 100] [--repetitions 15] [--paper-batch 1] [--out DIR]

With the preset `small` at 64², and at the supplement's sizes: `paper-dynamic` at 256², in smaller batches and with a
fifth of the repetitions. A store of `room` is filled with real renders (a few views, dealt again and again), and lies
in the page cache. Parts are measured by themselves, each with its gradients for a step, as medians in CPU seconds, or
seconds with a GPU; reading and waiting in seconds, by the feed that training uses and by a run of it. Exit code 0.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bench.harness import results
from bench.harness.contents import Contents, commit
from bench.harness.scenes import square
from photonfarm.plan.request import Request
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec
from photonfarm.store import SceneReader, Store
from photonfarm.store.read.batch import Batch
from photonfarm.trainer.data.batch import TrainingBatch
from photonfarm.trainer.data.feed import Feed
from photonfarm.trainer.networks import ARCHITECTURES
from photonfarm.trainer.networks.inputs import Inputs, SceneFrame
from photonfarm.trainer.networks.network import Network
from photonfarm.trainer.networks.paper_networks import LightTransportPhotons
from photonfarm.trainer.runs import run_folder
from photonfarm.trainer.runs.devices import Ranks, usable_device
from photonfarm.trainer.runs.run_folder import METRICS
from photonfarm.trainer.runs.settings import TrainSettings, make_preset
from photonfarm.trainer.training.learner import Learner
from photonfarm.trainer.training.loop import train

RENDERED = 8  # configurations, of two views each
SAMPLES = 256
WHOLE = "whole"
PARTS = ("copy", "point branch", "projection", "photon map", "U-Net", "optimiser")


@dataclass(frozen=True, slots=True)
class ArchitectureTimes:
    """One architecture; milliseconds per batch."""

    architecture: str
    parameters: int
    step_ms: float
    image_ms: float  # inference
    step_parts_ms: dict[str, float]  # by themselves
    image_parts_ms: dict[str, float]
    read_ms: float  # by the feed's thread, while steps are computed
    wait_share: float  # of a run's steps: waiting for the feed


def points_share(parts: dict[str, float]) -> float:
    """Light transport, projection and photon map over the U-Net."""
    return (parts["point branch"] + parts["projection"] + parts["photon map"]) / parts["U-Net"]


@dataclass(frozen=True, slots=True)
class Reading:
    """Milliseconds per sample."""

    size: int
    stored_ms: float  # `SceneReader.read_batch` into the store's types
    fed_ms: dict[str, float]  # by architecture, all that it needs, as the network takes it


@dataclass(frozen=True, slots=True)
class Preset:
    """What one preset costs at one size of images."""

    name: str
    size: int
    settings: TrainSettings
    rows: list[ArchitectureTimes]
    reading: Reading


class WorkTimer:
    """Milliseconds of a piece of work: CPU time, or time on a GPU until it has done what it was given."""

    def __init__(self, device: str, repetitions: int) -> None:
        self._gpu, self._repetitions = device.startswith("cuda"), repetitions

    def ms(self, works: dict[str, Callable[[], object]]) -> dict[str, float]:
        """The median of each, done in turn, after a turn that does not count."""
        turns = [{name: self._once(work) for name, work in works.items()} for _ in range(self._repetitions + 1)][1:]
        return {name: statistics.median(turn[name] for turn in turns) for name in works}

    def _once(self, work: Callable[[], object]) -> float:
        self._wait()
        now = time.perf_counter if self._gpu else time.process_time
        began = now()
        work()
        self._wait()
        return (now() - began) * 1e3

    def _wait(self) -> None:
        if self._gpu:
            torch.cuda.synchronize()


def filled(spec: SceneSpec, root: Path, samples: int | None = None) -> str:
    """A store of the scene with so many samples, `SAMPLES` if not given; returns the scene's id."""
    contents = Contents(spec)
    scene = Store(root, create=True).add(spec)
    scene.write_base(*contents.base)
    scene.plan(Request(modifications=(samples or SAMPLES) // 2, views_per_modification=2), shard_rows=2 * RENDERED)
    commit(scene, 0, contents)
    pool = contents.pool()
    for job in range(1, scene.jobs()):
        commit(scene, job, pool)
    return scene.scene_id


def measure(where: tuple[Path, str], settings: TrainSettings, clock: WorkTimer, steps: int) -> ArchitectureTimes:
    """One architecture on a complete store."""
    parameters, step, image = time_step(where, settings, clock)
    return ArchitectureTimes(
        settings.network.architecture,
        parameters,
        step.pop(WHOLE),
        image.pop(WHOLE),
        step,
        image,
        fed_ms(where, settings) * settings.batch,
        wait_share(where, settings, steps),
    )


def time_step(
    where: tuple[Path, str], settings: TrainSettings, clock: WorkTimer
) -> tuple[int, dict[str, float], dict[str, float]]:
    """The number of parameters of one architecture, and its `timed` step and image, of one batch."""
    with Feed(SceneReader(*where), settings) as feed:
        rows = [row for row, _ in feed.arrivals()[0]]
        learner = Learner(SceneFrame.of(feed.spec, *feed.base, settings.network), settings, Ranks())
        feed.ask(rows[: settings.batch])
        batch = feed.take()
        step, image = (timed(learner, batch, usable_device(settings.device), clock, gradients=g) for g in (True, False))
        return sum(w.numel() for w in learner.network.parameters()), step, image


def timed(
    learner: Learner, batch: TrainingBatch, device: torch.device, clock: WorkTimer, *, gradients: bool
) -> dict[str, float]:
    """A step, or an image, and its parts, each by itself."""
    network = learner.network
    inputs = (batch.to(device).for_training() if gradients else batch.to(device)).inputs
    calls, ((channels,),) = (find_calls(network, method, inputs) for method in ("project", "synthesise"))
    channels = channels.clone().requires_grad_(gradients)
    leaves = [(told[0].detach().requires_grad_(gradients), *told[1:]) for told in calls]

    def with_gradients(make: Callable[[], list[Tensor]]) -> Callable[[], object]:
        def work() -> None:
            with torch.set_grad_enabled(gradients):
                made = [out for out in make() if out.requires_grad]
                if made:
                    torch.autograd.backward(made, [torch.ones_like(out) for out in made])

        return work

    found = clock.ms(
        {
            WHOLE: (lambda: learner.step(0, batch)) if gradients else with_gradients(lambda: [network(inputs)]),
            "copy": lambda: batch.to(device).for_training() if gradients else batch.to(device),
            "point branch": with_gradients(lambda: network.further(inputs)),
            "projection": with_gradients(lambda: [network.project(*told) for told in leaves]),
            "photon map": lambda: network.photon_light(inputs) if isinstance(network, LightTransportPhotons) else None,
            "U-Net": with_gradients(lambda: [network.synthesise(channels)]),
            **({"optimiser": learner.optimiser.step} if gradients else {}),
        }
    )
    others = found["projection"] + found["photon map"]
    return {**found, "point branch": max(found["point branch"] - others, 0.0)}


def find_calls(network: Network, method: str, inputs: Inputs) -> list[tuple[Any, ...]]:
    """What the network gives a method of its own as it makes these inputs' image: the arguments of each call."""
    calls: list[tuple[Any, ...]] = []
    plain = getattr(network, method)

    def noted(*told: Any) -> Tensor:
        calls.append(told)
        made: Tensor = plain(*told)
        return made

    setattr(network, method, noted)
    with torch.no_grad():
        network(inputs)
    setattr(network, method, plain)
    return calls


def fed_ms(where: tuple[Path, str], settings: TrainSettings, rounds: int = 5) -> float:
    """Milliseconds for a sample to come through the feed."""
    with Feed(SceneReader(*where), settings) as feed:
        rows = [row for row, _ in feed.arrivals()[0]]
        asked = [rows[i : i + settings.batch] for i in range(0, len(rows), settings.batch)]

        def one_round() -> float:
            began = time.perf_counter()
            for some in asked:
                feed.ask(some)
                feed.take()
            return (time.perf_counter() - began) * 1e3 / len(rows)

        one_round()
        return statistics.median(one_round() for _ in range(rounds))


def wait_share(where: tuple[Path, str], settings: TrainSettings, steps: int) -> float:
    """Share of the time of a run's steps for which it waited for data."""
    with tempfile.TemporaryDirectory() as folder:
        changes = {"max_steps": steps, "validate_every": 10 * steps, "validation_samples": 1}
        train(SceneReader(*where), settings.model_copy(update=changes), Path(folder))
        seconds = run_folder.read_log(Path(folder) / METRICS)[-1]["seconds"]
    waited = seconds["wait_data"] + seconds["wait_read"]
    return waited / (waited + seconds["train"])


def reading(where: tuple[Path, str], settings: TrainSettings, size: int) -> Reading:
    """Samples of one size, from the page cache."""
    source = SceneReader(*where)
    rows = source.refresh().tolist()
    memory = Batch.empty(source.spec, settings.batch)

    def one_round() -> float:
        began = time.perf_counter()
        for i in range(0, len(rows), settings.batch):
            source.read_samples(rows[i : i + settings.batch], memory)
        return (time.perf_counter() - began) * 1e3 / len(rows)

    one_round()
    stored = statistics.median(one_round() for _ in range(5))
    return Reading(size, stored, {name: fed_ms(where, for_architecture(settings, name)) for name in shown()})


def shown() -> Iterator[str]:
    """The architectures, but one denoiser: the others do the same work."""
    return (name for name in ARCHITECTURES if not name.startswith("denoise") or name == "denoise_4")


def for_architecture(settings: TrainSettings, architecture: str) -> TrainSettings:
    """The same settings for another architecture."""
    network = settings.network.model_copy(update={"architecture": architecture})
    return settings.model_copy(update={"network": network})


def preset_section(found: Preset) -> str:
    """The tables of one preset as Markdown."""

    def line(row: ArchitectureTimes, whole: float, parts: dict[str, float]) -> list[str]:
        shares = [f"{parts[part] / whole:.0%}" if part in parts else "" for part in PARTS]
        rest = 1 - sum(parts.values()) / whole
        return [f"`{row.architecture}`", f"{whole:.1f}", *shares, f"{round(100 * rest)}%", f"{points_share(parts):.1%}"]

    steps = []
    for row in found.rows:
        waiting = f"{row.read_ms:.2f}", f"{row.wait_share:.1%}"
        steps.append([*line(row, row.step_ms, row.step_parts_ms), *waiting])
    batch = found.settings.batch
    images = [[*line(row, row.image_ms, row.image_parts_ms), f"{row.image_ms / batch:.1f}"] for row in found.rows]
    header = ("architecture", "ms", *PARTS, "rest", "points over U-Net", "reading, ms, meanwhile", "waiting for data")
    return f"""## `{found.name}`: {found.size}², width {found.settings.network.width}, batches of {batch}

A step, forward and backward:

{results.table(header, steps)}

Images:

{results.table(("architecture", "ms a batch", *PARTS, "rest", "points over U-Net", "ms an image"), images)}
"""


def page(device: str, presets: list[Preset]) -> str:
    """All of it as Markdown."""
    most = max(points_share(parts) for row in presets[-1].rows for parts in (row.step_parts_ms, row.image_parts_ms))
    waiting = max(row.wait_share for row in presets[0].rows)
    read = [of.reading for of in presets]
    fed = [[f"{r.size}²", f"{r.stored_ms:.2f}", *(f"{r.fed_ms[name]:.2f}" for name in shown())] for r in read]
    return f"""# A training step

Waiting for data takes at most {waiting:.1%} of a step with `small`; 5 % are allowed. Light transport, projection and
photon map take at most {most:.1%} of the U-Net's time at the supplement's sizes; 15 % are allowed.

`room` on the device `{device}`, one thread. Parts are measured by themselves, so that their shares need not sum to
100 %; the rest is the loss, rays, and what joins the parts. **Points over U-Net** is point branch, projection and
photon map over the U-Net's time. Medians of turns. Reading is a thread's, which works ahead on the same processor
cores; waiting is what is left of it in a run, as a share of the steps' time.

{chr(10).join(preset_section(of) for of in presets)}
## Reading

Milliseconds a sample from the page cache: as stored, each byte checked, into memory that is used again; and all that a
network takes, in float32, exposed, with the configuration's points and photons.

{results.table(("size", "as stored", *(f"`{name}`" for name in shown())), fed)}"""


def measure_preset(name: str, size: int, settings: TrainSettings, clock: WorkTimer, steps: int) -> Preset:
    """All architectures, on a store of their own."""
    with tempfile.TemporaryDirectory() as folder:
        where = Path(folder), filled(resized(size, settings.network.points), Path(folder))
        read = reading(where, settings.model_copy(update={"batch": 16}), size)
        rows = [measure(where, for_architecture(settings, one), clock, steps) for one in shown()]
    return Preset(name, size, settings, rows, read)


def main() -> int:
    """Run the benchmark; returns the exit code."""
    parser = results.parser(__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--steps", type=int, default=100, help="of the run whose waiting is measured (100)")
    parser.add_argument("--repetitions", type=int, default=15)
    parser.add_argument("--paper-batch", type=int, default=1, help="at the supplement's sizes (1)")
    options = parser.parse_args()
    torch.set_num_threads(1)
    small = make_preset("small", device=options.device)
    paper = make_preset("paper-dynamic", device=options.device, batch=options.paper_batch)
    fewer = WorkTimer(options.device, -(-options.repetitions // 5))
    presets = [
        measure_preset("small", 64, small, WorkTimer(options.device, options.repetitions), options.steps),
        measure_preset("paper-dynamic", 256, paper, fewer, -(-options.steps // 20)),
    ]
    values = {"presets": [document(of) for of in presets]}
    results.write("train_step", page(options.device, presets), values, options.out)
    return 0


def document(of: Preset) -> dict[str, Any]:
    """The page's figures as JSON."""
    rows = [asdict(row) for row in of.rows]
    return {"preset": of.name, "size": of.size, "batch": of.settings.batch, "rows": rows, "reading": asdict(of.reading)}


def resized(size: int, points: int | None) -> SceneSpec:
    """The room with images of another size, and so many points."""
    spec = square(load_spec("room"), size)
    return spec.model_copy(update={"points": points or spec.points})


if __name__ == "__main__":
    sys.exit(main())
