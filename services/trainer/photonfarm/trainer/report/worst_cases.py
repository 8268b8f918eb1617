"""The worst failures of a network, by kind of pixels [supplement 4: its known failures; Figs. 6 to 8].

Shape letters: H W image.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.archives import Surface
from photonfarm.core.pictures import display_values
from photonfarm.core.records import F32, ViewBuffers

Mask = NDArray[np.bool_]
Values = NDArray[Any]

CLOSE = 0.05  # quantile of all depths below which a pixel is close to the camera
MIRRORS, SPECULAR, NEAR, SHADOWS, THIN, ALL = KINDS = (
    "mirrors and clear glass",
    "specular surfaces",
    "near surfaces",
    "fine shadows",
    "thin objects",
    "all pixels",
)
LEAST = 0.005  # the least share of the image's pixels in a case
STEP = 0.25  # of log irradiance, from a pixel to the next: a shadow's edge, where nothing else changes
THIN_PIXELS, THIN_DEPTH = 3, 0.9  # pixels whose neighbours so many to either side are farther; by this ratio
SAME_ALBEDO, SAME_NORMAL, SAME_DEPTH = 0.03, 0.98, 0.03  # up to this difference, cosine and ratio surfaces are the same


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutView:
    """One held-out view: its reference and buffers, and the network's image of it."""

    row: int
    image: F32  # (H, W, 3) exposed linear radiance, by the network
    half_a: F32  # of the reference, exposed; independent of `half_b`
    half_b: F32
    buffers: ViewBuffers
    surface: NDArray[np.uint8] | None  # (H, W) kinds of `archives.Surface`; None without the renderer


@dataclass(frozen=True, slots=True)
class WorstCase:
    """The view in which pixels of one kind have the largest error together."""

    kind: str
    row: int
    pixels: float  # share of the image
    mse: float  # of these pixels, in the metric space, the reference's noise taken out


def find_worst_cases(views: list[HeldOutView]) -> list[WorstCase]:
    """The view with the largest error for each kind of pixels, in the order of `KINDS`; views may repeat.

    Errors are summed over the pixels: of two views with one wrong mirror, the one with the larger mirror is worse.
    """
    if not views:
        return []
    depths = np.concatenate([view.buffers.depth[view.buffers.depth > 0] for view in views])
    close = float(np.quantile(depths, CLOSE)) if len(depths) else 0.0
    scored: dict[str, list[tuple[float, WorstCase]]] = {}
    for view in views:
        error = compute_squared_error(view)
        for kind, mask in list_kinds(view, close):
            if (share := float(mask.mean())) >= LEAST:
                case = WorstCase(kind, view.row, share, float(error[mask].mean()))
                scored.setdefault(kind, []).append((share * case.mse, case))
    return [max(scored[kind], key=lambda each: each[0])[1] for kind in KINDS if kind in scored]


def name_kinds(kinds: Sequence[str]) -> str:
    """The caption of a view that is the worst of some kinds, at least one."""
    *others, last = kinds
    return "worst view of " + " and ".join([*([", ".join(others)] if others else []), last])


def compute_squared_error(view: HeldOutView) -> NDArray[np.float64]:
    """The error of each pixel (H, W), over channels, in the metric space: (f − A)(f − B), whose noise averages out."""
    shown, a, b = (display_values(image).astype(np.float64) for image in (view.image, view.half_a, view.half_b))
    product: NDArray[np.float64] = ((shown - a) * (shown - b)).mean(axis=-1)
    return product


def list_kinds(view: HeldOutView, close: float) -> Iterator[tuple[str, Mask]]:
    """The kinds of pixels, each with its mask (H, W)."""
    if view.surface is not None:
        yield MIRRORS, view.surface == Surface.MIRROR
        yield SPECULAR, view.surface == Surface.SPECULAR
    yield NEAR, (view.buffers.depth > 0) & (view.buffers.depth < close)
    yield SHADOWS, find_shadow_edges(view)
    yield THIN, find_thin_objects(view.buffers.depth)
    yield ALL, np.ones_like(view.buffers.depth, np.bool_)


def find_shadow_edges(view: HeldOutView) -> Mask:
    """The pixels where the irradiance steps between neighbours that are otherwise alike, (H, W).

    It must step the same way in both halves of the reference: their noise is independent, and agrees only by chance.
    """
    buffers = view.buffers
    albedo = np.log(buffers.albedo.mean(axis=-1) + 1e-2)
    irradiance = np.stack([np.log(half.mean(axis=-1) + 1e-3) - albedo for half in (view.half_a, view.half_b)])
    edges = np.zeros(albedo.shape, np.bool_)
    for axis in (0, 1):
        # of all pixels but the last along this axis, and of the next of each
        depth, next_depth = _pair_neighbours(buffers.depth, axis)
        colour, next_colour = _pair_neighbours(buffers.albedo, axis)
        normal, next_normal = _pair_neighbours(buffers.normal, axis)
        alike = (depth > 0) & (next_depth > 0)
        alike &= np.abs(depth - next_depth) < SAME_DEPTH * np.maximum(depth, next_depth)
        alike &= (np.abs(colour - next_colour).max(axis=-1) < SAME_ALBEDO) & (colour.max(axis=-1) > 0)
        alike &= (normal * next_normal).sum(axis=-1) > SAME_NORMAL
        steps = np.diff(irradiance, axis=axis + 1)
        stepped = (steps > STEP).all(axis=0) | (steps < -STEP).all(axis=0)
        _pair_neighbours(edges, axis)[0][...] |= stepped & alike
    return edges


def _pair_neighbours(values: Values, axis: int) -> tuple[Values, Values]:
    """Views of all but the last along an axis, and of all but the first."""
    along = np.moveaxis(values, axis, 0)
    return np.moveaxis(along[:-1], 0, axis), np.moveaxis(along[1:], 0, axis)


def find_thin_objects(depth: F32) -> Mask:
    """The pixels of objects that are a few pixels wide, such as the legs of a chair, (H, W), by their depth (H, W).

    They are those whose neighbours `THIN_PIXELS` to either side along one axis are farther away.
    """
    far = np.where(depth > 0, depth, np.inf)
    thin = np.zeros(depth.shape, np.bool_)
    for axis in (0, 1):
        places = np.arange(depth.shape[axis])
        sides = [far.take((places + by).clip(0, places[-1]), axis) for by in (-THIN_PIXELS, THIN_PIXELS)]
        thin |= far < THIN_DEPTH * np.minimum(*sides)
    return thin
