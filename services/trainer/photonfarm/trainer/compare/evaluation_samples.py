"""The samples that predictors are compared on: held out from all of them, some with converged references."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from photonfarm.core.errors import IncompleteError, SpecError, StoreError
from photonfarm.core.keys import Key
from photonfarm.core.records import F32
from photonfarm.plan.hold_out import rows_held_out, units_of
from photonfarm.store import SceneReader
from photonfarm.store.read.merge import MergedView

SHOWN = 4  # samples shown as pictures


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """A view's merged passes, exposed: linear radiance × exposure, 2 × (H, W, 3)."""

    count: int  # independent estimates, of `half_spp` samples per pixel each
    half_a: F32
    half_b: F32  # independent of `half_a`

    @classmethod
    def of(cls, merged: MergedView, exposure: float) -> Self:
        """The halves of a merged view, as float32: their noise is far above its steps, and there may be hundreds."""
        a, b = (np.float32(exposure) * half.astype(np.float32) for half in (merged.half_a, merged.half_b))
        return cls(merged.count, a, b)

    @property
    def mean(self) -> F32:
        """The mean of both halves, (H, W, 3)."""
        mean: F32 = np.float32(0.5) * (self.half_a + self.half_b)
        return mean


@dataclass(frozen=True, slots=True)
class References:
    """The references of the metric space."""

    views: int
    spp: int  # of the reference that has the fewest
    half_a_share: float  # of that reference's samples: those of one half A, if all passes of the view were merged

    @classmethod
    def of(cls, references: Mapping[int, Reference], half_spp: int) -> Self | None:
        """A summary of the references found; None if there are none."""
        if not references:
            return None
        count = min(reference.count for reference in references.values())
        return cls(len(references), count * half_spp, 1 / count)


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """The picture beside the predictions of a shown sample."""

    row: int
    image: F32  # (H, W, 3) linear radiance × exposure
    spp: int
    is_reference: bool  # or else the mean of the sample's own noisy halves
    half_a: F32  # (H, W, 3) one noisy half-estimate of it, linear radiance × exposure


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutSamples:
    """The held-out samples that all predictors are measured on: one of each view, however many passes there are."""

    source: SceneReader
    rows: list[int]  # ascending
    view_keys: list[Key]  # of each

    @classmethod
    def of(cls, source: SceneReader, share: float, most: int) -> HeldOutSamples:
        """The first sample of each view held out by the smallest share: as shares are nested, no run was trained on it.

        At most `most` views; IncompleteError if there is none.
        """
        complete = source.refresh().tolist()
        held_out = [row for row, held in zip(complete, rows_held_out(source, complete, share), strict=True) if held]
        if not held_out:
            raise IncompleteError(
                f"hold_out = {share:g}: none of the {len(complete)} complete samples is held out; wait for the workers"
            )
        first = dict(zip(reversed(source.view_keys(held_out)), reversed(held_out), strict=True))
        chosen = sorted((row, key) for key, row in first.items())[:most]
        return cls(source, [row for row, _ in chosen], [key for _, key in chosen])

    def to_show(self, references: Mapping[int, Reference]) -> list[int]:
        """The first sample of each of the first configurations; only of those with a reference, if there are any."""
        rows = list(references) or self.rows
        first = dict(zip(reversed(units_of(self.source, rows)), reversed(rows), strict=True))
        return sorted(first.values())[:SHOWN]

    def target(self, row: int, reference: Reference | None) -> Target:
        """A sample's reference, or the mean of its halves; IncompleteError if a repair has set the sample aside."""
        spec = self.source.spec
        half_spp = spec.transport.half_spp
        halves = np.float32(spec.exposure) * self.source.read(row).radiance
        if reference is not None:
            return Target(row, reference.mean, reference.count * half_spp, is_reference=True, half_a=halves[0])
        return Target(row, halves.mean(axis=0), 2 * half_spp, is_reference=False, half_a=halves[0])


def read_references(folder: Path, samples: HeldOutSamples) -> dict[int, Reference]:
    """The references by the row of their view; raises StoreError if there is none, SpecError for another film."""
    if not folder.is_dir():
        raise StoreError(f"{folder}: there is no such folder")
    spec = samples.source.spec
    film = spec.film
    references: dict[int, Reference] = {}
    for row, key in zip(samples.rows, samples.view_keys, strict=True):
        if (file := folder / f"{key.hex()}.npz").is_file():
            references[row] = Reference.of(MergedView.read(file), spec.exposure)
            if (shape := references[row].half_a.shape) != (film.height, film.width, 3):
                raise SpecError(f"{file}: has the shape {shape}, and the scene's film {(film.height, film.width, 3)}")
    if not references:
        raise StoreError(
            f"{folder}: holds no reference of the {len(samples.rows)} held-out views; "
            "`photonfarm store merge --out` writes them, named by their views' keys"
        )
    return references
