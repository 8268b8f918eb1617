"""How much of a change between two images of a view is explained by another: R², the noise of both taken out.

Shape letters: H W image, N views, R replicates of a bootstrap, S seeds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.harness.network_errors import F64, Errors, replicates, within
from photonfarm.core.keys import Key


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """What changes in N views, Δ in the metric space."""

    halves: F64  # (N, 2, H, W, 3) by half A, and by half B
    stays: NDArray[np.bool_]  # (N, H, W) pixels that show one surface in both
    units: tuple[Key, ...]

    def left(self, predicted: F64) -> F64:
        """What predicted changes p (N, H, W, 3) leave, (2, N): Σ (p − Δ_A)(p − Δ_B) over whole images, and what stays.

        Both as shares of the pixels of the whole image. The noise of the halves multiplies to nothing.
        """
        product = ((predicted - self.halves[:, 0]) * (predicted - self.halves[:, 1])).mean(axis=-1)
        return np.stack([product.mean(axis=(1, 2)), (product * self.stays).mean(axis=(1, 2))])

    def there(self) -> tuple[Errors, Errors]:
        """Σ Δ_A Δ_B likewise: what is left by a prediction that does not change."""
        whole, same = self.left(np.zeros_like(self.halves[:, 0]))
        return Errors(whole[None], self.units), Errors(same[None], self.units)


@dataclass(frozen=True, slots=True, eq=False)
class Explained:
    """How much of a change is explained, R² = 1 − Σ (p − Δ)² / Σ Δ², of networks from each seed."""

    left: Errors  # (S, N)
    there: Errors  # (1, N)

    @property
    def share(self) -> float:
        """R², the mean over seeds; −∞ where nothing changes beyond the noise."""
        return float(_share(self.left.of_seeds().mean(), self.there.of_seeds().mean()))

    def of_seeds(self) -> F64:
        """R² of each seed, (S,)."""
        return _share(self.left.of_seeds(), self.there.of_seeds())

    def interval(self) -> tuple[float, float]:
        """95 % of R² over configurations, which are drawn anew for both sums at once; for these networks."""
        return within(_share(*replicates([self.left, self.there], spread=0.0).T))


def _share(left: Any, there: Any) -> F64:
    """1 − left / there; −∞ where nothing is there."""
    is_there = np.greater(there, 0)
    return np.where(is_there, 1 - left / np.where(is_there, there, 1.0), -np.inf)
