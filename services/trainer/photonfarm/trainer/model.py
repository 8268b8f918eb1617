"""The networks, one per scene: points → light transport → projection → image synthesis [supplement 1].

Shape letters: B batch, P points, H W image, C channels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from photonfarm.shared.errors import SpecError
from photonfarm.shared.records import F32, BasePointCloud, Geometry
from photonfarm.shared.scene import SceneSpec
from photonfarm.trainer.image_synthesis import ImageSynthesisLayer
from photonfarm.trainer.light_transport import WIDTH, LightTransportLayer
from photonfarm.trainer.projection import Optics, footprint, project_mean
from photonfarm.trainer.settings import NetworkSettings

IMAGE_CHANNELS = 10
"""View ray 3, depth 1, albedo 3, normal 3 [supplement 1.3]."""


def usable_device(name: str) -> torch.device:
    """The device of this name, "cpu", "cuda" or "cuda:N"; raises SpecError where torch cannot use it."""
    try:
        device = torch.device(name)
        if device.type not in ("cpu", "cuda"):
            raise SpecError(f"device = {name!r}: must be cpu or cuda")
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:  # the latter where torch was built without CUDA
        raise SpecError(f"device = {name!r}: cannot be used here: {str(error).splitlines()[0]}") from error
    return device


@dataclass(frozen=True, slots=True, eq=False)
class Inputs:
    """What a network sees of a batch of samples."""

    position: Tensor  # (B, P, 3) world, scene units
    visible: Tensor  # (B, P) bool
    world_to_camera: Tensor  # (B, 3, 4)
    depth: Tensor  # (B, H, W) along the forward axis, 0: nothing hit
    albedo: Tensor  # (B, H, W, 3)
    normal: Tensor  # (B, H, W, 3)


@dataclass(frozen=True, slots=True, eq=False)
class SceneFrame:
    """The constants of a scene by which inputs are brought near 1; all ours, as the supplement is silent.

    Positions are taken about the centre of the geometry's bounding box and, like depths, divided by half its diagonal.
    Emission is divided by the largest in the cloud. Normals, rays and albedo are near 1 as they are.
    """

    optics: Optics
    centre: F32  # (3,)
    scale: float  # half the diagonal, scene units
    appearance: F32  # (P, 9) what never changes of each point: normal, albedo, emission

    @classmethod
    def of(cls, spec: SceneSpec, geometry: Geometry, cloud: BasePointCloud, settings: NetworkSettings) -> SceneFrame:
        """The frame of a scene, for the first `settings.points` points of its cloud (uniform draws, as all are)."""
        low, high = geometry.vertices.min(axis=0), geometry.vertices.max(axis=0)
        used = slice(settings.points)
        emission = cloud.emission[used] / max(float(cloud.emission.max()), 1e-30)
        appearance = np.concatenate([cloud.normal[used], cloud.albedo[used], emission], axis=1)
        optics = Optics.of(spec, settings.depth_space, settings.occlusion_tolerance)
        scale = max(0.5 * float(np.linalg.norm(high - low)), 1e-30)
        return cls(optics, (0.5 * (low + high)).astype(np.float32), scale, appearance.astype(np.float32))


class Cnn(nn.Module):
    """Baseline `cnn`: image synthesis from the image-space channels alone [supplement Table 1, "CNN only"]."""

    projected_channels = 0

    def __init__(self, settings: NetworkSettings, frame: SceneFrame) -> None:
        super().__init__()
        self.optics = frame.optics
        self.scale = frame.scale
        self.image_synthesis = ImageSynthesisLayer(self.projected_channels + IMAGE_CHANNELS, settings.width)

    def image_space(self, inputs: Inputs) -> Tensor:
        """View ray, depth, albedo and normal as one tensor, (B, H, W, 10)."""
        depth = inputs.depth[..., None] / self.scale
        return torch.cat([self.optics.rays(inputs.world_to_camera), depth, inputs.albedo, inputs.normal], dim=-1)

    def forward(self, inputs: Inputs) -> Tensor:
        """The image, (B, H, W, 3), linear radiance × exposure."""
        return self.synthesise(self.image_space(inputs))

    def synthesise(self, channels: Tensor) -> Tensor:
        """(B, H, W, C) → (B, H, W, 3). Channels stay last in memory, which is what convolutions on CPUs like."""
        return self.image_synthesis(channels.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)


class LightTransport(Cnn):
    """The supplement's network without photons: "Ours (w/o photons)"."""

    projected_channels = WIDTH
    appearance: Tensor
    centre: Tensor

    def __init__(self, settings: NetworkSettings, frame: SceneFrame) -> None:
        super().__init__(settings, frame)
        points, appearance = frame.appearance.shape
        self.register_buffer("appearance", torch.from_numpy(frame.appearance), persistent=False)
        self.register_buffer("centre", torch.from_numpy(frame.centre), persistent=False)
        self.descriptor = nn.Parameter(torch.randn(points, settings.descriptor))
        self.light_transport = LightTransportLayer(3, appearance + settings.descriptor)

    def point_features(self, inputs: Inputs) -> Tensor:
        """f_i (B, P, 64) from p_i: current world position, then normal, albedo, emission and learnable descriptor."""
        position = (inputs.position - self.centre) / self.scale
        fixed = torch.cat([self.appearance, self.descriptor], dim=1)
        return self.light_transport(position, fixed, inputs.visible)

    def forward(self, inputs: Inputs) -> Tensor:
        """The image, (B, H, W, 3), linear radiance × exposure."""
        features = self.point_features(inputs)
        seen = footprint(inputs.position, inputs.visible, inputs.world_to_camera, inputs.depth, self.optics)
        projected = project_mean(features, seen, self.optics.height, self.optics.width)
        return self.synthesise(torch.cat([projected, self.image_space(inputs)], dim=-1))


ARCHITECTURES: dict[str, type[Cnn]] = {"light_transport": LightTransport, "cnn": Cnn}


def build(settings: NetworkSettings, frame: SceneFrame, seed: int) -> Cnn:
    """A freshly initialised network; the same weights for the same seed on one version of torch."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return ARCHITECTURES[settings.architecture](settings, frame)
