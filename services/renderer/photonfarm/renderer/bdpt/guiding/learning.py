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
from photonfarm.renderer.bdpt.guiding.tally import Tally
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


def learned(
    layout: Layout, probability: mi.Float, images: ImageStack, squares: mi.Float, starts: mi.Float, lanes: SparseLanes
) -> StartGuide:
    """The guide that the images and the tally of a launch suggest, given default probabilities of lights [N]."""
    width, height, radiance = lanes.width, lanes.height, images.radiance
    tally = Tally(squares, starts, Tally.tiles_of(lanes.images), lanes.images)
    pixel = dr.arange(mi.UInt32, dr.width(radiance))
    image = pixel // (width * height)
    within = pixel - image * (width * height)
    row = within // width
    x, y = (mi.Float(within - row * width) + 0.5) / width, (mi.Float(row) + 0.5) / height
    columns = tally.images * tally.tiles**2
    grey, pixels = dr.zeros(mi.Float, columns), dr.zeros(mi.Float, columns)
    column = tally.column(image, x, y)
    dr.scatter_add(grey, (radiance[0] + radiance[1] + radiance[2]) / 3, column)
    dr.scatter_add(pixels, 1, column)
    grey /= dr.maximum(pixels, 1)
    of_image = tally.tiles**2
    mean = dr.repeat(dr.block_sum(grey, of_image), of_image) / of_image
    level = dr.square(grey) + EPSILON * dr.square(mean)
    weight = dr.select(level > 0, dr.rcp(level), 0)
    column = dr.arange(mi.UInt32, layout.cells * columns) % columns
    sums = dr.block_sum(tally.squares * dr.gather(mi.Float, weight, column), columns)
    found = [np.array(values, np.float64) for values in (sums, tally.starts, probability)]
    return StartGuide.of(layout, gains(layout, *found))
