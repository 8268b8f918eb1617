"""How much of what one change of a room does to its images a network explains: a turn, a lamp's power, its colour.

    python -m experiments.changes STORE RUN [--count 16] [--spp 96]

Each of `count` configurations that no plan has is shown as it is and with one kind of change taken from another, from a
view of its own. With Δ the change of a pixel in the metric space and p the predicted one, R² = 1 − Σ (p − Δ)² / Σ Δ²
over pixels, channels and views. The noise of Δ is taken out by halves of bdpt of `spp` together. Intervals are of a
bootstrap over configurations. Exit code 0.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from bench.harness import results
from photonfarm.core.records import F32
from photonfarm.predict import open_run
from photonfarm.predict.opened_run import OpenRun
from photonfarm.scene.groups import Light
from photonfarm.scene.modification import Modification, sample_modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import View, sample_view
from photonfarm.trainer.metrics.image_metrics import metric_space
from photonfarm.trainer.networks.guided import show_known_light

SEED = 99
"""A master seed that no plan should have."""

OTHERS = 5000
"""The number from which on configurations give their changes to others."""


def list_changes(spec: SceneSpec, before: Modification, other: Modification) -> Iterator[tuple[str, Modification]]:
    """A configuration with one kind of change taken from another; groups that are gone stay so."""
    turning = np.array([group.turn is not None for group in spec.groups]) & before.present & other.present
    lamps = np.array([isinstance(group, Light) for group in spec.groups]) & before.present & other.present
    for name, groups, first, last in (
        ("furniture that turns is moved", turning, 0, 3),
        ("it is turned", turning, 4, 5),
        ("lamps are moved", lamps, 0, 3),
        ("their power", lamps, 5, 6),
        ("their colour", lamps, 6, 9),
    ):
        vector = before.vector.copy()
        vector[groups, first:last] = other.vector[groups, first:last]
        yield name, Modification.from_vector(vector)


def show(run: OpenRun, modification: Modification, view: View, spp: int) -> F32:
    """The network's image, the light known alone and both halves, (4, H, W, 3) in the metric space."""
    frame, exposure = run.predict(modification, view), run.spec.exposure
    known = show_known_light(frame.inputs)[0].cpu().numpy()
    truth = run.truth(modification, view, spp=spp).halves * np.float32(exposure)
    shown: F32 = metric_space(np.stack([frame.radiance.cpu().numpy() * exposure, known, *truth])).numpy()
    return shown


def explain(sums: NDArray[np.float64]) -> str:
    """R² of sums (N, 2): of squared error and of squared change; with its interval."""
    draws = np.random.default_rng(0).integers(0, len(sums), (2000, len(sums)))
    ends = np.percentile([1 - np.divide(*sums[draw].sum(axis=0)) for draw in draws], [2.5, 97.5])
    return f"{1 - np.divide(*sums.sum(axis=0)):.3f} ({ends[0]:.3f} … {ends[1]:.3f})"


@torch.no_grad()
def main() -> None:
    """Print a table with a line for each kind of change."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("--count", type=int, default=16, help="configurations")
    parser.add_argument("--spp", type=int, default=96, help="samples per pixel of both halves together")
    asked = parser.parse_args()
    run = open_run(asked.run, asked.store)
    sums: dict[str, list[list[float]]] = {}
    errors = []
    for number in range(asked.count):
        before, other = (sample_modification(run.spec, SEED, number + more) for more in (0, OTHERS))
        view = sample_view(run.spec, before.key(run.spec.radiance_id), SEED, 0, before)
        shown = show(run, before, view, asked.spp)
        errors.append(float(((shown[0] - shown[2]) * (shown[0] - shown[3])).mean()))
        for name, after in list_changes(run.spec, before, other):
            network, known, a, b = show(run, after, view, asked.spp) - shown
            found = [float(((p - a) * (p - b)).sum()) for p in (network, known)]
            sums.setdefault(name, []).append([*found, float((a * b).sum()), a.size])
    print(f"{asked.run}: mean squared error {np.mean(errors):.5f}, {asked.count} configurations\n")
    rows = []
    for name, listed in sums.items():
        table = np.array(listed)
        change = table[:, 2].sum() / table[:, 3].sum()
        rows.append((name, f"{change:.5f}", explain(table[:, [0, 2]]), explain(table[:, [1, 2]])))
    print(results.table(("change", "its size", "R² of the network (95 %)", "of light known alone"), rows))


if __name__ == "__main__":
    main()
