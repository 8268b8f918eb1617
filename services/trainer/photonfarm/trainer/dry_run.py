"""What a network and its training would take, found on a made-up scene with the sizes of a spec.

`train --summary` counts parameters and work part by part; `train --dry-run` also takes a few real steps.

Shape letters: B batch, P points, K photon slots, H W image.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor
from torch.autograd.graph import saved_tensors_hooks
from torch.utils.flop_counter import FlopCounterMode

from photonfarm.core.formatting import format_bytes
from photonfarm.core.records import F32, STATIC, BasePointCloud, Geometry
from photonfarm.core.waiting import format_span
from photonfarm.data.torch_dataset import SampleTensors
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import Camera, View
from photonfarm.trainer.data.batch import TrainingBatch, allocate_memory, count_bytes
from photonfarm.trainer.networks import build, find_needs
from photonfarm.trainer.networks.inputs import SceneFrame, require
from photonfarm.trainer.predictors.half_filter import settle_filter
from photonfarm.trainer.runs.devices import Ranks, describe_device, usable_device
from photonfarm.trainer.runs.settings import NetworkSettings, TrainSettings
from photonfarm.trainer.training.learner import Learner, name_compile_errors

METALS = 0.2
"""The share of pixels with a specular albedo, over whose lobes `guided_transport` sums light; the others have none."""


@dataclass(frozen=True, slots=True, eq=False)
class MadeUpScene:
    """A cube of side 2 about the origin, seen from inside, with as many points as the spec's cloud."""

    spec: SceneSpec
    geometry: Geometry
    cloud: BasePointCloud

    @classmethod
    def of(cls, spec: SceneSpec) -> Self:
        """The scene for a spec; always the same."""
        rng = np.random.default_rng(0)
        corners = np.array(list(product((-1.0, 1.0), repeat=3)), np.float32)
        # Two opposite walls are enough: of the geometry, a network's frame has the bounding box and the area alone.
        faces = np.array([(0, 1, 3), (0, 3, 2), (4, 5, 7), (4, 7, 6)], np.uint32)
        geometry = Geometry(corners, faces, np.zeros(4, np.int32), np.array([STATIC], np.int16))
        axis, side = rng.integers(0, 3, spec.points), rng.choice([-1.0, 1.0], spec.points)
        position, normal = rng.uniform(-1, 1, (spec.points, 3)), np.zeros((spec.points, 3), np.float32)
        every = np.arange(spec.points)
        position[every, axis], normal[every, axis] = side, -side
        group, face = np.full(spec.points, STATIC, np.int16), np.zeros(spec.points, np.uint32)
        albedo, emission = (rng.random((spec.points, 3), np.float32) for _ in range(2))
        return cls(spec, geometry, BasePointCloud(position.astype(np.float32), normal, albedo, emission, group, face))

    def frame(self, settings: NetworkSettings) -> SceneFrame:
        """The constants that a network is made from."""
        return SceneFrame.of(self.spec, self.geometry, self.cloud, settings)

    def batch(self, size: int, settings: NetworkSettings) -> TrainingBatch:
        """A batch with all that the network reads: numbers uniform in [0, 1), flags of which half are set.

        But cameras are within the cube, points and photons on its walls, normals unit vectors, METALS of pixels metal.
        """
        spec, needs = self.spec, find_needs(settings)
        tensors = allocate_memory(SampleTensors(spec, needs.fields, points=settings.points), size)
        generator = torch.Generator().manual_seed(0)
        for tensor in tensors.values():
            values = torch.rand(tensor.shape, generator=generator)
            tensor.copy_(values < 0.5 if tensor.dtype == torch.bool else values)
        kept = torch.rand(size, spec.film.height, spec.film.width, generator=generator) < 0.5 if needs.kept else None
        batch = TrainingBatch.of(range(size), (b"made up",) * size, tensors, kept)
        if needs.passes and settings.has_denoiser:  # as if they were filtered
            a, b = (replace(half, filtered=half.colour) for half in map(require, (batch.inputs.noisy, batch.other)))
            batch = replace(batch, inputs=replace(batch.inputs, noisy=a), other=b)
        inputs = batch.inputs
        for place, (origin, target) in enumerate(0.5 * torch.rand(size, 2, 3, generator=generator).numpy()):
            camera = Camera.of(View(origin - 0.5, target + 0.5), spec)
            inputs.world_to_camera[place] = torch.from_numpy(camera.world_to_camera)
            if inputs.focal_px is not None:
                inputs.focal_px[place] = camera.focal_px
        inputs.depth.add_(0.5)
        _make_unit(inputs.normal)
        if inputs.points is not None:
            inputs.points.position[:] = _repeat_rows(self.cloud.position, inputs.points.position.shape[1])
            inputs.points.present.fill_(True)
            if inputs.points.normal is not None:
                inputs.points.normal[:] = _repeat_rows(self.cloud.normal, inputs.points.normal.shape[1])
        if (photons := inputs.photons) is not None:
            photons.position[:] = _repeat_rows(self.cloud.position, photons.position.shape[1])
            photons.normal[:] = _repeat_rows(self.cloud.normal, photons.normal.shape[1])
            photons.direction[:] = -photons.normal
            photons.bounce.mul_(spec.photons.depth).floor_()
            photons.present.fill_(True)
        if (guides := inputs.guides) is not None:
            guides.specular.mul_((torch.rand(guides.roughness.shape, generator=generator) < METALS)[..., None])
            _make_unit(guides.mean_normal)
            _make_unit(guides.beyond_normal)
        return batch


