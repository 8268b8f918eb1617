"""The quality of images: the columns of the paper's tables, and further ones of ours [supplement 4]."""

from photonfarm.trainer.metrics.feature_l1 import HEADLINE_BLOCK, feature_l1
from photonfarm.trainer.metrics.fid import Fid, fid, kid
from photonfarm.trainer.metrics.flip import flip
from photonfarm.trainer.metrics.image_metrics import ImageMetrics, image_metrics, reference_features
from photonfarm.trainer.metrics.inception import Features, FIDInceptionV3, Inception, load_inception
from photonfarm.trainer.metrics.inception_weights import InceptionWeights, find_weights
from photonfarm.trainer.metrics.intervals import PerImage, confidence_interval
from photonfarm.trainer.metrics.metric_space import metric_space
from photonfarm.trainer.metrics.mse import mse
from photonfarm.trainer.metrics.mssim import mssim

__all__ = [
    "HEADLINE_BLOCK",
    "FIDInceptionV3",
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
