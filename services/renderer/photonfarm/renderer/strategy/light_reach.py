"""How far the light gets: which photons are worth storing. Shape letters: N light paths, D bounces."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.scene import PhotonSpec, ViewSpec

PATHS = 4096
DEPTH = 16
"""The largest depth that a spec can ask for."""

LEAST_SHARE = 0.01
"""Of the light paths that reach the cameras' surroundings, below which photons are not worth their place; and of the
power that arrives there, what the bounces left out may carry."""


@dataclass(frozen=True, slots=True)
class LightReach:
    """Shares of light paths and of their power, means over configurations."""

    hit: float  # of the light paths, those that hit any surface
    filled: tuple[float, ...]  # (D,) of the light paths, those with such a bounce: the slots that are filled
    near: tuple[float, ...]  # (D,) those with such a bounce in the cameras' surroundings
    power: tuple[float, ...]  # (D,) of the power that arrives in the cameras' surroundings, sum 1 (or 0)


def measure(scenes: Iterable[Any], view: ViewSpec, seed: int) -> LightReach:
    """Trace light paths in a scene in several configurations; each item is the scene, put into the next of them.

    The surroundings are the box around all cameras and what they look at, larger by a quarter on every side: the sky's
    light on a roof is no light in the room.
    """
    from photonfarm.renderer.bdpt import trace_photons

    rows = []
    for i, scene in enumerate(scenes):
        photons = trace_photons(scene, seed=seed + i, paths=PATHS, depth=DEPTH)
        near = _inside(photons.position, view)
        of_bounce = [photons.bounce == d for d in range(DEPTH)]
        rows.append([
            [float(np.sum(at)) / PATHS for at in of_bounce],
            [float(np.sum(at & near)) / PATHS for at in of_bounce],
            [float(np.sum(photons.power[at & near], dtype=np.float64)) for at in of_bounce],
        ])  # fmt: skip
    filled, near_share, power = np.mean(rows, axis=0)
    shares = power / power.sum() if power.sum() > 0 else power
    return LightReach(float(filled[0]), tuple(filled.tolist()), tuple(near_share.tolist()), tuple(shares.tolist()))


def _inside(position: NDArray[np.float32], view: ViewSpec) -> NDArray[np.bool_]:
    low = np.minimum(view.origin.low, view.look_at.low)
    high = np.maximum(view.origin.high, view.look_at.high)
    margin = 0.25 * (high - low) + 0.05 * np.linalg.norm(high - low)
    return np.all((position >= low - margin) & (position <= high + margin), axis=1)


def recommend(
    wanted: PhotonSpec, near: Sequence[float], power: Sequence[float], max_depth: int
) -> tuple[PhotonSpec, str]:
    """The photons worth storing, and why; never more than the spec wants.

    A hit of bounce d lies on paths of d + 2 edges at least, so bounces that max_depth cuts off shine in no image.
    """
    if not wanted.paths:
        return wanted, "photons: none, as the spec says"
    if max(near) < LEAST_SHARE or max_depth in (0, 1):
        reason = f"{max(near):.1%} of the light paths reach the cameras' surroundings"
        if max_depth in (0, 1):
            reason = "max_depth shows no light that a surface reflects"
        return wanted.model_copy(update={"paths": 0}), f"photons: none, as {reason}"
    beyond = 1 - np.cumsum(power)
    enough = int(np.argmax(beyond < LEAST_SHARE)) + 1 if (beyond < LEAST_SHARE).any() else len(power)
    longest = max_depth - 1 if max_depth > 0 else wanted.depth
    depth = max(1, min(wanted.depth, enough, longest))
    sentence = (
        f"photons: {wanted.paths} paths of {depth} hits; {max(near):.0%} of the paths reach the cameras' surroundings, "
        f"and bounces beyond carry {max(0.0, float(beyond[depth - 1])):.1%} of the power there"
    )
    return wanted.model_copy(update={"depth": depth}), sentence
