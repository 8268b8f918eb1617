"""The networks by name, one per scene; each with what it needs to see."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch

from photonfarm.trainer.networks.cnn import Cnn
from photonfarm.trainer.networks.denoiser import Denoiser
from photonfarm.trainer.networks.feature_projection import FeatureProjection
from photonfarm.trainer.networks.frame import SceneFrame
from photonfarm.trainer.networks.guided import Guided
from photonfarm.trainer.networks.inputs import Needs
from photonfarm.trainer.networks.light_transport import LightTransport, LightTransportPhotons
from photonfarm.trainer.networks.network import Network
from photonfarm.trainer.runs.settings import Architecture, NetworkSettings


@dataclass(frozen=True, slots=True)
class Kind:
    """An architecture: what makes its network, and what that reads."""

    make: Callable[[NetworkSettings, SceneFrame], Network]
    needs: Needs


ARCHITECTURES: dict[Architecture, Kind] = {
    "cnn": Kind(Cnn, Needs(points=False)),
    "feature_projection": Kind(FeatureProjection, Needs()),
    "light_transport": Kind(LightTransport, Needs()),
    "light_transport_photons": Kind(LightTransportPhotons, Needs(photons=True)),
    "guided": Kind(Guided, Needs(points=False, guides=True)),
    "guided_transport": Kind(partial(Guided, transport=True), Needs(guides=True)),
    "guided_photons": Kind(partial(Guided, photons=True), Needs(points=False, photons=True, guides=True)),
    "guided_transport_photons": Kind(partial(Guided, transport=True, photons=True), Needs(photons=True, guides=True)),
    "denoise_1": Kind(Denoiser, Needs(points=False, kept=1)),
    "denoise_4": Kind(Denoiser, Needs(points=False, kept=4)),
    "denoise_16": Kind(Denoiser, Needs(points=False, kept=16)),
    "denoise_32": Kind(Denoiser, Needs(points=False, kept=32)),
    "denoise_64": Kind(Denoiser, Needs(points=False, kept=64)),
}


def build(settings: NetworkSettings, frame: SceneFrame, seed: int) -> Network:
    """A freshly initialised network; the same weights for the same seed on one version of torch.

    Raises SpecError where the scene lacks what the architecture needs.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return ARCHITECTURES[settings.architecture].make(settings, frame)
