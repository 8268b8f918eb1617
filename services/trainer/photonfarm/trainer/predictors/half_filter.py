"""A denoiser's images of noisy halves, for networks that are given both: made once a half, and kept beside the run.

They are a function of the half, of what surfaces reflect and of normals, whose digest is their name, and of the
denoiser's version and quality, which name their folder. They are no part of the store, whose samples nothing has
denoised.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from photonfarm.core.errors import store_errors
from photonfarm.core.files import whole_file
from photonfarm.trainer.data.batch import TrainingBatch
from photonfarm.trainer.networks import find_kind
from photonfarm.trainer.networks.inputs import Inputs, NoisyColour, replace_albedo, require
from photonfarm.trainer.predictors.denoisers import OIDN, PACKAGE, Oidn
from photonfarm.trainer.runs import checkpoint
from photonfarm.trainer.runs.run_folder import CHECKPOINT
from photonfarm.trainer.runs.settings import TrainSettings

FOLDER = "filtered"
"""Where the images of a run's halves are, in its folder."""


def uses_denoiser(settings: TrainSettings) -> bool:
    """Whether a run's network is given halves that a denoiser has filtered."""
    return find_kind(settings.network.architecture).needs.passes and settings.network.has_denoiser


def settle_filter(settings: TrainSettings, run: Path | None = None) -> TrainSettings:
    """The settings with the filter named, if they leave it open to a network of halves; else as they are.

    It is the one that the `run` was begun with, or the run that it starts from, or else what is installed. Raises
    StoreError for an unreadable checkpoint.
    """
    network = settings.network
    if network.filter != "auto" or not find_kind(network.architecture).needs.passes:
        return settings
    chosen = "own" if find_spec(PACKAGE) is None else "oidn"
    before = next((each for each in (run, settings.start_from) if each and Path(each, CHECKPOINT).exists()), None)
    if before is not None:
        begun = checkpoint.load(Path(before, CHECKPOINT))["settings"]["network"]
        chosen = begun["filter"] if begun.get("filter", "auto") != "auto" else chosen
    return settings.model_copy(update={"network": network.model_copy(update={"filter": chosen})})


class HalfFilter:
    """A denoiser of the halves that a network is given. Not thread-safe, as the denoiser is not."""

    def __init__(self, settings: TrainSettings, device: str | torch.device = "cpu", run: Path | None = None) -> None:
        """Load the denoiser that the settings name, and keep images in the folder of a `run`.

        Raises what `Oidn` does.
        """
        name = settings.network.filter
        self._oidn = Oidn(settings.threads, device, OIDN[name])
        self._folder = None if run is None else run / FOLDER / f"{name}-{version(PACKAGE)}"

    def __call__(self, inputs: Inputs) -> Inputs:
        """The inputs with the half filtered; as they are if it is."""
        noisy = require(inputs.noisy)
        return inputs if noisy.filtered is not None else replace(inputs, noisy=self._filter(inputs, noisy))

    def filter_both(self, batch: TrainingBatch) -> TrainingBatch:
        """A batch on the processor with both halves filtered. Raises StoreError where the images cannot be kept."""
        a, b = (self._filter(batch.inputs, require(half)) for half in (batch.inputs.noisy, batch.other))
        return replace(batch, inputs=replace(batch.inputs, noisy=a), other=b)

    def _filter(self, inputs: Inputs, half: NoisyColour) -> NoisyColour:
        """A half of each sample with its image."""
        surfaces = replace_albedo(inputs.albedo, require(inputs.guides)), inputs.normal
        images = [self._find_image(*given) for given in zip(half.colour, *surfaces, strict=True)]
        return replace(half, filtered=torch.stack(images))

    def _find_image(self, *given: Tensor) -> Tensor:
        """The denoiser's image of colour, albedo and normals, (H, W, 3): a kept one if there is one, or a new one."""
        if self._folder is None:
            return self._oidn.denoise(*given)
        digest = hashlib.sha256()
        for image in given:
            digest.update(image.numpy().tobytes())
        file = self._folder / f"{digest.hexdigest()}.npy"
        try:
            image = torch.from_numpy(np.load(file))
            if image.shape == given[0].shape:
                return image
        except (OSError, ValueError, EOFError):
            pass  # not there, or cut short by a machine that failed
        image = self._oidn.denoise(*given)
        with store_errors("keep filtered images", self._folder), whole_file(file) as part:
            np.save(part, image.numpy())
        return image


def choose_filter(settings: TrainSettings, run: Path) -> Callable[[TrainingBatch], TrainingBatch] | None:
    """What filters the halves of batches for a run, before its network sees them; None if nothing is to."""
    return HalfFilter(settings, run=run).filter_both if uses_denoiser(settings) else None
