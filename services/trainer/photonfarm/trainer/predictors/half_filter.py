"""A denoiser's images of noisy halves, for networks that are given both: made once a sample, and kept beside the run.

They are a function of the half, of what surfaces reflect and of normals, and of the denoiser's version and quality,
which name their folder. They are no part of the store, whose samples nothing has denoised.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from photonfarm.core.errors import store_errors
from photonfarm.core.files import whole_file
from photonfarm.core.keys import Key
from photonfarm.trainer.data.batch import TrainingBatch
from photonfarm.trainer.networks import find_kind
from photonfarm.trainer.networks.inputs import Inputs, NoisyColour, replace_albedo, require
from photonfarm.trainer.predictors.denoisers import OIDN, PACKAGE, Oidn
from photonfarm.trainer.runs.settings import TrainSettings

FOLDER = "filtered"
"""Where the images of a run's halves are, in its folder."""


def uses_denoiser(settings: TrainSettings) -> bool:
    """Whether a run's network is given halves that a denoiser has filtered."""
    return find_kind(settings.network.architecture).needs.passes and settings.network.filter in OIDN


def settle_filter(settings: TrainSettings) -> TrainSettings:
    """The settings with the denoiser named that is there, where they leave that open to a network of halves."""
    network = settings.network
    if network.filter != "auto" or not find_kind(network.architecture).needs.passes:
        return settings
    chosen = "own" if find_spec(PACKAGE) is None else "oidn"
    return settings.model_copy(update={"network": network.model_copy(update={"filter": chosen})})


class HalfFilter:
    """A denoiser of the halves that a network is given. Not thread-safe, as the denoiser is not."""

    def __init__(self, settings: TrainSettings, device: str | torch.device = "cpu", run: Path | None = None) -> None:
        """Load the denoiser that the settings name, and keep images in the folder of a `run`.

        Raises SpecError if it is not installed, or does not work on this device.
        """
        name = settings.network.filter
        self._oidn = Oidn(settings.threads, device, OIDN[name])
        self._folder = None if run is None else run / FOLDER / f"{name}-{version(PACKAGE)}"

    def __call__(self, inputs: Inputs) -> Inputs:
        """The inputs with the half filtered; as they are if it is."""
        noisy = require(inputs.noisy)
        if noisy.filtered is not None:
            return inputs
        return replace(inputs, noisy=replace(noisy, filtered=self._denoise(inputs, [noisy])[:, 0]))

    def filter_both(self, batch: TrainingBatch, keys: Sequence[Key]) -> TrainingBatch:
        """A batch on the processor, of the samples of these keys, with both halves filtered.

        Raises StoreError where the images cannot be kept.
        """
        halves = [require(batch.inputs.noisy), require(batch.other)]
        found = [self._read(key, halves[0].colour.shape[1:]) for key in keys]
        if any(images is None for images in found):
            made = self._denoise(batch.inputs, halves)
            for place, key in enumerate(keys):
                if found[place] is None:
                    found[place] = made[place]
                    self._write(key, made[place])
        images = torch.stack([require(each) for each in found])
        a, b = (replace(half, filtered=images[:, place]) for place, half in enumerate(halves))
        return replace(batch, inputs=replace(batch.inputs, noisy=a), other=b)

    def _denoise(self, inputs: Inputs, halves: Sequence[NoisyColour]) -> Tensor:
        """The images of some halves of each sample, (B, n, H, W, 3)."""
        albedo = replace_albedo(inputs.albedo, require(inputs.guides))
        return torch.stack(
            [
                torch.stack([self._oidn.denoise(half.colour[place], *surfaces) for half in halves])
                for place, surfaces in enumerate(zip(albedo, inputs.normal, strict=True))
            ]
        )

    def _file(self, key: Key) -> Path:
        return require(self._folder) / f"{key.hex()}.npy"

    def _read(self, key: Key, shape: torch.Size) -> Tensor | None:
        if self._folder is None:
            return None
        try:
            images = np.load(self._file(key))
        except (OSError, ValueError, EOFError):
            return None  # not there, or cut short by a machine that failed
        return torch.from_numpy(images) if images.shape == (2, *shape) else None

    def _write(self, key: Key, images: Tensor) -> None:
        if self._folder is not None:
            with store_errors("keep filtered images", self._folder), whole_file(self._file(key)) as part:
                np.save(part, images.numpy())


def choose_filter(settings: TrainSettings, run: Path) -> Callable[[TrainingBatch, Sequence[Key]], TrainingBatch] | None:
    """What filters the halves of batches for a run, before its network sees them; None if nothing is to."""
    return HalfFilter(settings, run=run).filter_both if uses_denoiser(settings) else None
