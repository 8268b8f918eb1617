"""Denoisers that need no training: dropped pixels filled in from kept ones, and Intel's Open Image Denoise.

Filling in is a normalised convolution [Knutsson and Westin, 1993] of demodulated colour. With kept pixels m ∈ {0, 1},
colour c, a Gaussian g, and a divisor d that is the albedo where a surface has one and 1 elsewhere, a dropped pixel p
becomes

d(p) · Σ_q g(p − q) m(q) c(q) / Σ_q g(p − q) m(q) d(q)

in each channel, over those q that have an albedo if p has one, and over the others if not. So light on a texture,
c = d · E, is reproduced exactly wherever E is constant, and so is a constant image of a constant albedo; a lamp, whose
albedo is 0, does not bleed into the wall beside it. It is a ratio of sums instead of a mean of ratios: dark surfaces,
whose ratios are noisiest, count the least. Kept pixels do not change.

Open Image Denoise takes colour, albedo and normals of one filled-in image. Its weights are part of the package
`mitsuba-oidn` (the extra `oidn`), which uses Dr.Jit's threads, and neither Dr.Jit nor Mitsuba otherwise.

Shape letters: B batch, H W image.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from importlib import import_module
from types import ModuleType

import torch
from torch import Tensor
from torch.nn import functional

from photonfarm.core.errors import SpecError
from photonfarm.trainer.networks.inputs import Inputs, NoisyColour, require
from photonfarm.trainer.runs.settings import OidnQuality

LEAST_ALBEDO = 0.01
"""The albedo below which a channel counts as having none: lamps, mirrors, glass, and the sky."""

SPREAD = 0.6
"""σ of the Gaussian over the mean distance √k between kept pixels; on `room` 0.5 … 0.75 do better than 0.35 or 1."""

REACH = 3
"""The radius at which the Gaussian is cut off, in σ."""


def fill_in(noisy: NoisyColour, albedo: Tensor) -> Tensor:
    """Whole images, (B, H, W, 3), linear radiance × exposure, from the kept pixels and the albedo, (B, H, W, 3).

    A pixel without a kept one of its kind in reach takes a wider Gaussian, and if the image has none of its kind, all
    of them; an image without kept pixels stays black.
    """
    kept = noisy.kept[..., None].to(noisy.colour)
    has_albedo = albedo >= LEAST_ALBEDO
    divisor = torch.where(has_albedo, albedo, 1)
    filled, open_ = noisy.colour, ~noisy.kept[..., None].expand_as(noisy.colour)
    sigma = SPREAD / math.sqrt(max(float(kept.mean()), 1 / kept[0].numel()))
    side = max(kept.shape[1:3])
    while bool(open_.any()) and sigma < 2 * side:
        for kind in (has_albedo, ~has_albedo):
            filled, open_ = _fill(filled, open_ & kind, open_, noisy.colour, kept * kind, divisor, sigma)
        sigma *= 2
    everything, one = kept.expand_as(divisor), torch.ones_like(divisor)
    return _fill(filled, open_, open_, noisy.colour, everything, one, sigma)[0]


def _fill(
    image: Tensor, wanted: Tensor, open_: Tensor, colour: Tensor, weight: Tensor, divisor: Tensor, sigma: float
) -> tuple[Tensor, Tensor]:
    """The image with the wanted pixels filled in as far as kept ones reach, and those still open; (B, H, W, 3) all."""
    if not bool(wanted.any()):
        return image, open_
    light, surface = (_blur(weight * values, sigma) for values in (colour, divisor))
    done = wanted & (surface > 0)
    return torch.where(done, divisor * light / torch.where(done, surface, 1), image), open_ & ~done


def _blur(image: Tensor, sigma: float) -> Tensor:
    """The sum over a Gaussian window around each pixel, (B, H, W, 3); zero beyond the border."""
    reach = math.ceil(REACH * sigma)
    window = torch.exp(-0.5 * (torch.arange(-reach, reach + 1).to(image) / sigma) ** 2)
    planes = image.movedim(-1, 1).flatten(0, 1)[:, None]  # (3 B, 1, H, W)
    planes = functional.conv2d(planes, window[None, None, :, None], padding=(reach, 0))
    planes = functional.conv2d(planes, window[None, None, None, :], padding=(0, reach))
    return planes.reshape(len(image), 3, *image.shape[1:3]).movedim(1, -1)


OIDN: Mapping[str, OidnQuality] = {
    "oidn": "high",
    "oidn-balanced": "balanced",
    "oidn-fast": "fast",
    "oidn-reflectance": "high",
    "oidn-balanced-reflectance": "balanced",
    "oidn-fast-reflectance": "fast",
}
"""The qualities by the names of the denoisers."""

PACKAGE = "mitsuba_oidn"


class Oidn:
    """Whole images from the kept pixels of half A, for a `DevicePredictor` that has `Needs(points=False, kept=k)`.

    It runs where its inputs are: on the CPU, or on a card, without a copy. It is not thread-safe.
    """

    def __init__(self, threads: int = 1, device: str | torch.device = "cpu", quality: OidnQuality = "high") -> None:
        """Load the library; `threads` are the CPU's.

        Raises ModuleNotFoundError if the package is not installed, SpecError if it does not work on this device.
        """
        place, self._oidn = torch.device(device), _import_package()
        self._quality = self._oidn.Quality[quality.capitalize()]
        try:
            if place.type == "cuda":
                stream = torch.cuda.current_stream(place)
                self._device = self._oidn.Device.cuda(stream.device.index, stream.cuda_stream)
            else:
                self._device = self._oidn.Device(self._oidn.DeviceType.CPU)
                self._device.num_threads = threads
                self._device.set_bool("setAffinity", False)  # renderers share the machine
            self._device.commit()
        except self._oidn.Error as error:
            raise SpecError(
                f"the denoiser oidn: {PACKAGE} does not work on {place}: {error}; leave the denoiser out"
                + (", or give --device cpu" if place.type == "cuda" else "")
            ) from error

    def __call__(self, inputs: Inputs) -> Tensor:
        """A batch's images, (B, H, W, 3), linear radiance × exposure."""
        albedo = inputs.reflects
        images = zip(fill_in(require(inputs.noisy), albedo), albedo, inputs.normal, strict=True)
        return torch.stack([self.denoise(*image) for image in images])

    def denoise(self, colour: Tensor, albedo: Tensor, normal: Tensor) -> Tensor:
        """One denoised image; (H, W, 3) float32 on the device each. Albedo and normals are taken as free of noise."""
        guides = (image.contiguous() for image in (albedo.clamp(0, 1), normal))
        result: Tensor = self._oidn.denoise(
            colour.contiguous(),
            *guides,
            hdr=True,
            clean_aux=True,
            quality=self._quality,
            device=self._device,
            output=torch.empty_like(colour, memory_format=torch.contiguous_format),
        )
        return result


def _import_package() -> ModuleType:
    try:
        return import_module(PACKAGE)
    except ModuleNotFoundError:
        raise  # the command line names the extra that brings it
    except (ImportError, OSError) as error:
        raise SpecError(f"{PACKAGE}: its library cannot be loaded: {error}; leave the denoiser out") from error
