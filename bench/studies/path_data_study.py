"""What path_data.py renders, trains and measures, and the figures that its page draws from it."""

from __future__ import annotations

import argparse
from dataclasses import dataclass

from bench.harness.network_errors import Errors, seed_spread
from bench.harness.room_study import ReferenceViews
from bench.studies import path_statistics
from bench.studies.path_scene import Costs, Rendered
from bench.studies.path_statistics import BudgetFactor
from photonfarm.core.keys import Key
from photonfarm.core.records import F32
from photonfarm.scene.spec import SceneSpec
from photonfarm.trainer.runs.settings import TrainSettings

BLOCK = 8  # px
METRICS = {"MSE": "shown", f"MSE of {BLOCK} × {BLOCK} means": "coarse", "linear MSE": "linear"}


@dataclass(frozen=True, slots=True)
class Arm:
    """Samples of one kind at one budget."""

    kind: str  # "bdpt" or "path"
    share: float  # of budget 1, counted in samples
    samples: int


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredArm:
    """Networks of one arm, one from each seed; N held-out views."""

    arm: Arm
    train_s: float  # of one run's steps, wall time
    shown: Errors  # squared, in the metric space
    coarse: Errors  # the same of means of blocks of pixels
    linear: Errors  # squared, in exposed linear radiance
    images: F32  # (N, H, W, 3) from the first seed


@dataclass(frozen=True, slots=True, eq=False)
class Targets:
    """Samples of the N views that both stores have, as halves (N, 2, H, W, 3), exposed linear radiance."""

    bdpt: F32
    path: F32
    units: tuple[Key, ...]  # (N,) the configuration of each
    held_out: tuple[int, ...]  # which of them the references show, in their order


@dataclass(frozen=True, slots=True, eq=False)
class Study:
    """All that was rendered, trained and measured."""

    arguments: argparse.Namespace
    spec: SceneSpec
    settings: TrainSettings
    costs: Costs
    made: dict[str, Rendered]
    references: ReferenceViews
    measured: list[MeasuredArm]

    def of(self, kind: str) -> list[MeasuredArm]:
        """The arms of one kind, by ascending budget."""
        return [one for one in self.measured if one.arm.kind == kind]

    def core_s(self, arm: Arm) -> float:
        """Core-seconds of an arm's samples."""
        return arm.samples * self.made[arm.kind].core_s

    @property
    def dearer(self) -> float:
        """Core-seconds of a sample of `path` over those of one of `bdpt`."""
        return self.made["path"].core_s / self.made["bdpt"].core_s

    @property
    def budgets(self) -> list[float]:
        """Core-seconds of the arms of `path`, over those of the last arm of `bdpt`."""
        return [self.core_s(one.arm) / self.core_s(self.of("bdpt")[-1].arm) for one in self.of("path")]

    @property
    def dearer_before(self) -> float:
        """The same, by the times of halves that were taken before; all else as in `bdpt`'s samples."""
        costs, bdpt_s = self.costs, self.made["bdpt"].core_s
        return (bdpt_s + costs.path_fixed_s + costs.path_spp * costs.path_spp_s - costs.bdpt_s) / bdpt_s

    def spread(self, metric: str, least: float = 0.0) -> float:
        """What seeds move an arm's mean by, as a share of it, pooled over arms of `least` × samples and more."""
        return seed_spread([getattr(one, metric) for one in self.measured if one.arm.share >= least])

    def factor(self, metric: str, least: float = 0.0) -> tuple[BudgetFactor, list[float]]:
        """The factor by which `path` must grow for the error of `bdpt` at budget 1: of all seeds, and of each.

        The interval is by `spread` of these arms.
        """
        wanted, found = getattr(self.of("bdpt")[-1], metric), [getattr(one, metric) for one in self.of("path")]
        by_seed = path_statistics.factors_of_seeds(wanted, found, self.budgets)
        return path_statistics.factor(wanted, found, self.budgets, self.spread(metric, least)), by_seed

    @property
    def without_calls(self) -> float:
        """What factors are to be multiplied by where the fixed cost of `path`'s calls is not counted."""
        return 1 - self.costs.path_fixed_s / self.made["path"].core_s

    def noise(self, targets: Targets, *, relative: bool) -> tuple[float, float, BudgetFactor]:
        """Variances of targets of `bdpt` and of `path` on held-out views, and their ratio at equal core-seconds."""
        views, clean = list(targets.held_out), self.references.mean
        variances = [
            path_statistics.relative_noise(halves[views], clean) if relative else path_statistics.noise(halves[views])
            for halves in (targets.bdpt, targets.path)
        ]
        apart = path_statistics.ratio(variances[1] * self.dearer, variances[0], self.references.units)
        return float(variances[0].mean()), float(variances[1].mean()), apart
