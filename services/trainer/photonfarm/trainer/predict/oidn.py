"""A denoiser that was trained elsewhere: Intel's Open Image Denoise, with the inputs of a trained one.

It takes colour, albedo and normals of one image, and its weights are part of the package `pyoidn` (the extra `oidn`),
whose binding has the flag for HDR. Dropped pixels are filled in first. Shape letters: B batch, H W image.
"""

from __future__ import annotations

from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from photonfarm.core.errors import SpecError
from photonfarm.core.records import F32
from photonfarm.trainer.networks.inputs import Inputs, given
from photonfarm.trainer.predict.fill_in import fill_in

PACKAGE = "pyoidn"


class Oidn:
    """Whole images from the kept pixels of half A, for a `DevicePredictor` that has `Needs(points=False, kept=k)`.

    It runs on the CPU, so that images do not depend on the machine's GPU. It is not thread-safe.
    """

    def __init__(self, threads: int = 1) -> None:
        """Load the library. Raises SpecError if the package is not installed or does not work here."""
        self._oidn = _package()
        self._device = self._oidn.Device(self._oidn.OIDN_DEVICE_TYPE_CPU)
        self._device.set_int("numThreads", threads)
        self._device.set_bool("setAffinity", False)  # renderers share the machine
        self._device.commit()
        self._check()

    def __call__(self, inputs: Inputs) -> Tensor:
        """A batch's images, (B, H, W, 3), linear radiance × exposure."""
        whole = fill_in(given(inputs.noisy), inputs.albedo)
        images = zip(whole.numpy(), inputs.albedo.numpy(), inputs.normal.numpy(), strict=True)
        return torch.from_numpy(np.stack([self.denoised(*image) for image in images]))

    def denoised(self, colour: F32, albedo: F32, normal: F32) -> F32:
        """One denoised image, (H, W, 3) each. Albedo and normals are taken as free of noise, which ours are."""
        result = np.empty_like(colour, order="C")
        named = {"color": colour, "albedo": np.clip(albedo, 0, 1), "normal": normal, "output": result}
        images = {name: np.ascontiguousarray(image) for name, image in named.items()}  # must live until it has run
        denoiser: Any = self._oidn.Filter(self._device, self._oidn.OIDN_FILTER_TYPE_RT)
        try:  # its own context manager would swallow exceptions
            for name, image in images.items():
                denoiser.set_image(name, image, self._oidn.OIDN_FORMAT_FLOAT3)
            denoiser.set_bool("hdr", True)
            denoiser.set_bool("cleanAux", True)
            denoiser.commit()
            denoiser.execute()
            self._check()
        finally:
            denoiser.release()
        return result

    def _check(self) -> None:
        if (error := self._device.get_error()) is not None:
            raise SpecError(f"the denoiser oidn: {PACKAGE} does not work here: {error}")


def _package() -> ModuleType:
    try:
        return import_module(PACKAGE)
    except (ImportError, OSError) as error:  # the latter if its library cannot be loaded
        raise SpecError(
            f"the denoiser oidn: needs the package {PACKAGE}, which cannot be imported ({error}); "
            "pip install photonfarm[oidn]"
        ) from error
