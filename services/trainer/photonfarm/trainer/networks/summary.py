"""The parts of a network: their parameters and work, counted while it makes one image.

Shape letters: P points, K photon slots.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from photonfarm.data.torch_dataset import SampleTensors
from photonfarm.scene.spec import SceneSpec
from photonfarm.trainer.networks import build, find_kind
from photonfarm.trainer.networks.inputs import Inputs, NoisyColour, SceneFrame
from photonfarm.trainer.networks.network import Network
from photonfarm.trainer.networks.projection import Optics
from photonfarm.trainer.runs.settings import NetworkSettings

MODULES = {
    "light_transport": "point branch",
    "lit_points": "point branch",
    "photon_transport": "photon branch",
    "image_synthesis": "U-Net",
}
"""The part to which each module of a network belongs; all others belong to projection, and to points' descriptors."""

OTHER = "other"
"""The part of a user's own modules."""

PARTS = ("point branch", "photon branch", "projection", "U-Net", OTHER)
DESCRIPTOR = "descriptor"


@dataclass(frozen=True, slots=True)
class NetworkPart:
    """A part of a network."""

    name: str
    parameters: int
    gmacs: float  # 10⁹ multiply-adds of matrix products and convolutions, for one image


def summarise(spec: SceneSpec, settings: NetworkSettings) -> list[NetworkPart]:
    """The parts of a scene's network. It makes one image of made-up points and buffers for this.

    A multiply-add is two of the operations that torch's FlopCounterMode counts, which are those of convolutions and
    matrix products; sums, such as the mean over the points in a pixel, are not counted.
    """
    network = build(settings, _make_frame(spec, settings), seed=0)
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        network(_make_inputs(spec, settings))
    counts = {name: sum(ops.values()) / 2e9 for name, ops in counter.get_flop_counts().items()}
    root = type(network).__name__
    gmacs = dict.fromkeys(PARTS, 0.0)
    for module, part in MODULES.items():
        gmacs[part] += counts.get(f"{root}.{module}", 0.0)
    rest = counts["Global"] - sum(gmacs.values())
    parameters = _count_parameters(network)
    gmacs[OTHER if parameters[OTHER] else "projection"] = rest
    return [NetworkPart(name, parameters[name], gmacs[name]) for name in PARTS if parameters[name] or gmacs[name]]


def format_summary(parts: list[NetworkPart]) -> str:
    """The parts and their sum, a line each."""
    total = NetworkPart("total", sum(part.parameters for part in parts), sum(part.gmacs for part in parts))
    lines = [f"{part.name:<14}{part.parameters:>12,}{part.gmacs:>10.3f}" for part in (*parts, total)]
    return "\n".join([f"{'part':<14}{'parameters':>12}{'GMAC':>10}", *lines])


def _count_parameters(network: Network) -> dict[str, int]:
    """The number of parameters of each part; descriptors belong to the points."""
    counts = dict.fromkeys(PARTS, 0)
    for name, parameter in network.named_parameters():
        module = name.split(".")[0]
        counts["point branch" if module == DESCRIPTOR else MODULES.get(module, OTHER)] += parameter.numel()
    return counts


def _make_frame(spec: SceneSpec, settings: NetworkSettings) -> SceneFrame:
    """A frame with as many points and photons as the scene has; their values do not matter."""
    points = min(settings.points or spec.points, spec.points)
    appearance, base = np.zeros((points, 9), np.float32), np.zeros((points, 3), np.float32)
    optics = Optics.of(spec, settings.occlusion, settings.occlusion_tolerance)
    photons = spec.photons.paths, spec.photons.depth
    return SceneFrame(optics, np.zeros(3, np.float32), 1.0, base, appearance, *photons, 1.0, -1, 1.0, 1.0)


def _make_inputs(spec: SceneSpec, settings: NetworkSettings) -> Inputs:
    """Inputs of one image that are all zero: all points lie in the eye, and none is projected."""
    needs = find_kind(settings.architecture).needs
    tensors = SampleTensors(spec, needs.fields, points=settings.points).empty(1)
    for values in tensors.values():
        values.zero_()
    image = tensors["albedo"]
    return Inputs.of(tensors, NoisyColour(image, image[..., 0] > 0) if needs.kept else None)