def _make_unit(vectors: Tensor) -> None:
    """Turn vectors of numbers uniform in [0, 1) into unit vectors of all directions, in place."""
    vectors.sub_(0.5).div_(torch.linalg.vector_norm(vectors, dim=-1, keepdim=True))


def _repeat_rows(values: F32, count: int) -> Tensor:
    """The first `count` rows, from the beginning again if there are fewer."""
    return torch.from_numpy(np.resize(values, (count, *values.shape[1:])))


# ---------------------------------------------------------------------------------------------------------- the summary

MODULES = {"light_transport": "point branch", "lit_points": "point branch", "image_synthesis": "U-Net"}
"""The part to which each module of a network belongs; all others are a user's own, or belong to projection."""

OTHER = "other"
PARTS = ("point branch", "projection", "U-Net", OTHER)


@dataclass(frozen=True, slots=True)
class NetworkPart:
    """A part of a network."""

    name: str
    parameters: int
    gmacs: float  # 10⁹ multiply-adds of matrix products and convolutions, for one image


def summarise(spec: SceneSpec, settings: NetworkSettings) -> list[NetworkPart]:
    """The parts of a scene's network, whose work is counted while it makes an image of a made-up sample.

    A multiply-add is two of the operations that torch's FlopCounterMode counts, which are those of convolutions and
    matrix products; sums, such as the mean over the points in a pixel, are not counted. Descriptors belong to points.
    """
    scene = MadeUpScene.of(spec)
    network = build(settings, scene.frame(settings), seed=0)
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        network(scene.batch(1, settings).inputs)
    gmacs_of = {module: sum(ops.values()) / 2e9 for module, ops in counter.get_flop_counts().items()}
    parameters, gmacs = dict.fromkeys(PARTS, 0), dict.fromkeys(PARTS, 0.0)
    for name, parameter in network.named_parameters():
        parameters[{**MODULES, "descriptor": "point branch"}.get(name.split(".")[0], OTHER)] += parameter.numel()
    for module, part in MODULES.items():
        gmacs[part] += gmacs_of.get(f"{type(network).__name__}.{module}", 0.0)
    # The rest is that of a user's own modules if there are any, and else of projection, which is no module.
    gmacs[OTHER if parameters[OTHER] else "projection"] = gmacs_of["Global"] - sum(gmacs.values())
    return [NetworkPart(name, parameters[name], gmacs[name]) for name in PARTS if parameters[name] or gmacs[name]]


