"""Denoisers that are ready without training on the scene; they get the same inputs as the trained ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from photonfarm.trainer.networks.inputs import Inputs, Needs, given
from photonfarm.trainer.predict.evaluation import DevicePredictor
from photonfarm.trainer.predict.fill_in import fill_in
from photonfarm.trainer.runs.settings import ReadyDenoiser, TrainSettings


@dataclass(frozen=True, slots=True)
class ReadyPredictor:
    """A denoiser that is given one of `kept` pixels of half A."""

    denoiser: ReadyDenoiser
    kept: int
    settings: TrainSettings  # for reading samples

    @property
    def name(self) -> str:
        """A name such as "oidn 1/4"."""
        return f"{self.denoiser} 1/{self.kept}"

    @property
    def needs(self) -> Needs:
        """The noisy colour, beside the buffers."""
        return Needs(points=False, kept=self.kept)

    def predictor(self, *_: object) -> DevicePredictor:
        """The predictor, on the CPU, whatever the scene and the device. Raises SpecError if a package is missing."""
        return DevicePredictor(self._images(), torch.device("cpu"))

    def _images(self) -> Callable[[Inputs], Tensor]:
        if self.denoiser == "none":
            return lambda inputs: given(inputs.noisy).colour
        if self.denoiser == "fill-in":
            return lambda inputs: fill_in(given(inputs.noisy), inputs.albedo)
        from photonfarm.trainer.predict.oidn import Oidn

        return Oidn(self.settings.threads)
