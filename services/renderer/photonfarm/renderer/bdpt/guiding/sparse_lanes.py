"""The lanes of launches in which a guide is learned: fewer eye paths than pixels."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from photonfarm.renderer.bdpt import randomness
from photonfarm.renderer.bdpt.launches import Lanes


@dataclass(slots=True)
class SparseLanes(Lanes):
    """Lanes of which only some pixels of each image have an eye path, spread evenly over the image."""

    eyes: int = 1  # eye paths of one image

    @property
    def kind(self) -> tuple[int | bool, ...]:
        """The numbers that the kernels are made for."""
        return self.images, self.width, self.height, self.eyes, self.light_paths, self.poses is not None

    def thin(self, eyes: int) -> None:
        """Have so many eye paths in each image, at most one for each pixel."""
        self.eyes = min(eyes, self.pixels)
        self.eye_scale = dr.opaque(mi.Float, self.pixels / self.eyes)

    def eye(self) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
        """(image, sample, pixel) of each eye path's lane: a random pixel of an equal share of them."""
        lane = dr.arange(mi.UInt32, self.images * self.eyes)
        image = lane // self.eyes
        k = lane - image * self.eyes
        sequence = randomness.stream(dr.gather(mi.UInt32, self.keys, image), randomness.PIXELS)
        u = randomness.sampler(sequence, k).next_independent()
        pixel = mi.UInt32((mi.Float64(k) + mi.Float64(u)) * (self.pixels / self.eyes))
        return image, dr.zeros(mi.UInt32, dr.width(lane)), dr.minimum(pixel, self.pixels - 1)
