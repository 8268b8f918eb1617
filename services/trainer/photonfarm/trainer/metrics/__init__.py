"""The quality of images: the columns of the paper's tables, and further ones of ours [supplement 4]."""

from photonfarm.trainer.metrics.fid import Fid, fid, kid
from photonfarm.trainer.metrics.image_metrics import (
    HEADLINE_BLOCK,
    ImageMetrics,
    PerImage,
    confidence_interval,
    feature_l1,
    flip,
    format_with_interval,
    measure_images,
    metric_space,
    mse,
    mssim,
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
    "format_with_interval",
    "kid",
    "load_inception",
    "measure_images",
    "metric_space",
    "mse",
    "mssim",
]
