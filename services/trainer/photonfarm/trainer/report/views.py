"""The views that a report shows, in layers: images and what they are held against, then what the network was given.

Supplement Figs. 6 to 8. Shape letters: H W image.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from photonfarm.core.pictures import Picture, display, display_values, draw_albedo, draw_depth, draw_normal
from photonfarm.core.records import F32
from photonfarm.trainer.compare.evaluation_samples import Target
from photonfarm.trainer.report.contents import ReportContents
from photonfarm.trainer.report.worst_cases import ALL, WorstCase, name_kinds

LARGEST = 0.25  # difference in the metric space that is drawn brightest

PREDICTION, NOISY, DIFFERENCE = "prediction", "noisy half", "difference"


OF_GUIDES = {
    "direct": "direct light",
    "gloss": "direct light in gloss",
    "emission": "emitted light",
    "specular": "specular albedo",
    "roughness": "roughness",
    "throughput": "mirrors and glass",
    "beyond_albedo": "albedo beyond them",
}
"""The guides that are shown where they vary over the view."""

RADIANCE = ("direct", "gloss", "emission")

VARIED = 8.0  # standard deviation of a picture's bytes, above which there is something to see in it


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """One image of a view."""

    name: str  # distinct within the view
    caption: str
    picture: Picture
    light: F32 | None = None  # (H, W, 3) linear radiance × exposure; None for what is no light


@dataclass(frozen=True, slots=True, eq=False)
class ShownView:
    """One held-out view."""

    row: int  # of the store
    caption: str
    target: str  # the layer that predictions are held against
    images: tuple[Layer, ...]  # noisy half, prediction, target, difference; then of further predictors
    inputs: tuple[Layer, ...]
    mse: float  # of the first predictor, in the metric space, with the target's noise


def choose_views(contents: ReportContents) -> list[ShownView]:
    """The views with an image by the first predictor: that of median error first, so that no choice flatters."""
    there = contents.entries[0].row.shown
    views = [_make_view(contents, target) for target in contents.evaluation.shown if target.row in there]
    if not views:
        return []
    median = sorted(views, key=lambda view: view.mse)[(len(views) - 1) // 2]
    first = replace(median, caption=write_caption(contents.worst, median.row, is_median=True))
    return [first, *(view for view in views if view is not median)]


def _make_view(contents: ReportContents, target: Target) -> ShownView:
    first, *others = [
        (entry.name, entry.row.shown[target.row]) for entry in contents.entries if target.row in entry.row.shown
    ]
    against = "reference" if target.is_reference else "mean of both halves"
    half_spp = contents.card.spec.transport.half_spp
    prediction, difference, mse = _compare_layers(*first, target.image)
    images = [
        make_light_layer(NOISY, f"noisy half, {half_spp} samples per pixel", target.half_a),
        prediction,
        make_light_layer(against, f"{against}, {target.spp} samples per pixel", target.image),
        difference,
    ]
    for name, image in others:
        images += _compare_layers(name, image, target.image, of=f" of {name}")[:2]
    inputs = tuple(_list_inputs(contents, target.row))
    return ShownView(target.row, write_caption(contents.worst, target.row), against, tuple(images), inputs, mse)


def write_caption(worst: tuple[WorstCase, ...], row: int, *, is_median: bool = False) -> str:
    """What a view is shown for, and its row; one of median error may still be the worst of some kinds of pixels."""
    kinds = [case.kind for case in worst if case.row == row and not (is_median and case.kind == ALL)]
    parts = ["view of median error"] * is_median + ([name_kinds(kinds)] if kinds else []) + [f"row {row}"]
    text = "; ".join(parts)
    return text[0].upper() + text[1:]


def _compare_layers(name: str, image: F32, target: F32, of: str = "") -> tuple[Layer, Layer, float]:
    """A predictor's image and its difference to the target, with the mean of its square."""
    apart = display_values(image) - display_values(target)
    mse = float(np.mean(apart**2))
    return (
        make_light_layer(f"{PREDICTION}{of}", f"prediction by {name}", image),
        Layer(f"{DIFFERENCE}{of}", f"difference{of}, MSE {mse:.4f}", colour_difference(np.abs(apart).mean(axis=-1))),
        mse,
    )


def make_light_layer(name: str, caption: str, exposed: F32) -> Layer:
    """A layer of exposed linear radiance, (H, W, 3)."""
    return Layer(name, caption, display(exposed, 1.0), exposed)


def _list_inputs(contents: ReportContents, row: int) -> Iterator[Layer]:
    """The buffers that every network is given, and the guides that the first one is given too."""
    buffers, guides = contents.inputs[row]
    yield Layer("albedo", "albedo", draw_albedo(buffers.albedo))
    yield Layer("normal", "normal", draw_normal(buffers.normal))
    yield Layer("depth", "depth", draw_depth(buffers.depth))
    for field, name in OF_GUIDES.items() if guides else ():
        values: F32 = getattr(guides, field)
        if field in RADIANCE:
            layer = make_light_layer(name, name, np.float32(contents.card.spec.exposure) * values)
        else:
            layer = Layer(name, name, draw_albedo(values if values.ndim == 3 else values[..., None].repeat(3, axis=2)))
        if layer.picture.std() > VARIED:
            yield layer


def write_legend(contents: ReportContents) -> str:
    """The legend of the pictures, in sentences."""
    others = "" if not contents.worst else f", and the worst ones of {contents.entries[0].name}, found automatically"
    return (
        "No training saw these views: the one with the median error of those shown, the first of the first held-out "
        f"configurations{others}. Shown as clip(2^EV · exposure · I, 0, 1)^(1/2.2). Differences, to what the "
        f"prediction is held against, go from black (0) over red to pale yellow ({LARGEST:g} and more)."
    )


def colour_difference(difference: F32) -> Picture:
    """Differences (H, W) as colours (H, W, 3), from black at 0 over red to pale yellow at `LARGEST` and above."""
    import matplotlib as mpl

    shades = mpl.colormaps["magma"](np.clip(difference / LARGEST, 0, 1), bytes=True)
    picture: Picture = np.ascontiguousarray(shades[..., :3])
    return picture
