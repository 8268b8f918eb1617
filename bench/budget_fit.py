"""How much of the measured errors the allocation's model explains, and its constants κ and ρ.

`photonfarm.shared.allocation` has the model. Each room has an error a that endless data would leave and a scale b of
the excess above it; κ and ρ are common to all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from photonfarm.shared.allocation import Allocation, excess

KAPPAS = np.geomspace(0.1, 3000, 160)
RHOS = np.concatenate([[0.0], np.geomspace(0.03, 30, 80)])


@dataclass(frozen=True, slots=True)
class Point:
    """An arm of a study."""

    room: str
    allocation: Allocation
    noise: float  # relative, of the room at one sample per pixel
    error: float  # held-out
    standard_error: float


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """The constants that fit best, with the ranges of those that fit nearly as well."""

    kappa: float
    rho: float
    kappa_range: tuple[float, float]  # χ² up to 1 above the least, whatever ρ
    rho_range: tuple[float, float]
    levels: dict[str, tuple[float, float]]  # a and b of each room
    chi2: float
    freedom: int

    def predicted(self, point: Point) -> float:
        """The model's error of an arm."""
        a, b = self.levels[point.room]
        return a + b * excess(point.noise, point.allocation, kappa=self.kappa, rho=self.rho)


def fit(points: Sequence[Point]) -> Fit:
    """Least squares over a grid of κ and ρ, weighted by the arms' standard errors; a and b of a room are not negative.

    Raises ValueError for fewer arms than the model has constants.
    """
    rooms = list(dict.fromkeys(point.room for point in points))
    freedom = len(points) - 2 * len(rooms) - 2
    if freedom < 0:
        raise ValueError(f"{len(points)} arms: {2 * len(rooms) + 2} at least tell {len(rooms)} rooms' constants")
    found = {(k, r): _levels(points, rooms, float(k), float(r)) for k, r in product(KAPPAS, RHOS)}
    chi2 = {at: values[1] for at, values in found.items()}
    best = min(chi2, key=lambda at: chi2[at])
    near = np.array([at for at, value in chi2.items() if value <= chi2[best] + 1])
    levels = {room: (float(a), float(b)) for room, (a, b) in zip(rooms, found[best][0].reshape(-1, 2), strict=True)}
    ranges = [(float(low), float(high)) for low, high in zip(near.min(axis=0), near.max(axis=0), strict=True)]
    return Fit(float(best[0]), float(best[1]), ranges[0], ranges[1], levels, chi2[best], freedom)


def _levels(
    points: Sequence[Point], rooms: Sequence[str], kappa: float, rho: float
) -> tuple[NDArray[np.float64], float]:
    """Each room's a and b, in turn, and χ²."""
    design = np.zeros((len(points), 2 * len(rooms)))
    for line, point in zip(design, points, strict=True):
        place = 2 * rooms.index(point.room)
        line[place : place + 2] = 1, excess(point.noise, point.allocation, kappa=kappa, rho=rho)
    weight = 1 / np.array([point.standard_error for point in points])
    levels, rest = nnls(design * weight[:, None], weight * np.array([point.error for point in points]))
    return levels, float(rest**2)
