"""The metrics of one predictor's images against their references: a row of the tables [supplement 4, Tables 1 and 2].

Images are given as exposed linear radiance (radiance × the scene's fixed exposure) and compared in the metric space:
the values that a display would show [method §4, ours]. MSSIM: Wang et al., Image quality assessment, 2004. FLIP, how
strongly a viewer who flips between two images sees them differ: Andersson et al., 2020. Feature L1: the distance of two
images in the averaged features of an Inception block [supplement Fig. 5]. Means have 95 % confidence intervals.

Shape letters: N images, H W image, C channels or features.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from photonfarm.core.errors import SpecError
from photonfarm.core.pictures import display_values
from photonfarm.core.records import F32
from photonfarm.core.statistics import Estimate, group_means
from photonfarm.trainer.metrics.features import FEWEST, Features, Fid, Inception, InceptionWeights, fid, kid

NORMAL_975 = 1.959963984540054
"""The 97.5 % quantile of the normal distribution."""


@dataclass(frozen=True, slots=True)
class PerImage:
    """A metric of each image."""

    estimate: Estimate  # over groups: the images of one group are not independent
    interval: tuple[float, float] | None  # 95 %, by Student's t; None for a single group
    values: tuple[float, ...]  # one for each image, in their order

    @classmethod
    def of(cls, values: NDArray[np.float64], groups: Sequence[Hashable] | None = None) -> PerImage:
        """The mean and interval of one value per image (N,); `groups` are independent, by default single images."""
        estimate = Estimate.of(values if groups is None else group_means(values, groups))
        return cls(estimate, confidence_interval(estimate), tuple(values.tolist()))


def format_with_interval(estimate: Estimate | None, digits: int) -> str:
    """Mean and 95 % interval, as far as they are known."""
    if estimate is None:
        return NOT_AVAILABLE
    interval = confidence_interval(estimate)
    reach = "" if interval is None else f" ({interval[0]:.{digits}f} … {interval[1]:.{digits}f})"
    return f"{estimate.mean:.{digits}f}{reach}"


def confidence_interval(estimate: Estimate) -> tuple[float, float] | None:
    """The two-sided 95 % interval of an estimate's mean; None if the standard error is unknown."""
    if estimate.standard_error is None:
        return None
    reach = t_975(estimate.count - 1) * estimate.standard_error
    return estimate.mean - reach, estimate.mean + reach


