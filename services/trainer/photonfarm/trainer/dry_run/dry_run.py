"""What a training would take: parameters, operations, memory, and time by a few real steps on made-up samples.

The estimate is printed in words, or as JSON.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from photonfarm.core.formatting import format_bytes
from photonfarm.core.waiting import format_span
from photonfarm.scene.spec import SceneSpec
from photonfarm.trainer.data.batch import TrainingBatch, count_bytes
from photonfarm.trainer.dry_run.made_up import LiveMemory, MadeUpScene
from photonfarm.trainer.runs.devices import describe_device, usable_device
from photonfarm.trainer.runs.settings import TrainSettings
from photonfarm.trainer.training.learner import Learner, name_compile_errors

TIMED_STEPS = 3
SECONDS = 20.0
"""The time that the timed steps may take together, about; where a whole batch takes longer, fewer samples are timed."""

TIMED_BYTES = 2e9
"""The memory that the timed samples may take on a CPU, about."""


@dataclass(frozen=True, slots=True)
class Work:
    """What one sample in a step takes; counted, and the same on every machine but for the storage of activations."""

    flops: int  # of matrix products and convolutions, forward and backward; a multiply-add is two
    activation_bytes: int  # of tensors between forward and backward, at their most
    sample_bytes: int  # of what the network reads, and the targets


@dataclass(frozen=True, slots=True)
class Timed:
    """Steps timed on this machine."""

    device: str
    samples: int  # of each timed step
    steps: int
    step_s: float  # of a whole batch: the median, over the timed samples times the batch
    peak_bytes: int | None  # torch's memory on a card at that; None on a CPU


@dataclass(frozen=True, slots=True)
class DryRun:
    """The estimate of a training."""

    scene: str
    architecture: str
    width: int
    film: tuple[int, int]  # width and height, px
    precision: str
    parameters: int
    batch: int
    steps: int
    work: Work
    state_bytes: int  # weights, gradients, the optimiser's memory, the average
    timed: Timed

    @property
    def step_flops(self) -> int:
        """The operations of a step."""
        return self.work.flops * self.batch

    @property
    def memory_bytes(self) -> int:
        """The memory of a step, without what operations take within themselves: activations, batch, and state."""
        return self.batch * (self.work.activation_bytes + self.work.sample_bytes) + self.state_bytes

    @property
    def seconds(self) -> float:
        """The time of all steps on this machine, without reading, waiting and validation."""
        return self.steps * self.timed.step_s


def rehearse(spec: SceneSpec, settings: TrainSettings) -> DryRun:
    """The estimate for a scene and settings, from some seconds of steps on this machine; nothing is written.

    Raises SpecError for a device that is not there, and for a network that cannot be built or compiled.
    """
    torch.set_num_threads(settings.threads)
    scene = MadeUpScene.of(spec)
    learner = Learner(scene, settings.model_copy(update={"compile": "off"}))
    work = count_work(learner, scene.batch(1, settings))
    state = count_state_bytes(learner)
    if settings.compile != "off":
        learner = Learner(scene, settings)
    with name_compile_errors(settings.compile):
        took = time_steps(learner, scene, settings, work)
    parameters = sum(weight.numel() for weight in learner.network.parameters())
    return DryRun(
        scene=spec.name,
        architecture=settings.network.architecture,
        width=settings.network.width,
        film=(spec.film.width, spec.film.height),
        precision=settings.network.precision,
        parameters=parameters,
        batch=settings.batch,
        steps=settings.max_steps,
        work=work,
        state_bytes=state,
        timed=took,
    )


def count_work(learner: Learner, one: TrainingBatch) -> Work:
    """The work of a step on one sample: counted while it is taken.

    What has the shape of weights, such as their gradients and their copies in bfloat16, is there once a batch.
    """
    weights = {weight.shape for weight in learner.network.parameters()}
    with LiveMemory(but_for=weights) as memory, FlopCounterMode(display=False) as counter:
        learner.step(0, one)
    return Work(counter.get_total_flops(), memory.peak_bytes, count_bytes(one))


def count_state_bytes(learner: Learner) -> int:
    """The bytes that last from step to step, after one: weights, gradients, the optimiser's memory, the average."""
    weights = list(learner.network.parameters())
    gradients = [weight.grad for weight in weights if weight.grad is not None]
    memory = [value for values in learner.optimiser.state.values() for value in values.values()]
    average = [] if learner.average is None else list(learner.average.network.parameters())
    return sum(count_bytes(tensor) for tensor in (*weights, *gradients, *memory, *average))


