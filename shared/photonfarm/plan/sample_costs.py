"""What samples of a scene cost, how noisy they are, and how a budget of core-seconds is best spent on them.

`photonfarm scene cost` measures costs and noise; services without a renderer read them as JSON.

The budget goes to configurations, to views of each, or to samples per pixel. This is optimum allocation in multistage
sampling (W. G. Cochran, Sampling Techniques, 3rd ed. 1977, ch. 10), with configurations as first stage, their views as
second, and the noisy light paths of a view as third. Of a training set of M configurations, V views of each, and P
passes of s samples per pixel of each view, the held-out error beyond that of endless data, its excess, is taken to
follow

    excess = ρ/M + (1 + ν/(κ·P·s)) / (M·V)

in units of what one noise-free view leaves: ν is the relative variance of one sample per pixel, κ how much the network
averages it away, ρ how much configurations differ beside their views. A configuration with its views costs

    c = c_configuration + V·(c_view + P·(c_pass + c_spp·s)).

A budget B pays for M = B/c configurations, so that excess·B = (α + β/s)·(γ + δ·s) with P = 1, α = ρ + 1/V, β = ν/(κ·V),
γ = V·c₀ and δ = V·c_spp, where c₀ is the cost of a view that does not grow with s. It is least at
s* = √(βγ/(αδ)) = √(c₀·ν / (κ·c_spp·(1 + ρ·V))). P passes pay c_pass P times for what one pass of P·s samples gives as
well: passes are for top-ups of what is there.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, replace
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
    guides_s: Cost = 0.0  # of guides and buffers, part of `view_s`

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
        return f"{times} × samples per pixel; guides and buffers {self.guides_s:.4f} s of a view; {noise}"

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


KAPPA = 0.34
"""κ, how much of the noise the network averages away over pixels and views: fitted to `light_transport`, preset
`small`, in two rooms (docs/results/noise_budget.md). Its 95 % range is 1.6 and less, down to the end of what was
searched.
"""

RHO = 1.8
"""ρ, how much configurations differ beside what their views show: fitted with κ; its range is 0.43 … 8.7."""

MOST_SPP, MOST_VIEWS = 1024, 16
"""The largest samples per pixel and views per configuration that `CostModel.best` considers."""


@dataclass(frozen=True, slots=True)
class Allocation:
    """A number of configurations, of views and passes of each, and of samples per pixel."""

    modifications: int  # configurations, M
    views: int  # of each configuration, V
    passes: int  # of each view, P
    spp: int  # samples per pixel of a pass, both halves together, s: twice a spec's half_spp

    @property
    def samples(self) -> int:
        """The number of samples, M·V·P."""
        return self.modifications * self.views * self.passes


@dataclass(frozen=True, slots=True)
class CostModel:
    """The costs of a scene's samples, and the constants of its predicted error."""

    costs: SampleCosts
    kappa: float = KAPPA
    rho: float = RHO
    most_views: int = MOST_VIEWS  # per configuration, that `best` considers

    @classmethod
    def of(cls, costs: SampleCosts, *, static: bool) -> Self:
        """The cost model of a scene whose costs were measured.

        A static scene has one configuration, which is paid for once and causes no error. Its views are the first stage,
        and an allocation counts them as configurations of one view.
        """
        return cls(replace(costs, configuration_s=0.0), rho=0.0, most_views=1) if static else cls(costs)

    def seconds(self, of: Allocation) -> float:
        """The core-seconds of an allocation."""
        views = of.modifications * of.views
        return self.costs.seconds(of.spp, configurations=of.modifications, views=views, samples=views * of.passes)

    def excess(self, of: Allocation) -> float:
        """The predicted excess of the held-out error, in the module's units."""
        of_view = 1 + self.costs.relative_variance / (self.kappa * of.passes * of.spp)
        return (self.rho + of_view / of.views) / of.modifications

    def best(self, budget_s: float) -> Allocation:
        """The allocation of least excess within a budget of core-seconds, among those of `_affordable`.

        Of equal ones, that with fewer views is taken, then that with fewer samples per pixel. Raises ValueError if the
        budget pays for none.
        """
        affordable = list(self._affordable(budget_s))
        if not affordable:
            raise ValueError(f"budget_s is {budget_s}; one view of 2 spp costs {self.seconds(Allocation(1, 1, 1, 2))}")
        return min(affordable, key=self.excess)

    def improve(self, asked: Allocation) -> tuple[float, Allocation]:
        """The share of `asked`'s excess that the best allocation of the same cost saves, ≥ 0, and that allocation."""
        best = self.best(self.seconds(asked))
        return max(0.0, 1 - self.excess(best) / self.excess(asked)), best

    def _affordable(self, budget_s: float) -> Iterator[Allocation]:
        """One pass of 2, 4, 8 … 1024 spp for each number of views, with all configurations that the budget pays for."""
        for views in range(1, self.most_views + 1):
            for spp in (2**power for power in range(1, MOST_SPP.bit_length())):
                one = self.seconds(Allocation(1, views, 1, spp))
                count = int(budget_s / one * (1 + 1e-9)) if one else 0  # rounding must not lose one
                if count:
                    yield Allocation(count, views, 1, spp)