def format_summary(parts: list[NetworkPart]) -> str:
    """The parts and their sum, a line each."""
    total = NetworkPart("total", sum(part.parameters for part in parts), sum(part.gmacs for part in parts))
    lines = [f"{part.name:<14}{part.parameters:>12,}{part.gmacs:>10.3f}" for part in (*parts, total)]
    return "\n".join([f"{'part':<14}{'parameters':>12}{'GMAC':>10}", *lines])


# --------------------------------------------------------------------------------------------------------- the estimate

TIMED_STEPS = 3
TIMED_S = 20.0
"""The time that the timed steps may take together, about; where a whole batch takes longer, fewer samples are timed."""

TIMED_BYTES = 2e9
"""The memory that the timed samples may take on a CPU, about."""


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
    sample_flops: int  # of matrix products and convolutions, forward and backward; a multiply-add is two
    activation_bytes: int  # of one sample's tensors that are kept from forward to backward
    sample_bytes: int  # of what the network reads of one sample, and the targets
    state_bytes: int  # weights, gradients, the optimiser's memory, the average
    device: str
    timed_samples: int  # of each timed step
    step_s: float  # of a whole batch: the timed steps' median, times `batch` / `timed_samples`
    peak_bytes: int | None  # torch's memory on a card at that; None on a CPU

    @property
    def step_flops(self) -> int:
        """The operations of a step."""
        return self.sample_flops * self.batch

    @property
    def memory_bytes(self) -> int:
        """The memory of a step, without what operations take within themselves: activations, batch, and state."""
        return self.batch * (self.activation_bytes + self.sample_bytes) + self.state_bytes

    @property
    def seconds(self) -> float:
        """The time of all steps on this machine, without reading, waiting and validation."""
        return self.steps * self.step_s

    def document(self) -> dict[str, Any]:
        """The estimate for programs: its fields, and what follows from them."""
        derived = {"step_flops": self.step_flops, "memory_bytes": self.memory_bytes, "seconds": self.seconds}
        return {**asdict(self), **derived}


def rehearse(spec: SceneSpec, settings: TrainSettings, tell: Callable[[str], object] = lambda _: None) -> DryRun:
    """Estimate a training with a scene and settings by some seconds of steps on this machine; nothing is written.

    `tell` is called with each part of the work that begins; at 256² on a core one takes minutes. Raises SpecError for a
    device that is not there, and for a network that cannot be built or compiled.
    """
    settings = settle_filter(settings)
    torch.set_num_threads(settings.threads)
    scene, network, device = MadeUpScene.of(spec), settings.network, usable_device(settings.device)
    tell("the network is built, and takes a step of one sample")
    frame = scene.frame(network)
    one_sample = scene.batch(1, network)
    # Work is counted operation by operation as torch runs them, and a compiled network is one operation.
    learner = Learner(frame, settings.model_copy(update={"compile": "off"}), Ranks())
    flops, activation_bytes = count_work(learner, one_sample)
    state_bytes = count_state_bytes(learner)
    if settings.compile != "off":
        learner = Learner(frame, settings, Ranks())
    most = settings.batch if device.type == "cuda" else int(TIMED_BYTES / activation_bytes)
    with name_compile_errors(settings.compile):
        tell("steps are timed")
        timed_samples, step_s, peak_bytes = time_steps(learner, scene, settings, device, most)
    return DryRun(
        scene=spec.name,
        architecture=network.architecture,
        width=network.width,
        film=(spec.film.width, spec.film.height),
        precision=network.precision,
        parameters=sum(weight.numel() for weight in learner.network.parameters()),
        batch=settings.batch,
        steps=settings.max_steps,
        sample_flops=flops,
        activation_bytes=activation_bytes,
        sample_bytes=count_bytes(one_sample),
        state_bytes=state_bytes,
        device=describe_device(device, network.precision),
        timed_samples=timed_samples,
        step_s=step_s,
        peak_bytes=peak_bytes,
    )


