"""The quality of images: the columns of the paper's tables, and further ones of ours [supplement 4]."""

from photonfarm.trainer.metrics.fid import Fid, fid, kid
from photonfarm.trainer.metrics.image_metrics import (
    HEADLINE_BLOCK,
    ImageMetrics,
    PerImage,
    confidence_interval,
    feature_l1,
    flip,
    image_metrics,
    metric_space,
    mse,
    mssim,
    reference_features,
)
from photonfarm.trainer.metrics.inception import (
    Features,
    Inception,
    InceptionWeights,
    find_weights,
    load_inception,
)

__all__ = [
    "HEADLINE_BLOCK",
    "Features",
    "Fid",
    "ImageMetrics",
    "Inception",
    "InceptionWeights",
    "PerImage",
    "confidence_interval",
    "feature_l1",
    "fid",
    "find_weights",
    "flip",
    "image_metrics",
    "kid",
    "load_inception",
    "metric_space",
    "mse",
    "mssim",
    "reference_features",
]
