"""The networks by name, each with its needs; a user's own are named `MODULE:NAME`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from photonfarm.core.errors import SpecError
from photonfarm.trainer.networks.guided import Guided
from photonfarm.trainer.networks.guided_denoise import GuidedDenoise
from photonfarm.trainer.networks.inputs import Inputs, Needs, SceneFrame
from photonfarm.trainer.networks.lit_points import LitPoints
from photonfarm.trainer.networks.network import Network
from photonfarm.trainer.networks.paper_networks import (
    Cnn,
    Denoiser,
    FeatureProjection,
    LightTransport,
    LightTransportPhotons,
)
from photonfarm.trainer.runs import user_code
from photonfarm.trainer.runs.settings import NetworkSettings


@dataclass(frozen=True, slots=True)
class NetworkKind:
    """An architecture: the constructor of its network, and the inputs it reads."""

    make: Callable[[NetworkSettings, SceneFrame], Any]
    needs: Needs


ARCHITECTURES: dict[str, NetworkKind] = {
    "cnn": NetworkKind(Cnn, Needs(points=False)),
    "feature_projection": NetworkKind(FeatureProjection, Needs()),
    "light_transport": NetworkKind(LightTransport, Needs()),
    "light_transport_photons": NetworkKind(LightTransportPhotons, Needs(photons=True)),
    "guided": NetworkKind(Guided, Needs(points=False, guides=True)),
    "guided_transport": NetworkKind(partial(Guided, transport=LitPoints), Needs(guides=True)),
    "guided_photons": NetworkKind(partial(Guided, photons=True), Needs(points=False, photons=True, guides=True)),
    "guided_transport_photons": NetworkKind(
        partial(Guided, transport=LitPoints, photons=True), Needs(photons=True, guides=True)
    ),
    "guided_denoise": NetworkKind(GuidedDenoise, Needs(guides=True, kept=1, passes=True)),
    **{f"denoise_{kept}": NetworkKind(Denoiser, Needs(points=False, kept=kept)) for kept in (1, 4, 16, 32, 64)},
}


def find_kind(architecture: str) -> NetworkKind:
    """The architecture of a name. Raises SpecError for a user's own that cannot be loaded.

    Such a network is a subclass of `torch.nn.Module` with the arguments `NetworkSettings` and `SceneFrame`, whose
    `forward` takes `Inputs` and returns the image (B, H, W, 3), linear radiance × exposure. Its attribute `needs`, a
    `Needs`, states the inputs it reads beside camera and buffers; without it there are none.
    """
    if architecture in ARCHITECTURES:
        return ARCHITECTURES[architecture]
    make = user_code.load("architecture", architecture)
    if not (isinstance(make, type) and issubclass(make, nn.Module)):
        raise SpecError(f"architecture = {architecture!r}: is {make!r}; a subclass of torch.nn.Module is required")
    return NetworkKind(make, getattr(make, "needs", Needs(points=False)))


def find_needs(settings: NetworkSettings) -> Needs:
    """The inputs of a network with these settings. Raises SpecError as `find_kind` does."""
    needs = find_kind(settings.architecture).needs
    is_denoiser = needs.kept and not needs.guides
    return replace(needs, surface=True) if is_denoiser and settings.reflectance else needs


def build(settings: NetworkSettings, frame: SceneFrame, seed: int) -> Network:
    """A freshly initialised network; the same weights for the same seed on one version of torch.

    Raises SpecError if the scene lacks what the architecture needs, and as `find_kind` does.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        try:
            return find_kind(settings.architecture).make(settings, frame)
        except TypeError as error:
            if user_code.is_own(settings.architecture):
                raise SpecError(
                    f"architecture = {settings.architecture!r}: {error}; it is made from (settings, frame)"
                ) from error
            raise


def predict_image(network: nn.Module, inputs: Inputs) -> Tensor:
    """A network's image, (B, H, W, 3); SpecError if a user's network makes one of another shape."""
    image: Tensor = network(inputs)
    if image.shape != inputs.albedo.shape:
        name = f"{type(network).__module__}:{type(network).__qualname__}"
        raise SpecError(
            f"architecture = {name!r}: returns an image of shape {tuple(image.shape)}; (B, H, W, 3) = "
            f"{tuple(inputs.albedo.shape)} is required"
        )
    return image


@contextmanager
def name_misfit(run: Path, architecture: str) -> Iterator[None]:
    """Turn torch's refusal of a run's weights, as a network's code has changed, into a SpecError of one sentence."""
    try:
        yield
    except RuntimeError as error:
        if "loading state_dict" not in str(error):
            raise
        reason = str(error).splitlines()[-1].strip().rstrip(".")
        raise SpecError(
            f"{run}: its weights do not fit the network {architecture!r} as it is now ({reason}); "
            "bring back the code that it was trained with, or train anew in another folder"
        ) from error