def time_steps(learner: Learner, scene: MadeUpScene, settings: TrainSettings, work: Work) -> Timed:
    """A few steps, on the whole batch if that takes no longer than `SECONDS` and no more than `TIMED_BYTES`."""
    device = usable_device(settings.device)
    on_card = device.type == "cuda"
    one = scene.batch(1, settings)
    first = _time_step(learner, one, device)  # kernels are made and memory is taken
    single = _time_step(learner, one, device) if first * (TIMED_STEPS + 2) < SECONDS else first
    by_time = int(SECONDS / (TIMED_STEPS + 1) / single)
    by_memory = settings.batch if on_card else int(TIMED_BYTES / work.activation_bytes)
    samples = max(1, min(settings.batch, by_time, by_memory))
    batch = scene.batch(samples, settings)
    _time_step(learner, batch, device)
    if on_card:
        torch.cuda.reset_peak_memory_stats(device)
    step_s = statistics.median(_time_step(learner, batch, device) for _ in range(TIMED_STEPS))
    peak = torch.cuda.max_memory_allocated(device) if on_card else None
    said = describe_device(device, settings.network.precision)
    return Timed(said, samples, TIMED_STEPS, step_s * settings.batch / samples, peak)


def _time_step(learner: Learner, batch: TrainingBatch, device: torch.device) -> float:
    """The seconds of a step; on a card until it is done, as its loss is read."""
    began = time.perf_counter()
    learner.step(1, batch)
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - began


def describe(estimate: DryRun) -> dict[str, Any]:
    """The estimate for programs: its fields, and what follows from them."""
    derived = {"step_flops": estimate.step_flops, "memory_bytes": estimate.memory_bytes, "seconds": estimate.seconds}
    return {**asdict(estimate), **derived}


def format_dry_run(estimate: DryRun) -> str:
    """The estimate for people."""
    work, timed, batch = estimate.work, estimate.timed, estimate.batch
    parts = (
        ("activations", batch * work.activation_bytes),
        ("batch", batch * work.sample_bytes),
        ("weights, gradients, optimiser", estimate.state_bytes),
    )
    rate = estimate.step_flops / timed.step_s / 1e9
    of = "" if timed.samples == batch else f", times {batch}/{timed.samples}"
    step = f"{timed.step_s:.1f} s" if timed.step_s >= 10 else f"{timed.step_s * 1e3:.0f} ms"
    lines = [
        f"{estimate.architecture} for {estimate.scene}: {estimate.film[0]} × {estimate.film[1]} pixels, "
        f"width {estimate.width}, {estimate.precision}",
        f"parameters   {estimate.parameters:,}",
        f"steps        {estimate.steps:,} of {batch} samples, {estimate.steps * batch:,} draws",
        f"work         {estimate.step_flops / 1e9:,.1f} GFLOP a step, forward and backward",
        f"memory       {format_bytes(estimate.memory_bytes)} at least: "
        + ", ".join(f"{name} {format_bytes(size)}" for name, size in parts),
        *([] if timed.peak_bytes is None else [f"             {format_bytes(timed.peak_bytes)} at the timed steps"]),
        f"here         {step} a step, {rate:,.0f} GFLOP/s, {format_span(estimate.seconds)} in all, on {timed.device}",
        f"             (median of {timed.steps} steps of {timed.samples}{of}, on made-up samples; without reading, "
        "waiting, validation)",
    ]
    return "\n".join(lines)
