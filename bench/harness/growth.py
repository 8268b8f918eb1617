"""How a cost grows with a size: constant + factor · size ^ exponent, fitted to measured pairs.

The exponent is the slope of a straight line through the logarithms, once the constant is taken off. The constant is the
one, of many between 0 and the least cost, that leaves the line the least error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from photonfarm.trainer.metrics.image_metrics import t_975

FLAT = 1.5
"""A cost that does not even grow by this factor over all sizes counts as constant."""

SHARES = np.concatenate([[0.0], np.linspace(0.02, 0.98, 49)])
"""The constants that are tried, as shares of the least cost."""


@dataclass(frozen=True, slots=True)
class Growth:
    """A fitted cost."""

    constant: float
    factor: float
    exponent: float
    reach: float | None  # half the 95 % interval of the exponent; None: too few sizes

    @classmethod
    def of(cls, sizes: Sequence[float], costs: Sequence[float]) -> Growth:
        """The fit to costs at three or more sizes; raises ValueError for fewer."""
        if len(sizes) < 3:
            raise ValueError(f"{len(sizes)} sizes: at least 3 are required")
        x, y = np.log(np.asarray(sizes, float)), np.asarray(costs, float)
        if y.min() <= 0 or y.max() < FLAT * y.min():
            slope, _, _, reach = _line(x, np.log(np.maximum(y, 1e-12))) if y.min() > 0 else (0.0, 0.0, 0.0, None)
            return cls(float(y.mean()), 0.0, slope, reach)
        fits = [(share * y.min(), *_line(x, np.log(y - share * y.min()))) for share in SHARES]
        constant, slope, offset, _, reach = min(fits, key=lambda fit: _error(x, y, fit[0], fit[1], fit[2]))
        return cls(float(constant), float(np.exp(offset)), slope, reach)

    def at(self, size: float) -> float:
        """The cost at a size."""
        return self.constant + self.factor * size**self.exponent if self.factor else self.constant

    def size_of(self, cost: float) -> float:
        """The size that has a cost; infinite if none has."""
        if not self.factor or self.exponent <= 0:
            return float("inf") if cost >= self.constant else 0.0
        return float(max((cost - self.constant) / self.factor, 0.0) ** (1 / self.exponent))

    def __str__(self) -> str:
        """The exponent with its interval."""
        return f"{self.exponent:.2f}" + ("" if self.reach is None else f" ± {self.reach:.2f}")


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float, float, float | None]:
    """Slope, offset, sum of squares left, and half the 95 % interval of the slope, of the line of least squares."""
    centred = x - x.mean()
    slope = float(centred @ y / (centred @ centred))
    offset = float(y.mean() - slope * x.mean())
    left = float(((y - offset - slope * x) ** 2).sum())
    freedom = len(x) - 2
    return slope, offset, left, t_975(freedom) * float(np.sqrt(left / freedom / (centred @ centred)))


def _error(x: np.ndarray, y: np.ndarray, constant: float, slope: float, offset: float) -> float:
    """The sum of squared relative errors of a fit, by logarithms of whole costs."""
    return float(((np.log(constant + np.exp(offset + slope * x)) - np.log(y)) ** 2).sum())