def t_975(freedom: int) -> float:
    """The 97.5 % quantile of Student's t, within 0.2 % for every number of degrees of freedom ≥ 1.

    Closed forms for 1 and 2, the expansion in 1/ν above [Abramowitz and Stegun 26.7.5].
    """
    if freedom < 1:
        raise ValueError(f"freedom is {freedom}; Student's t has at least one degree of freedom")
    if freedom == 1:
        return math.tan(0.475 * math.pi)
    if freedom == 2:
        return 0.95 * math.sqrt(2 / (1 - 0.95**2))
    z = NORMAL_975
    terms = (
        (z**3 + z) / 4,
        (5 * z**5 + 16 * z**3 + 3 * z) / 96,
        (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384,
        (79 * z**9 + 776 * z**7 + 1482 * z**5 - 1920 * z**3 - 945 * z) / 92160,
    )
    return z + sum(term / freedom ** (power + 1) for power, term in enumerate(terms))


def metric_space(exposed: F32 | Tensor) -> Tensor:
    """clip(I, 0, 1)^(1/2.2) of exposed linear radiance, (N, H, W, 3) → float32 of the same shape in [0, 1].

    The exposure is fixed per scene: one derived from an image would hide errors of brightness. Infinite values become
    white. Raises ValueError for another shape, SpecError for values that are not numbers.
    """
    if isinstance(exposed, Tensor):
        exposed = exposed.detach().float().cpu().numpy()
    images = np.asarray(exposed, np.float32)
    if images.ndim != 4 or images.shape[-1] != 3:
        raise ValueError(f"images have the shape {images.shape}; metrics are taken of (N, H, W, 3)")
    if len(spoilt := np.flatnonzero(np.isnan(images).any(axis=(1, 2, 3)))):
        raise SpecError(
            f"image {int(spoilt[0])} of {len(images)} holds values that are not numbers, so it has no error; "
            "a network that gives them has diverged: take an earlier checkpoint"
        )
    return torch.from_numpy(display_values(images))


def check_pairs(predictions: Tensor, references: Tensor) -> None:
    """Raise ValueError unless both are as many images of the same size, one reference per prediction."""
    if predictions.shape != references.shape:
        raise ValueError(
            f"predictions have the shape {tuple(predictions.shape)} and references {tuple(references.shape)}; "
            "each prediction is compared with the reference of its own view"
        )


HEADLINE_BLOCK = 3
"""The block of the tables' column; Fig. 5 shows all four."""


def feature_l1(predictions: Features, references: Features) -> list[NDArray[np.float64]]:
    """Mean |f − g| over the C spatially averaged features of each pair of images: (N,) for each of the four blocks."""
    return [np.abs(f.astype(np.float64) - g).mean(axis=1) for f, g in zip(predictions, references, strict=True)]


def flip(predictions: Tensor, references: Tensor) -> NDArray[np.float64]:
    """Mean FLIP (low dynamic range) of each pair of display images, 2 × (N, H, W, 3) → (N,); 0 is equality, 1 the most.

    The authors' package computes it for its default viewer: 67 pixels per degree. It takes display values as sRGB.
    """
    from flip_evaluator import evaluate  # type: ignore[import-untyped]

    check_pairs(predictions, references)
    pairs = zip(predictions.float().cpu().numpy(), references.float().cpu().numpy(), strict=True)
    return np.array(
        [evaluate(reference, image, "LDR", applyMagma=False, parameters={})[1] for image, reference in pairs],
        np.float64,
    )


WINDOW = 11  # pixels
SIGMA = 1.5  # pixels
C1, C2 = 0.01**2, 0.03**2  # (K · data range)², the data range being 1


def mssim(predictions: Tensor, references: Tensor) -> NDArray[np.float64]:
    """SSIM of each pair of display images averaged over windows and channels, 2 × (N, H, W, 3) → (N,).

    Windows are 11×11 Gaussians of σ 1.5 that lie in the image whole; variances are those of the population; colour
    channels are compared one by one. 1 is equality. Raises ValueError for images smaller than a window.
    """
    check_pairs(predictions, references)
    if min(predictions.shape[1:3]) < WINDOW:
        size = "×".join(map(str, predictions.shape[1:3]))
        raise ValueError(f"images are {size} pixels; MSSIM needs at least {WINDOW}×{WINDOW}, the size of its window")
    x, y = (images.movedim(-1, 1).double() for images in (predictions, references))
    mean_x, mean_y, square_x, square_y, product = (_blur(image) for image in (x, y, x * x, y * y, x * y))
    variance_x, variance_y, covariance = square_x - mean_x**2, square_y - mean_y**2, product - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + C1) / (mean_x**2 + mean_y**2 + C1)
    structure = (2 * covariance + C2) / (variance_x + variance_y + C2)  # and contrast: C3 = C2 / 2
    similarity: NDArray[np.float64] = (luminance * structure).mean((1, 2, 3)).cpu().numpy()
    return similarity


