"""The page about the paper's order: its sentences, from errors that are made up, and its picture."""

from __future__ import annotations

import numpy as np
import pytest

import order
from network_errors import Errors
from order import ARCHITECTURES, METRICS, Measured
from photonfarm.shared.scene import load_spec
from room_study import References

VIEWS, SIZE = 12, 16
UNITS = tuple(bytes([unit]) * 16 for unit in range(VIEWS))


def errors(level: float, seed: int) -> Errors:
    """Of two seeds; what is hard about a view is the same for all."""
    rng = np.random.default_rng(seed)
    hard = np.random.default_rng(99).uniform(0.5, 1.5, VIEWS)
    return Errors(level * (hard + 0.01 * rng.normal(size=(2, VIEWS))), UNITS)


def measured(levels: tuple[float, ...], **others: tuple[float, ...]) -> list[Measured]:
    """Four architectures with these mean errors, by all metrics but for those that are named with others."""
    images = np.random.default_rng(0).random((VIEWS, SIZE, SIZE, 3), np.float32)
    return [
        Measured(
            name, 1000, 60.0, images=images, linear=errors(levels[i], i),
            **{metric: errors(others.get(metric, levels)[i], i) for metric in METRICS.values()},
        )
        for i, name in enumerate(ARCHITECTURES)
    ]  # fmt: skip


def test_the_papers_order_is_said_where_it_is_found() -> None:
    said = order.verdict(measured((0.010, 0.0098, 0.0029, 0.0014)))
    assert "`feature_projection` is worse than `light_transport` (gap +70%, >)" in said
    assert "`light_transport` is worse than `light_transport_photons` (gap +52%, >)" in said
    assert "gap +2%, ≈" in said
    assert said.endswith("All other metrics say the same.")


def test_another_order_is_said_too_and_a_metric_that_disagrees() -> None:
    levels = (0.010, 0.0098, 0.0029, 0.0014)
    said = order.verdict(measured(levels, flip=(0.010, 0.0098, 0.0029, 0.0058)))
    assert said.endswith("by FLIP `light_transport` is better than `light_transport_photons` (gap -100%, <).")
    assert "`cnn` is better than `feature_projection` (gap -50%, <)" in order.verdict(measured((0.01, 0.015, 1, 1)))


@pytest.mark.parametrize("seeds", [[0, 1], [0]])
def test_the_page_and_its_figures_and_the_picture_are_made(seeds: list[int]) -> None:
    halves = np.random.default_rng(1).random((VIEWS, 2, SIZE, SIZE, 3), np.float32)
    references, found = References(tuple(range(VIEWS)), UNITS, halves, 256), measured((0.4, 0.3, 0.2, 0.1))
    told = order.options().parse_args(["--seeds", *map(str, seeds)])
    unlearned = errors(0.5, 8), errors(0.25, 9)
    page = order.page(told, load_spec("room"), references, found, unlearned)
    assert all(page.count(f"`{name}`") >= 2 for name in ARCHITECTURES)
    assert f"measured on {VIEWS} views of {VIEWS} further configurations" in page
    assert all(f"By {metric}:" in page for metric in METRICS)
    rows = order.document(told, references, found, unlearned)["rows"]
    assert [row["architecture"] for row in rows] == list(ARCHITECTURES)
    assert all(np.shape(row[metric]) == (2, VIEWS) for row in rows for metric in METRICS.values())
    picture = order.picture(references, found)
    assert picture.width > 5 * SIZE
    assert picture.height > len(order.SHOWN) * SIZE
