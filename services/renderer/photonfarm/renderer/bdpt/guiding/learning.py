"""Learns a guide: from what light paths of default sampling add to some images, by the cell that they started in."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from photonfarm.renderer.bdpt.film import ImageStack
from photonfarm.renderer.bdpt.guiding.densities import gains
from photonfarm.renderer.bdpt.guiding.sparse_lanes import SparseLanes
from photonfarm.renderer.bdpt.guiding.starts import Layout, StartGuide
from photonfarm.renderer.bdpt.guiding.tally import Tally, column_of, tiles_of
from photonfarm.renderer.bdpt.launches import Launch

EPSILON = 1e-2
"""So that dark pixels do not count without bound; as in the pilot."""

SHARE = 32
"""The eye paths of an image for each eye path from which its guide is learned…"""

LIMITS = 1024, 65536
"""…and the least and the most of these."""


@dataclass(frozen=True, slots=True)
class Effort:
    """The paths from which a guide is learned, over all images."""

    eye_paths: int = 4096
    light_paths: int = 8192

    @classmethod
    def of_image(cls, eye_paths: int, light_ratio: float) -> Effort:
        """A few per cent of the work of an image of so many eye paths; one of few sizes, as each has its kernels."""
        eyes = int(np.clip(2 ** np.round(np.log2(eye_paths / SHARE)), *LIMITS))
        return cls(eyes, eyes * int(2 ** np.round(np.log2(np.clip(2 * light_ratio, 2, 16)))))

    def launch(self, images: int) -> Launch:
        """The launch that learns from so many images."""
        return Launch(images, 0, 1, 0, max(1, self.light_paths // images), 0)


def learned(layout: Layout, probability: mi.Float, images: ImageStack, tally: Tally, lanes: SparseLanes) -> StartGuide:
    """The guide that the images and the tally of a launch suggest, given default probabilities of lights [N]."""
    tiles = tiles_of(lanes.images)
    weight = _weights(images.radiance, lanes, tiles)
    columns = lanes.images * tiles**2
    column = dr.arange(mi.UInt32, layout.cells * columns) % columns
    sums = dr.block_sum(tally.squares * dr.gather(mi.Float, weight, column), columns)
    found = [np.array(values, np.float64) for values in (sums, tally.starts, tally.edges, probability)]
    return StartGuide.of(layout, gains(layout, *found))


def _weights(radiance: mi.Spectrum, lanes: SparseLanes, tiles: int) -> mi.Float:
    """What the variance of pixels counts for in the error, for each tile of images [V·H·W]; 0 in black images."""
    pixel = dr.arange(mi.UInt32, dr.width(radiance))
    image = pixel // lanes.pixels
    within = pixel - image * lanes.pixels
    row = within // lanes.width
    x, y = (mi.Float(within - row * lanes.width) + 0.5) / lanes.width, (mi.Float(row) + 0.5) / lanes.height
    column = column_of(image, x, y, tiles)
    grey, pixels = (dr.zeros(mi.Float, lanes.images * tiles**2) for _ in range(2))
    dr.scatter_add(grey, (radiance[0] + radiance[1] + radiance[2]) / 3, column)
    dr.scatter_add(pixels, 1, column)
    grey /= dr.maximum(pixels, 1)
    mean = dr.repeat(dr.block_sum(grey, tiles**2), tiles**2) / tiles**2
    level = dr.square(grey) + EPSILON * dr.square(mean)
    return dr.select(level > 0, dr.rcp(level), 0)
