"""Views that are hardly worth a sample: nothing that they show is lit, or they show little but a surface close by.

Both are told by a view's inputs, whose noise is independent of that of its halves. So to leave such views out of
training changes which views are learned, and biases none that stays. Whether both halves are black would not do: of a
dim view that would leave out the passes that are black by chance, and the others are too bright.

Shape letters: H W image.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal, get_args

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from photonfarm.scene.spec import SceneSpec

PoorKind = Literal["unlit", "near"]
"""No lamp, no direct light and no photon is seen in the view; half of it or more shows surfaces within a hand."""

POOR_KINDS: tuple[PoorKind, ...] = get_args(PoorKind)

LIGHT = ("emission", "direct", "gloss")
"""The guides that show light; so do photons, of which the store's `photon_seen` says which a view sees."""

HAND = 1 / 64
"""A hand, as a share of the diagonal of the box around all cameras and look-at points: 10 cm of 6.4 m."""


def hand_of(spec: SceneSpec) -> float:
    """A hand in scene units."""
    boxes = spec.view.origin, spec.view.look_at
    low, high = (list(map(end, *(getattr(box, name) for box in boxes))) for name, end in (("min", min), ("max", max)))
    return HAND * math.dist(low, high)


def are_near(hand: float, depth: NDArray[Any]) -> NDArray[Any]:
    """Whether views with these depths (…, H, W) show surfaces within a hand in half of the image or more, (…)."""
    share: NDArray[Any] = ((depth > 0) & (depth < hand)).mean(axis=(-2, -1)) >= 0.5
    return share


def find_poor(spec: SceneSpec, of_view: Mapping[str, NDArray[Any]]) -> list[PoorKind]:
    """In what ways a view is poor, by what is stored of it, by name: `depth`, `LIGHT`, perhaps `photon_seen`."""
    unlit = not any(of_view[name].any() for name in ("photon_seen", *LIGHT) if name in of_view)
    near = bool(are_near(hand_of(spec), of_view["depth"]))
    return [kind for kind, holds in zip(POOR_KINDS, (unlit, near), strict=True) if holds]


def describe_counts(counts: Mapping[str, int]) -> str:
    """The numbers of `all` views, and of those of each kind, in words; "" if no view is poor."""
    number = counts.get("all", 0)
    words = {"unlit": "show nothing that is lit", "near": "show little but a surface within a hand of the camera"}
    parts = [
        f"{counts[kind]} ({100 * counts[kind] / number:.2g} %) {words[kind]}" for kind in POOR_KINDS if counts.get(kind)
    ]
    return f"of {number} views {' and '.join(parts)}" if parts else ""
