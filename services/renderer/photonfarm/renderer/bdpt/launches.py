"""Which eye and light paths are traced in one launch, and which lane is which."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import drjit as dr
import mitsuba as mi

from photonfarm.renderer.bdpt.poses import PosedSensor, Poses

LAUNCH_PATHS = 1 << 20
"""The most eye or light paths of one image traced at once, unless one sample of each pixel needs more.

Images follow from it, as eye paths are joined to light paths of their own launch: another number gives other images of
the same mean. The number of images in a launch changes no image.
"""

SQUARE = 4
"""The edge of the squares of pixels whose eye paths a packet of 16 lanes traces."""


@dataclass(frozen=True, slots=True)
class Launch:
    """Which images are traced together, and which samples of each of their pixels."""

    images: int
    first_image: int
    samples: int  # of one pixel
    first_sample: int
    light_paths: int  # for one image
    first_light_path: int


def images_at_once(pixels: int, spp: int, light_ratio: float, paths_at_once: int) -> int:
    """The number of images that share a launch of at most ``paths_at_once`` eye or light paths; at least one."""
    return max(1, paths_at_once // (_paths(pixels, light_ratio) * _samples_at_once(pixels, spp, light_ratio)))


def launches(
    images: int, pixels: int, spp: int, light_ratio: float, paths_at_once: int = LAUNCH_PATHS
) -> Iterator[Launch]:
    """The launches of some images: several images share one as ``paths_at_once`` allows, a large one is split."""
    together = min(images, images_at_once(pixels, spp, light_ratio, paths_at_once))
    samples = _samples_at_once(pixels, spp, light_ratio)
    for first_image in range(0, images, together):
        for first_sample in range(0, spp, samples):
            last_sample = min(first_sample + samples, spp)
            first_light, last_light = (_light_paths(pixels * s, light_ratio) for s in (first_sample, last_sample))
            yield Launch(
                min(together, images - first_image),
                first_image,
                last_sample - first_sample,
                first_sample,
                last_light - first_light,
                first_light,
            )


def _paths(pixels: int, light_ratio: float) -> int:
    """The number of eye paths for one sample of each pixel, or of light paths if these are more."""
    return int(pixels * max(1.0, light_ratio))


def _samples_at_once(pixels: int, spp: int, light_ratio: float) -> int:
    """The samples of each pixel that one launch traces of an image."""
    return max(1, min(spp, LAUNCH_PATHS // _paths(pixels, light_ratio)))


def _light_paths(eye_paths: int, light_ratio: float) -> int:
    """The number of light paths for the first ``eye_paths`` of an image: at least one if there is any."""
    return max(int(eye_paths > 0), round(eye_paths * light_ratio)) if light_ratio else 0


@dataclass(slots=True)
class Lanes:
    """A launch as its kernels see it: the numbers that shape them as integers, those that may differ as data.

    Lanes go image after image, sample after sample, pixel after pixel: neighbours see neighbouring pixels, squares of
    4 × 4 together where the window consists of such squares. Rays of a packet then meet the same surfaces more often.
    """

    images: int
    width: int  # of the crop window, pixels
    height: int
    samples: int  # of one pixel
    light_paths: int  # for one image
    keys: mi.UInt32  # one for each image: see randomness.image_keys
    shifts: mi.UInt32 | None  # see randomness.shifts; None without connections
    counts: list[mi.UInt32]  # (pixels, samples, light paths), [1] each: the integers above once more
    first_sample: mi.UInt32  # [1]
    first_light_path: mi.UInt32  # [1]
    eye_scale: mi.Float  # [1]: 1 over all samples per pixel
    splat_scale: mi.Float  # [1]: eye paths per light path over all samples per pixel
    poses: Poses | None  # of the images' cameras; None: all are the sensor's

    @classmethod
    def of(
        cls,
        launch: Launch,
        size: tuple[int, int],
        spp: int,
        keys: mi.UInt32,
        shifts: mi.UInt32 | None,
        poses: Poses | None = None,
    ) -> Self:
        """The lanes of a launch whose images have the size ``size`` (W, H) and get ``spp`` samples per pixel in all."""
        pixels = size[0] * size[1]
        ratio = pixels * launch.samples / launch.light_paths if launch.light_paths else 0
        return cls(
            launch.images,
            *size,
            launch.samples,
            launch.light_paths,
            keys,
            shifts,
            counts=[dr.opaque(mi.UInt32, n) for n in (pixels, launch.samples, launch.light_paths)],
            first_sample=dr.opaque(mi.UInt32, launch.first_sample),
            first_light_path=dr.opaque(mi.UInt32, launch.first_light_path),
            eye_scale=dr.opaque(mi.Float, 1 / spp),
            splat_scale=dr.opaque(mi.Float, ratio / spp),
            poses=poses,
        )

    @property
    def kind(self) -> tuple[int | bool, ...]:
        """The numbers that the kernels are made for."""
        return self.images, self.width, self.height, self.samples, self.light_paths, self.poses is not None

    @property
    def has_connections(self) -> bool:
        """Whether eye paths of the launch are connected to light paths."""
        return self.shifts is not None

    @property
    def pixels(self) -> int:
        """The number of pixels of one image."""
        return self.width * self.height

    def place(self, sensor: mi.Sensor, image: mi.UInt32) -> mi.Sensor | PosedSensor:
        """The sensor of the images that lanes belong to."""
        return sensor if self.poses is None else PosedSensor(sensor, self.poses, image)

    def eye(self) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
        """(image, sample, pixel) of each eye path's lane."""
        lane = dr.arange(mi.UInt32, self.images * self.samples * self.pixels)
        pixels, samples, _ = self.counts
        layer = lane // pixels
        image = layer // samples if self.images > 1 else dr.zeros(mi.UInt32, dr.width(lane))
        return image, layer - image * samples, self._order_in_squares(lane - layer * pixels)

    def _order_in_squares(self, place: mi.UInt32) -> mi.UInt32:
        """The pixel at a place of the order."""
        if self.width % SQUARE or self.height % SQUARE:
            return place
        strip = place // (SQUARE * self.width)
        along = place - strip * (SQUARE * self.width)
        square, inside = along // SQUARE**2, along % SQUARE**2
        return (strip * SQUARE + inside // SQUARE) * self.width + square * SQUARE + inside % SQUARE

    def partner(self, sample: mi.UInt32, u: mi.Float) -> mi.UInt32:
        """The slot whose light path an eye path is joined to, before the shift (see randomness.shifts).

        Each sample number has an equal share of the slots for itself, in which ``u`` in [0, 1) is the place (see
        randomness.places). Every choice is unbiased, as the shift is uniform over all slots.
        """
        _, samples, paths = self.counts
        share = dr.maximum(paths // samples, 1)
        return sample * share + mi.UInt32(mi.Float64(u) * mi.Float64(share))

    def light(self) -> tuple[mi.UInt32, mi.UInt32]:
        """(image, number within the image) of each light path's lane."""
        lane = dr.arange(mi.UInt32, self.images * self.light_paths)
        image = lane // self.counts[2] if self.images > 1 else dr.zeros(mi.UInt32, dr.width(lane))
        return image, lane - image * self.counts[2]
