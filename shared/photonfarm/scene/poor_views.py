"""Views that are hardly worth a sample: no light reaches what they show, or that is little but a surface close by.

What is stored is counted by its halves: a sample is black if both are. But who chooses what to train on may not look at
halves: of a dim view that would leave out the passes that are black by chance, and the others are too bright. So a view
is unlit by its inputs, whose noise is independent of that of halves: to leave it out changes which views are learned,
and biases none that stays.

Shape letters: H W image, K photon slots.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from photonfarm.core.formatting import format_share

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from photonfarm.core.records import F32, Photons
    from photonfarm.scene.spec import SceneSpec

PoorKind = Literal["unlit", "near"]

LIGHT = ("emission", "direct", "gloss")
"""The guides that show light."""

HAND = 1 / 64
"""A hand, as a share of the diagonal of the box around all cameras and look-at points: 10 cm of 6.4 m."""


def hand_of(spec: SceneSpec) -> float:
    """A hand in scene units."""
    origin, look_at = spec.view.origin, spec.view.look_at
    low = [min(pair) for pair in zip(origin.min, look_at.min, strict=True)]
    high = [max(pair) for pair in zip(origin.max, look_at.max, strict=True)]
    return HAND * math.dist(low, high)


Depths = TypeVar("Depths")
"""An array of numpy's or of torch's."""


def are_near(hand: float, depth: Depths) -> Depths:
    """Whether views with these depths (…, H, W) show surfaces within a hand in half of the image or more, (…)."""
    values: Any = depth
    near: Depths = 2 * ((values > 0) & (values < hand)).sum((-2, -1)) >= values.shape[-2] * values.shape[-1]
    return near


def is_unlit(
    images: Mapping[str, NDArray[Any]], eye: F32, seen: NDArray[Any], read_photons: Callable[[], Photons]
) -> bool:
    """Whether a view from a point (3,) shows no lamp, no direct light, and of photons (K,) only the side behind.

    `seen` (K,) says which photons nothing hides. From within a piece of furniture these are those that landed on it,
    outside; so their sides are looked at, and they are read for that only where nothing else is lit. Of a scene without
    photons nothing is unlit.
    """
    if not len(seen) or any(images[name].any() for name in LIGHT):
        return False
    photons = read_photons()
    towards_eye = ((eye - photons.position) * photons.normal).sum(axis=1)
    towards_light = -(photons.direction * photons.normal).sum(axis=1)
    return not (seen & (towards_eye * towards_light > 0)).any()


def describe_counts(counts: Mapping[str, int]) -> str:
    """What share of `samples` is `black`, and of `views` is `near`, in words; "" if none is."""
    parts = [
        f"{counts[poor]} of {counts[of]} {of} ({format_share(counts[poor] / counts[of])}) {words}"
        for poor, of, words in (
            ("black", "samples", "are black"),
            ("near", "views", "show little but a surface within a hand of the camera"),
        )
        if counts.get(poor)
    ]
    return "; ".join(parts)
