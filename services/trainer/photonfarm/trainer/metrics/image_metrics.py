"""A row of the tables: all metrics of one predictor's images against their references [supplement 4, Tables 1 and 2].

Shape letters: N images, H W image.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from photonfarm.shared.core.estimate import Estimate
from photonfarm.shared.core.records import F32
from photonfarm.trainer.metrics.feature_l1 import HEADLINE_BLOCK, feature_l1
from photonfarm.trainer.metrics.fid import FEWEST, Fid, fid, kid
from photonfarm.trainer.metrics.flip import flip
from photonfarm.trainer.metrics.inception import Features, Inception
from photonfarm.trainer.metrics.inception_weights import InceptionWeights
from photonfarm.trainer.metrics.intervals import PerImage
from photonfarm.trainer.metrics.metric_space import check_pairs, metric_space
from photonfarm.trainer.metrics.mse import mse
from photonfarm.trainer.metrics.mssim import mssim

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
        found = {name: getattr(self, name).estimate for name in ("mse", "mssim", "flip")}
        found |= {f"feature-l1-{block}": each.estimate for block, each in enumerate(self.feature_l1 or ())}
        found |= {"fid": Estimate(self.fid.value, None, self.fid.predictions)} if self.fid else {}
        return found | ({"kid": self.kid} if self.kid else {})

    def columns(self) -> dict[str, str]:
        """Column heads and their entries, `n/a` for a metric that is not available."""
        found = self.estimates()
        heads = {"mse": ("MSE", 5), "mssim": ("MSSIM", 4), "fid": ("FID", 2), "kid": ("KID", 5)}
        heads |= {HEADLINE: ("Feature L1", 4), "flip": ("FLIP", 4)}
        return {
            head: f"{found[name].mean:.{digits}f}" if name in found else NOT_AVAILABLE
            for name, (head, digits) in heads.items()
        }


def image_metrics(
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
    `wanted_features` are those of the references, if they are known (`reference_features`). Raises ValueError for
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
    of_shown = inception.features(shown, CHUNK)
    of_wanted = inception.features(wanted, CHUNK) if wanted_features is None else wanted_features
    blocks = tuple(PerImage.of(values, groups) for values in feature_l1(of_shown, of_wanted))
    sets = _set_metrics(of_shown, of_wanted)
    return ImageMetrics(len(shown), *of_images, blocks, *sets, inception.weights)


def reference_features(references: F32 | Tensor, inception: Inception) -> Features:
    """The features that `image_metrics` needs of references (N, H, W, 3), whatever they are compared with."""
    return inception.features(metric_space(references), CHUNK)


def _set_metrics(predictions: Features, references: Features) -> tuple[Fid | None, Estimate | None]:
    if len(predictions.pool3) < FEWEST:
        return None, None
    return fid(predictions.pool3, references.pool3), kid(predictions.pool3, references.pool3)
