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

The excess depends on P and s by P·s alone, while P passes pay c_pass P times: one pass of P·s samples is never worse.
Passes are for top-ups of what is there.
"""

from __future__ import annotations

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
