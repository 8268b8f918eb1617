"""How to spend core-seconds on training samples: on configurations, on views of each, or on samples per pixel.

This is optimum allocation in multistage sampling (W. G. Cochran, Sampling Techniques, 3rd ed. 1977, ch. 10), with
configurations as first stage, their views as second, and the noisy light paths of a view as third. Of a training
set of M configurations, V views of each, and P passes of s samples per pixel of each view, the held-out error beyond
that of endless data, its excess, is taken to follow

    excess = ρ/M + (1 + ν/(κ·P·s)) / (M·V)

in units of what one noise-free view leaves: ν is the relative variance of one sample per pixel
(`sample_costs.relative_variance`), κ how much the network averages it away, ρ how much configurations differ beside
their views. A configuration with its views costs

    c = c_configuration + V·(c_view + P·(c_pass + c_spp·s)).

**The best s.** A budget B pays for M = B/c configurations, so that excess·B = (α + β/n)·(γ + δ·n), where n = P·s,
α = ρ + 1/V, β = ν/(κ·V), γ = c_configuration + V·(c_view + P·c_pass) and δ = V·c_spp. Its derivative δα − βγ/n² is
0 at n* = √(βγ/(αδ)), which with c₀ = γ/V, the cost of a view that does not grow with s, is

    s* = n*/P = √(c₀·ν / (κ·c_spp·(1 + ρ·V))) / P.

**Passes.** The excess depends on P and s by n alone, while P passes pay c_pass P times: one pass of n samples is
never worse. Passes are for top-ups of what is there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Self

from photonfarm.plan.sample_costs import SampleCosts

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


def seconds(costs: SampleCosts, of: Allocation) -> float:
    """The core-seconds of an allocation."""
    views = of.modifications * of.views
    return costs.seconds(of.spp, configurations=of.modifications, views=views, samples=views * of.passes)


def excess(noise: float, of: Allocation, *, kappa: float = KAPPA, rho: float = RHO) -> float:
    """The excess of the held-out error in the module's units; `noise`: relative variance at 1 sample per pixel."""
    of_view = 1 + noise / (kappa * of.passes * of.spp)
    return (rho + of_view / of.views) / of.modifications


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
        return seconds(self.costs, of)

    def excess(self, of: Allocation) -> float:
        """The predicted excess of the held-out error."""
        return excess(self.costs.relative_variance, of, kappa=self.kappa, rho=self.rho)

    def best_spp(self, views: int, passes: int = 1) -> float:
        """s*: the samples per pixel of a pass with the least excess at a fixed budget, as a real number.

        Infinite where samples cost nothing, 0 where there is no noise.
        """
        costs = self.costs
        besides = costs.configuration_s / views + costs.view_s + passes * costs.pass_s
        gained, paid = besides * costs.relative_variance, self.kappa * costs.spp_s * (1 + self.rho * views)
        if not gained:
            return 0.0
        return math.sqrt(gained / paid) / passes if paid else math.inf

    def best(self, budget_s: float) -> Allocation:
        """The allocation of least excess within a budget of core-seconds, among those of `_affordable`.

        Of equal ones, that with fewer views is taken, then that with fewer samples per pixel. Raises ValueError if the
        budget pays for none.
        """
        found = list(self._affordable(budget_s))
        if not found:
            raise ValueError(f"budget_s is {budget_s}; one view of 2 spp costs {self.seconds(Allocation(1, 1, 1, 2))}")
        return min(found, key=self.excess)

    def improve(self, asked: Allocation) -> tuple[float, Allocation]:
        """The share of `asked`'s excess that the best allocation of the same cost saves, ≥ 0, and that allocation."""
        found = self.best(self.seconds(asked))
        return max(0.0, 1 - self.excess(found) / self.excess(asked)), found

    def _affordable(self, budget_s: float) -> Iterator[Allocation]:
        """One pass of 2, 4, 8 … 1024 spp for each number of views, with all configurations that the budget pays for."""
        for views in range(1, self.most_views + 1):
            for spp in (2**power for power in range(1, MOST_SPP.bit_length())):
                one = self.seconds(Allocation(1, views, 1, spp))
                count = int(budget_s / one * (1 + 1e-9)) if one else 0  # rounding must not lose one
                if count:
                    yield Allocation(count, views, 1, spp)
