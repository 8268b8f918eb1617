"""How much of the measured errors the allocation's model explains, and its constants κ and ρ.

`photonfarm.plan.allocation` has the model. Each room has an error a that endless data would leave and a scale b
of the excess above it; κ and ρ are common to all.

Shape letters: A arms of a room, G places of the grid, R replicates of the bootstrap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Self

import numpy as np

from bench.harness.network_errors import F64, Errors, own_errors, replicates, within
from photonfarm.plan.allocation import Allocation, excess

KAPPAS = np.geomspace(0.1, 3000, 60)
RHOS = np.concatenate([[0.0], np.geomspace(0.03, 30, 40)])
REPLICATES = 1000


@dataclass(frozen=True, slots=True, eq=False)
class RoomErrors:
    """Mean held-out errors of a room's arms."""

    name: str
    noise: float  # relative, at one sample per pixel
    allocations: tuple[Allocation, ...]
    errors: F64  # (A,)
    own_errors: F64  # (A,) their standard errors, without what the arms have in common
    replicates: F64  # (R, A) errors that other configurations and seeds might have given

    @classmethod
    def of(cls, name: str, noise: float, arms: Sequence[tuple[Allocation, Errors]], seed: int) -> Self:
        """What networks of each allocation have made; a `seed` of its own makes rooms' replicates independent."""
        allocations, errors = zip(*arms, strict=True)
        means = np.array([of.estimate().mean for of in errors])
        return cls(name, noise, allocations, means, own_errors(errors), replicates(errors, REPLICATES, seed))

    def best(self) -> tuple[int, F64]:
        """The arm of least error, and of each the share of replicates in which it has the least, (A,)."""
        won = np.bincount(self.replicates.argmin(axis=1), minlength=len(self.errors))
        return int(np.argmin(self.errors)), won / len(self.replicates)


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """The constants that fit best, and those of each replicate."""

    kappa: float
    rho: float
    levels: dict[str, tuple[float, float]]  # a and b of each room
    chi2: float
    freedom: int
    kappas: F64  # (R,)
    rhos: F64  # (R,)

    @property
    def constants(self) -> list[tuple[float, float]]:
        """κ and ρ of each replicate."""
        return [(float(kappa), float(rho)) for kappa, rho in zip(self.kappas, self.rhos, strict=True)]

    @property
    def kappa_range(self) -> tuple[float, float]:
        """κ's 95 % interval."""
        return within(self.kappas)

    @property
    def rho_range(self) -> tuple[float, float]:
        """ρ's."""
        return within(self.rhos)

    def predicted(self, room: RoomErrors) -> F64:
        """The model's errors of a room's arms, (A,)."""
        a, b = self.levels[room.name]
        return a + b * np.array([excess(room.noise, of, kappa=self.kappa, rho=self.rho) for of in room.allocations])


def fit(rooms: Sequence[RoomErrors]) -> Fit:
    """Least squares over a grid of κ and ρ, weighted by the arms' own errors, of the errors and of each replicate.

    a and b of a room are not negative. Raises ValueError for fewer arms than the model has constants.
    """
    arms = sum(len(room.errors) for room in rooms)
    freedom = arms - 2 * len(rooms) - 2
    if freedom < 0:
        raise ValueError(f"{arms} arms: {2 * len(rooms) + 2} at least tell {len(rooms)} rooms' constants")
    grid = np.array(list(product(KAPPAS, RHOS)))
    excesses = [_excesses(room, grid) for room in rooms]
    lines = [_lines(room, room.errors[None], of) for room, of in zip(rooms, excesses, strict=True)]
    chi2 = np.sum([of_room for _, _, of_room in lines], axis=0)[0]
    best = int(np.argmin(chi2))
    levels = {room.name: (float(a[0, best]), float(b[0, best])) for room, (a, b, _) in zip(rooms, lines, strict=True)}
    replicated = np.zeros((REPLICATES, len(grid)))
    for room, of in zip(rooms, excesses, strict=True):
        replicated += _lines(room, room.replicates, of)[2]
    kappas, rhos = grid[np.argmin(replicated, axis=1)].T
    return Fit(float(grid[best, 0]), float(grid[best, 1]), levels, float(chi2[best]), freedom, kappas, rhos)


def _excesses(room: RoomErrors, grid: F64) -> F64:
    """The excess of each arm at each κ and ρ, (G, A)."""
    return np.array([[excess(room.noise, of, kappa=k, rho=r) for of in room.allocations] for k, r in grid])


def _lines(room: RoomErrors, errors: F64, excesses: F64) -> tuple[F64, F64, F64]:
    """A room's a and b that fit errors (R, A) best, at each place of the grid, and χ²; (R, G) each.

    A straight line through points (excess, error). Errors and excesses are positive, so at most one of a and b comes
    out negative, and then the best line that is allowed has 0 in its place.
    """
    weights = 1 / room.own_errors**2
    s, x, xx = weights.sum(), excesses @ weights, excesses**2 @ weights
    y, yy, xy = (errors @ weights)[:, None], (errors**2 @ weights)[:, None], (errors * weights) @ excesses.T
    b = (s * xy - x * y) / (s * xx - x**2)
    a = (y - b * x) / s
    a, b = np.where(b < 0, y / s, a), np.maximum(b, 0)
    a, b = np.maximum(a, 0), np.where(a < 0, xy / xx, b)
    return a, b, yy - 2 * (a * y + b * xy) + a**2 * s + 2 * a * b * x + b**2 * xx
