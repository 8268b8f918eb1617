"""The figures of the table and of the plots, made from images and times."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.renderer.peers.errors import (
    F64,
    ReferenceImage,
    efficiency,
    error_of,
    full_error,
    mean_ratio,
    relative_errors,
    trimmed_error,
)
from bench.renderer.peers.methods import Shot
from bench.renderer.peers.plans import BASELINE

if TYPE_CHECKING:
    from bench.renderer.peers.measure import MeasuredMethod

AVERAGED = (2, 4)
"""Points of the plots beyond the time budget: so many independent images averaged, at so many times the cost."""


def rows(
    measured: Mapping[str, MeasuredMethod], references: Mapping[str, ReferenceImage], clock: str
) -> dict[str, Any]:
    """A row of figures for each method, at the full time budget."""
    common = references["common"]
    scored = {name: _scored(m.shots[-1], references[name], common, clock) for name, m in measured.items()}
    result = {}
    for name, (errors, seconds) in scored.items():
        shots = measured[name].shots[-1]
        row: dict[str, Any] = {
            "spp": measured[name].calibration.spp[-1],
            "compile_s": measured[name].calibration.compile_s,
            "wall_s": float(np.mean([shot.wall_s for shot in shots])),
            "cpu_s": float(np.mean([shot.cpu_s for shot in shots])),
            "mean_ratio": asdict(mean_ratio(_images(shots), common)),
            "finite": bool(np.isfinite(_images(shots)).all()),
        }
        for kind, measure in (("full", full_error), ("trimmed", trimmed_error)):
            row[kind] = asdict(error_of(errors, measure))
            if BASELINE in scored:
                base, base_seconds = scored[BASELINE]
                row[f"efficiency_{kind}"] = asdict(efficiency(errors, seconds, base, base_seconds, measure))
        result[name] = row
    return result


def gains(
    of: str, measured: Mapping[str, MeasuredMethod], references: Mapping[str, ReferenceImage], clock: str
) -> dict[str, dict[str, Any]]:
    """(relMSE × time) of each other method over that of the method `of`: 'full' and 'trimmed', above 1 `of` is better.

    Round by round, as drift of the machine meets the methods of one round alike. Empty where `of` is not measured.
    """
    if of not in measured:
        return {}
    common = references["common"]
    scored = {name: _scored(m.shots[-1], references[name], common, clock) for name, m in measured.items()}
    own, own_seconds = scored.pop(of)
    kinds = (("full", full_error), ("trimmed", trimmed_error))
    return {
        name: {kind: asdict(efficiency(own, own_seconds, *other, measure)) for kind, measure in kinds}
        for name, other in scored.items()
    }


def curves(
    measured: Mapping[str, MeasuredMethod], references: Mapping[str, ReferenceImage], clock: str
) -> dict[str, list[dict[str, Any]]]:
    """Points (seconds, full, trimmed, spp, averaged images) of each method, shortest time first."""
    return {name: _curve(m, references[name], references["common"], clock) for name, m in measured.items()}


def _curve(
    measured: MeasuredMethod, reference: ReferenceImage, common: ReferenceImage, clock: str
) -> list[dict[str, Any]]:
    points = []
    for spp, shots in zip(measured.calibration.spp, measured.shots, strict=True):
        errors, seconds = _scored(shots, reference, common, clock)
        points.append(_point(errors, float(seconds.mean()), spp, 1))
    shots, spp = measured.shots[-1], measured.calibration.spp[-1]
    images, seconds_each = _images(shots), np.mean([shot.seconds(clock) for shot in shots])
    for count in AVERAGED:
        groups = len(images) // count
        if groups < 2:
            break
        averaged = images[: groups * count].reshape(groups, count, *images.shape[1:]).mean(axis=1)
        points.append(
            _point(relative_errors(averaged, reference, common), float(count * seconds_each), spp * count, count)
        )
    return points


def _point(errors: F64, seconds: float, spp: int, averaged: int) -> dict[str, Any]:
    full, trimmed = full_error(errors), trimmed_error(errors)
    return {"seconds": seconds, "full": full, "trimmed": trimmed, "spp": spp, "averaged": averaged}


def _scored(shots: list[Shot], reference: ReferenceImage, common: ReferenceImage, clock: str) -> tuple[F64, F64]:
    return relative_errors(_images(shots), reference, common), np.array([shot.seconds(clock) for shot in shots])


def _images(shots: list[Shot]) -> Any:
    return np.stack([shot.image for shot in shots]).astype(np.float64)