def count_work(learner: Learner, one_sample: TrainingBatch) -> tuple[int, int]:
    """Take a step on one sample, and count its operations and the bytes that it keeps from forward to backward.

    What has the shape of weights, such as their copies in bfloat16, is there once a batch, and is left out.
    """
    weights = {weight.shape for weight in learner.network.parameters()}
    kept: dict[int, int] = {}  # bytes of each piece of memory, by its place

    def note(tensor: Tensor) -> Tensor:
        if tensor.shape not in weights:
            storage = tensor.untyped_storage()
            kept[storage.data_ptr()] = storage.nbytes()
        return tensor

    with saved_tensors_hooks(note, lambda tensor: tensor), FlopCounterMode(display=False) as counter:
        learner.step(0, one_sample)
    return counter.get_total_flops(), sum(kept.values())


def count_state_bytes(learner: Learner) -> int:
    """The bytes that last from step to step, after one: weights, gradients, the optimiser's memory, the average."""
    weights = list(learner.network.parameters())
    gradients = [weight.grad for weight in weights if weight.grad is not None]
    memory = [value for values in learner.optimiser.state.values() for value in values.values()]
    average = [] if learner.average is None else list(learner.average.network.parameters())
    return sum(count_bytes(tensor) for tensor in (*weights, *gradients, *memory, *average))


def time_steps(
    learner: Learner, scene: MadeUpScene, settings: TrainSettings, device: torch.device, most: int
) -> tuple[int, float, int | None]:
    """Take a few steps, of the whole batch if that takes no more than `TIMED_S` and has no more than `most` samples.

    Returns the samples of each, the seconds of a step of the whole batch, and the memory on a card.
    """
    one_sample = scene.batch(1, settings.network)
    first_s = _time_step(learner, one_sample, device)  # with the making of kernels and the taking of memory
    # again without these, if the steps that follow are then quick enough: this, one that warms up, and the timed ones
    sample_s = _time_step(learner, one_sample, device) if first_s * (TIMED_STEPS + 2) < TIMED_S else first_s
    samples = max(1, min(settings.batch, int(TIMED_S / (TIMED_STEPS + 1) / sample_s), most))
    batch = scene.batch(samples, settings.network)
    _time_step(learner, batch, device)  # the warm-up for this size of batch
    on_card = device.type == "cuda"
    if on_card:
        torch.cuda.reset_peak_memory_stats(device)
    step_s = statistics.median(_time_step(learner, batch, device) for _ in range(TIMED_STEPS))
    peak_bytes = torch.cuda.max_memory_allocated(device) if on_card else None
    return samples, step_s * settings.batch / samples, peak_bytes


def _time_step(learner: Learner, batch: TrainingBatch, device: torch.device) -> float:
    """The seconds of a step; on a card until it is done."""
    began = time.perf_counter()
    learner.step(1, batch)
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - began


def format_dry_run(estimate: DryRun) -> str:
    """The estimate for people."""
    batch, samples, step_s = estimate.batch, estimate.timed_samples, estimate.step_s
    parts = (
        ("activations", batch * estimate.activation_bytes),
        ("batch", batch * estimate.sample_bytes),
        ("weights, gradients, optimiser", estimate.state_bytes),
    )
    of = "" if samples == batch else f", times {batch}/{samples}"
    step = f"{step_s:.1f} s" if step_s >= 10 else f"{step_s * 1e3:.0f} ms"
    lines = [
        f"{estimate.architecture} for {estimate.scene}: {estimate.film[0]} × {estimate.film[1]} pixels, "
        f"width {estimate.width}, {estimate.precision}",
        f"parameters   {estimate.parameters:,}",
        f"steps        {estimate.steps:,} of {batch} samples, {estimate.steps * batch:,} draws",
        f"work         {estimate.step_flops / 1e9:,.1f} GFLOP a step, forward and backward",
        f"memory       {format_bytes(estimate.memory_bytes)} at least: "
        + ", ".join(f"{name} {format_bytes(size)}" for name, size in parts),
        *([] if estimate.peak_bytes is None else [f"             {format_bytes(estimate.peak_bytes)} at timed steps"]),
        f"here         {step} a step, {estimate.step_flops / step_s / 1e9:,.0f} GFLOP/s, "
        f"{format_span(estimate.seconds)} in all, on {estimate.device}",
        f"             (median of {TIMED_STEPS} steps of {samples}{of}, on made-up samples; without reading, "
        "waiting, validation)",
    ]
    return "\n".join(lines)
