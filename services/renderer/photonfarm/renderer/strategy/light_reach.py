"""How far light paths reach, and so which photons are worth storing. Shape letters: N light paths, D bounces."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.scene.spec import PhotonSpec, ViewSpec

PATHS = 4096
DEPTH = 16
"""The largest depth that a spec may have."""

LEAST_SHARE = 0.01
"""The smallest share of light paths near the cameras for which photons are stored.

It is also the largest share of the power there that omitted bounces may carry.
"""


@dataclass(frozen=True, slots=True)
class LightReach:
    """The shares of light paths, and of their power, that reach the cameras; (C, D): by configurations and bounces."""

    hit: float  # the share of light paths that hit any surface, mean over configurations
    filled: tuple[float, ...]  # (D,) the share of light paths with such a bounce, mean over configurations
    near: tuple[tuple[float, ...], ...]  # (C, D) the share with such a bounce in the cameras' surroundings
    power: tuple[tuple[float, ...], ...]  # (C, D) the share of the power there; the sum over bounces is 1 (or 0)


def measure(scenes: Iterable[Any], view: ViewSpec, seed: int) -> LightReach:
    """Trace light paths in several configurations of a scene; each item is the scene in the next of them.

    The surroundings are the box around all cameras and look-at points, larger by a quarter on every side: the sky's
    light on a roof is not light in the room.
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
    filled, near_share, power = np.array(rows).transpose(1, 0, 2)
    arrived = power.sum(axis=1, keepdims=True)
    shares = np.divide(power, arrived, out=np.zeros_like(power), where=arrived > 0)
    mean = filled.mean(axis=0)
    return LightReach(float(mean[0]), tuple(mean.tolist()), _tuples(near_share), _tuples(shares))


def _tuples(rows: NDArray[np.float64]) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in rows.tolist())


def _inside(position: NDArray[np.float32], view: ViewSpec) -> NDArray[np.bool_]:
    low = np.minimum(view.origin.low, view.look_at.low)
    high = np.maximum(view.origin.high, view.look_at.high)
    margin = 0.25 * (high - low) + 0.05 * np.linalg.norm(high - low)
    return np.all((position >= low - margin) & (position <= high + margin), axis=1)


def recommend(
    wanted: PhotonSpec, near: Sequence[Sequence[float]], power: Sequence[Sequence[float]], max_depth: int
) -> tuple[PhotonSpec, str]:
    """The photons worth storing, and the reason; never more than in the spec. `near` and `power` as in `LightReach`.

    The omitted part must be negligible in each configuration, as it is not measured again. A hit of bounce d lies
    on paths of at least d + 2 edges, so bounces beyond max_depth contribute to no image.
    """
    if not wanted.paths:
        return wanted, "photons: none, as the spec says"
    reaching = float(np.max(near))
    if reaching < LEAST_SHARE or max_depth in (0, 1):
        reason = f"{reaching:.1%} of the light paths, at most, reach the cameras' surroundings"
        if max_depth in (0, 1):
            reason = "max_depth shows no light that a surface reflects"
        return wanted.model_copy(update={"paths": 0}), f"photons: none, as {reason}; {_BY_HAND}"
    beyond = np.max(np.sum(power, axis=1, keepdims=True) - np.cumsum(power, axis=1), axis=0)
    enough = int(np.argmax(beyond < LEAST_SHARE)) + 1 if (beyond < LEAST_SHARE).any() else len(beyond)
    longest = max_depth - 1 if max_depth > 0 else wanted.depth
    depth = max(1, min(wanted.depth, enough, longest))
    sentence = (
        f"photons: {wanted.paths} paths of {depth} hits; up to {reaching:.0%} of the paths reach the cameras' "
        f"surroundings, and bounces beyond carry up to {max(0.0, beyond[depth - 1]):.1%} of the power there, in "
        f"{len(power)} draws of the configuration" + (f"; {_BY_HAND}" if depth < wanted.depth else "")
    )
    return wanted.model_copy(update={"depth": depth}), sentence


_BY_HAND = "no later plan undoes that once it is written: raise it by hand"