def _blur(images: Tensor) -> Tensor:
    """Gaussian means over whole windows: (N, C, H, W) → (N, C, H − 10, W − 10).

    Rows, then columns, as sums of shifted images: a seventh of the time of float64 convolutions on a CPU.
    """
    weight = [math.exp(-((i - WINDOW // 2) ** 2) / (2 * SIGMA**2)) for i in range(WINDOW)]
    for axis in (2, 3):
        room = images.shape[axis] - WINDOW + 1
        blurred = torch.zeros_like(images.narrow(axis, 0, room))
        for i, w in enumerate(weight):
            blurred.add_(images.narrow(axis, i, room), alpha=w / sum(weight))
        images = blurred
    return images


def mse(
    predictions: Tensor, references: Tensor, other_halves: Tensor | None = None, *, having_seen_a: bool = False
) -> NDArray[np.float64]:
    """Mean squared difference of each pair of display images, 2 × (N, H, W, 3) → (N,) [supplement 4].

    With references in two independent halves it is mean (f − A)(f − B), whose noise averages to nothing; the remaining
    bias is the shift of their noise by the display's curve, of second order. It may be negative below the noise. For
    predictions that depend on a part of A it is mean f² − 2fB + AB, as in `clean_error_having_seen_a`. Raises
    ValueError for shapes that do not match.
    """
    halves = references, references if other_halves is None else other_halves
    for half in halves:
        check_pairs(predictions, half)
    f, a, b = (images.double() for images in (predictions, *halves))
    product = f * (f - 2 * b) + a * b if having_seen_a else (f - a) * (f - b)
    errors: NDArray[np.float64] = product.mean((1, 2, 3)).cpu().numpy()
    return errors


CHUNK = 8  # images at a time
TITLES = {
    "mse": "MSE",
    "mssim": "MSSIM",
    "fid": "FID",
    **{f"feature-l1-{block}": f"Feature L1, Inception block {block}" for block in range(4)},
    "kid": "KID",
    "flip": "FLIP",
}
"""The metrics by name: those of Fig. 5 of the supplement, and further ones of ours."""
HEADLINE = f"feature-l1-{HEADLINE_BLOCK}"
NOT_AVAILABLE = "n/a"


@dataclass(frozen=True, slots=True)
class ImageMetrics:
    """Metrics in the metric space; `dataclasses.asdict` converts it for JSON."""

    images: int
    mse: PerImage
    mssim: PerImage
    flip: PerImage
    feature_l1: tuple[PerImage, ...] | None  # of Inception blocks 0 to 3; None without Inception's weights
    fid: Fid | None  # None without Inception's weights, or below three images
    kid: Estimate | None
    inception: InceptionWeights | None  # the weights of these three

    def estimates(self) -> dict[str, Estimate]:
        """The metrics that are available, by their names in `TITLES`; FID has no standard error."""
        estimates = {name: getattr(self, name).estimate for name in ("mse", "mssim", "flip")}
        estimates |= {f"feature-l1-{block}": each.estimate for block, each in enumerate(self.feature_l1 or ())}
        estimates |= {"fid": Estimate(self.fid.value, None, self.fid.predictions)} if self.fid else {}
        return estimates | ({"kid": self.kid} if self.kid else {})


def measure_images(
    predictions: F32 | Tensor,
    references: F32 | Tensor,
    inception: Inception | None,
    groups: Sequence[Hashable] | None = None,
    halves: tuple[F32, F32] | None = None,
    *,
    having_seen_a: bool = False,
    wanted_features: Features | None = None,
) -> ImageMetrics:
    """All metrics of exposed linear images, 2 × (N, H, W, 3), N ≥ 1; reference i is the converged view of prediction i.

    With two independent `halves` of the references, 2 × (N, H, W, 3), their noise is taken out of the MSE, also for
    predictions that depend on a part of the first; it remains in all other metrics, which have no such estimate.
    Intervals are over images, or over `groups` of them such as configurations, if one is named per image.
    `wanted_features` are `Inception.features` of the references in the metric space, if known. Raises ValueError for
    shapes that do not match, SpecError for values that are not numbers.
    """
    shown, wanted = metric_space(predictions), metric_space(references)
    check_pairs(shown, wanted)
    a, b = (metric_space(half) for half in halves) if halves else (wanted, wanted)

    def each(metric: Callable[..., NDArray[np.float64]], *against: Tensor) -> PerImage:
        chunks = (slice(start, start + CHUNK) for start in range(0, len(shown), CHUNK))
        values = [metric(shown[chunk], *(images[chunk] for images in against)) for chunk in chunks]
        return PerImage.of(np.concatenate(values), groups)

    of_images = each(partial(mse, having_seen_a=having_seen_a), a, b), each(mssim, wanted), each(flip, wanted)
    if inception is None:
        return ImageMetrics(len(shown), *of_images, None, None, None, None)
    features = inception.features(shown, CHUNK)
    if wanted_features is None:
        wanted_features = inception.features(wanted, CHUNK)
    blocks = tuple(PerImage.of(values, groups) for values in feature_l1(features, wanted_features))
    last = features[-1], wanted_features[-1]
    few = len(shown) < FEWEST
    sets = None if few else fid(*last), None if few else kid(*last)
    return ImageMetrics(len(shown), *of_images, blocks, *sets, inception.weights)
