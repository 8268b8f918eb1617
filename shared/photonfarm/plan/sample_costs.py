"""What samples of a scene cost on a machine, and how noisy they are: `photonfarm scene cost` measures it.

Services without a renderer read it as JSON.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Annotated, Self

import numpy as np
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from photonfarm.core.errors import StoreError
from photonfarm.core.models import sentences
from photonfarm.core.records import F32

BLOCK = 8
"""The side, in pixels, of the blocks over which local brightness is averaged; film sizes are divisible by it."""

FLOOR = 0.1
"""The least brightness of a pixel, as a share of the image's mean, so that black corners do not dominate."""

SECONDS = ("configuration_s", "view_s", "pass_s", "spp_s")


Cost = Annotated[float, Field(ge=0, allow_inf_nan=False, strict=True)]


@dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid"))
class SampleCosts:
    """Core-seconds on one machine, and noise: medians over some views, each of a configuration of its own.

    They leave out storing samples, and what a worker does once. Raises ValueError for numbers that are negative or not
    finite.
    """

    scene_id: str
    configuration_s: Cost  # bringing the scene into a new configuration, with its photons traced
    view_s: Cost  # a view's buffers and guides, and which points and photons it sees
    pass_s: Cost  # a pass of a view, both halves, whatever its number of samples per pixel
    spp_s: Cost  # each sample per pixel of the whole image, of both halves together
    relative_variance: Cost  # as `relative_variance` estimates it; 0 if every view was black
    guides_s: Cost = 0.0  # the guides' part of `view_s`

    def seconds(self, spp: float, *, configurations: float, views: float, samples: float) -> float:
        """Core-seconds of samples of `spp` samples per pixel, both halves together; each is a pass of a view.

        A configuration is charged once: where its samples lie in several jobs, each of these pays for it again.
        """
        of_samples = samples * (self.pass_s + spp * self.spp_s)
        return configurations * self.configuration_s + views * self.view_s + of_samples

    def json(self) -> str:
        """All fields as JSON, for `read`."""
        return json.dumps(asdict(self), indent=1)

    def line(self) -> str:
        """All fields in words."""
        times = " + ".join(f"{name.removesuffix('_s')} {getattr(self, name):.4f} s" for name in SECONDS)
        noise = f"relative variance of one sample per pixel {self.relative_variance:.3g}"
        return f"{times} × samples per pixel; guides {self.guides_s:.4f} s of a view; {noise}"

    @classmethod
    def read(cls, text: str | bytes) -> Self:
        """The costs that `json` wrote; raises StoreError for anything else."""
        try:
            return TypeAdapter(cls).validate_json(text)
        except ValidationError as error:
            raise StoreError(
                f"{text[:60]!r}: are no sample costs that `photonfarm scene cost --json` wrote "
                f"({'; '.join(sentences(error))}); measure again with `photonfarm scene cost SPEC --again`"
            ) from error


def relative_variance(half_a: F32, half_b: F32, spp: float) -> float | None:
    """Variance of a pixel's mean at one sample per pixel over its squared local brightness, mean over pixels.

    `half_a` and `half_b` (H, W, 3) are independent, with `spp` samples per pixel together; H and W are multiples of
    8. (A − B)²/4 is the variance of (A + B)/2 in expectation, and `spp` times that the variance of one sample, as far
    as samples are independent; those of one half are stratified, so that it falls as they get more. It is taken
    relative to b² + (0.1 g)², b the mean of (A + B)/2 over the pixel's block of 8 × 8 and over channels, g over the
    image, as the trainer's losses weigh errors by brightness; so any factor on radiance cancels. Returns None for a
    black image.
    """
    a, b = half_a.astype(np.float64), half_b.astype(np.float64)
    blocks = (a.shape[0] // BLOCK, BLOCK, a.shape[1] // BLOCK, BLOCK)
    bright = ((a + b) / 2).mean(axis=-1).reshape(blocks).mean(axis=(1, 3), keepdims=True)
    if not bright.any():
        return None
    variance = spp * ((a - b) ** 2 / 4).mean(axis=-1).reshape(blocks)
    return float(np.mean(variance / (bright**2 + (FLOOR * bright.mean()) ** 2)))
