"""Russian roulette of camera and light paths: which may end, how often, and that the mean stays."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from photonfarm.renderer.bdpt import eye_paths, light_paths, randomness
from photonfarm.renderer.bdpt.light_paths import PathOptions

N, RR_DEPTH = 1 << 16, 5


def after_roulette(throughput: float, *, whole: float, depth: int, eta: float = 1.0, first: bool = False) -> Any:
    rng = randomness.sampler(dr.full(mi.UInt32, 7, N), dr.arange(mi.UInt32, N))
    state = SimpleNamespace(
        active=dr.full(mi.Bool, True, N),
        rng=rng,
        throughput=mi.Spectrum(throughput, throughput / 2, 0),
        eta=mi.Float(eta),
        whole=mi.Float(whole),
        depth=mi.UInt32(depth),
    )
    options = PathOptions(99, RR_DEPTH, 0, mi.Float(0), mi.Float(0), connects=False, traces_light=False)
    eye_paths._roulette(state, mi.Bool(first), options)  # type: ignore[arg-type]
    return state


@pytest.mark.parametrize(
    ("throughput", "whole", "depth", "eta", "survive"),
    [
        (0.1, 0.5, 3, 1.0, 0.4),
        (0.3, 0.5, 3, 1.0, 1.0),  # it has not lost half
        (0.1, 0.5, 3, 1.5, 0.9),  # what refraction took off is no loss
        (0.1, 0.5, RR_DEPTH + 1, 1.0, 0.1),
        (1.0, 0.5, RR_DEPTH + 1, 1.0, 0.95),
    ],
)
def test_survivors_are_brighter_by_their_rarity(
    throughput: float, whole: float, depth: int, eta: float, survive: float
) -> None:
    state = after_roulette(throughput, whole=whole, depth=depth, eta=eta)
    alive = np.array(state.active)
    assert abs(alive.mean() - survive) <= 4 * np.sqrt(survive * (1 - survive) / N)
    brighter = [throughput / survive, throughput / 2 / survive]
    np.testing.assert_allclose(np.array(state.throughput).ravel()[:2], brighter, rtol=1e-5)


@pytest.mark.parametrize(
    ("throughput", "start", "depth", "survive"),
    [
        (0.1, 0.5, 3, 0.6),
        (0.2, 0.5, 3, 1.0),  # it has not lost two thirds
        (0.1, 0.5, RR_DEPTH + 1, 0.2),
        (1.0, 0.5, RR_DEPTH + 1, 0.95),
        (0.0, 0.5, 3, 0.0),
    ],
)
def test_surviving_light_paths_are_brighter_by_their_rarity(
    throughput: float, start: float, depth: int, survive: float
) -> None:
    state = SimpleNamespace(
        active=dr.full(mi.Bool, True, N),
        throughput=mi.Spectrum(throughput, throughput / 2, 0),
        depth=mi.UInt32(depth),
        rng=randomness.sampler(dr.full(mi.UInt32, 7, N), dr.arange(mi.UInt32, N)),
    )
    options = PathOptions(99, RR_DEPTH, 0, mi.Float(0), mi.Float(0), connects=False, traces_light=False)
    light_paths.roulette(state, SimpleNamespace(throughput=mi.Spectrum(start)), options)  # type: ignore[arg-type]
    assert abs(np.array(state.active).mean() - survive) <= 4 * np.sqrt(survive * (1 - survive) / N)
    if survive:
        brighter = [throughput / survive, throughput / 2 / survive]
        np.testing.assert_allclose(np.array(state.throughput).ravel()[:2], brighter, rtol=1e-5)


def test_no_path_ends_at_the_first_vertex_before_rr_depth_however_dark_it_is() -> None:
    state = after_roulette(0.01, whole=1.0, depth=2, first=True)
    assert np.array(state.active).all()
    assert np.array(state.whole)[0] == pytest.approx(0.01)
