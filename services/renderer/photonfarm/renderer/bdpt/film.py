"""Estimates are summed over the pixels of several images in device memory, and put into Mitsuba's film at the end."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


@dataclass(slots=True)
class Sums:
    """Sums over the pixels of a stack of images, as (R, G, B, share of primary rays that hit a surface).

    The four lie together, as Dr.Jit adds four neighbours at once in a quarter of the time that it takes one by one.
    """

    numbers: mi.Float  # [K·H·W·4]

    @classmethod
    def zero(cls, pixels: int) -> Sums:
        """Sums of nothing, for ``pixels`` pixels in all."""
        return cls(dr.zeros(mi.Float, 4 * pixels))

    def add(self, pixel: mi.UInt32, value: mi.Spectrum, hit: mi.Float | float, active: mi.Bool | bool = True) -> None:
        """Add to the pixels of these numbers in the stack."""
        dr.scatter_add(self.numbers, mi.Vector4f(*value, hit), pixel, active)

    def images(self) -> ImageStack:
        """The sums as images."""
        pixel = dr.arange(mi.UInt32, dr.width(self.numbers) // 4)
        total = dr.gather(mi.Vector4f, self.numbers, pixel)
        return ImageStack(mi.Spectrum(total.xyz), total.w)


@dataclass(slots=True)
class Splat:
    """A stack of images, to which what light paths send to the lens is added."""

    sums: Sums
    scale: mi.Float  # [1]: eye paths per light path over samples per pixel
    offset: mi.UInt32  # first pixel of the image that a lane's light path belongs to
    width: int  # of the crop window, pixels
    height: int

    def add(self, position: mi.Point2f, value: mi.Spectrum, active: mi.Bool) -> None:
        """Add ``value`` at ``position``, in pixels of the crop window; what falls outside is lost."""
        inside = active & dr.all((position >= 0) & (position < mi.ScalarVector2f(self.width, self.height)))
        pixel = mi.UInt32(position.y) * self.width + mi.UInt32(position.x)
        self.sums.add(self.offset + pixel, value * self.scale, 0, inside)


@dataclass(slots=True)
class ImageStack:
    """K images of one view."""

    radiance: mi.Spectrum  # [K·H·W]: mean over the samples of a pixel, with the light paths' share
    hit: mi.Float  # [K·H·W]: share of primary rays that hit a surface

    @classmethod
    def black(cls, pixels: int) -> ImageStack:
        """Black images of ``pixels`` pixels in all."""
        return cls(dr.zeros(mi.Spectrum, pixels), dr.zeros(mi.Float, pixels))

    def add(self, part: ImageStack, first_pixel: int) -> None:
        """Add a part of the samples to the pixels from ``first_pixel`` on."""
        if dr.width(part.hit) == dr.width(self.hit):
            self.radiance += part.radiance
            self.hit += part.hit
        else:
            pixel = dr.arange(mi.UInt32, dr.width(part.hit)) + dr.opaque(mi.UInt32, first_pixel)
            dr.scatter_add(self.radiance, part.radiance, pixel)
            dr.scatter_add(self.hit, part.hit, pixel)
        dr.eval(self.radiance, self.hit)

    def tensor(self, width: int, height: int) -> mi.TensorXf:
        """The radiance of the images [K, H, W, 3]."""
        return mi.TensorXf(dr.ravel(self.radiance), (dr.width(self.hit) // (width * height), height, width, 3))

    def put(self, film: mi.Film) -> None:
        """Put the image, of which there must be one, into a film, each pixel with weight 1."""
        width, height = film.crop_size()
        channels = [*self.radiance]
        if mi.has_flag(film.flags(), mi.FilmFlags.Alpha):
            channels.append(self.hit)
        channels.append(dr.ones(mi.Float, width * height))
        block = mi.TensorXf(dr.ravel(mi.ArrayXf(channels)), (height, width, len(channels)))
        film.put_block(mi.ImageBlock(block, film.crop_offset(), film.rfilter()))
