"""The sensor's side of light tracing, and the sensors and films that this integrator accepts.

Estimates are summed over the pixels of several images in device memory, and put into Mitsuba's film at the end.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import drjit as dr
import mitsuba as mi

from photonfarm.renderer.bdpt.randomness import Sampler

NoteSplat: TypeAlias = "Callable[[mi.Point2f, mi.Spectrum, mi.Bool], None]"
"""A function of places in the crop window, what is added there if each pixel has one light path, and which is."""

SENSORS = ("PerspectiveCamera", "ThinLensCamera")


@dataclass(slots=True)
class SensorSample:
    """The lens seen from a surface point."""

    d: mi.Vector3f  # unit direction to the lens
    position: mi.Point2f  # where the film is hit, in pixels of the crop window
    weight: mi.Spectrum  # importance/r², normalised over the crop window
    area_density_over_cos: mi.Float  # p_cam/r², by which primary rays would find the surface, without its cosine
    start: mi.Point3f  # where primary rays through this film position begin (the near plane)
    valid: mi.Bool


def check_sensor(sensor: mi.Sensor, *, light_tracing: bool) -> None:
    """Raise ValueError unless the film is an hdrfilm with a box filter and light can hit the sensor."""
    film = sensor.film()
    if not film.rfilter().is_box_filter():
        raise ValueError(
            f"bdpt: the film's reconstruction filter is {film.rfilter().class_name()!r}; only the box filter is "
            "allowed, because any other divides by a random sum of weights, to which light splats do not belong: "
            "the image would be biased (most of all at its border); write <rfilter type='box'/> in the film"
        )
    if film.class_name() != "HDRFilm":
        raise ValueError(
            f"bdpt: the film is {film.class_name()!r}; only 'hdrfilm' is allowed, because samples and light "
            "splats are summed in one unnormalised RGB block; use an hdrfilm"
        )
    if light_tracing and sensor.class_name() not in SENSORS:
        raise ValueError(
            f"bdpt: the sensor is {sensor.class_name()!r}; light paths can be joined to 'perspective' and "
            "'thinlens' only, because other sensors in Mitsuba have no sample_direction; use one of these, or "
            "light_ratio=0 and connections=0"
        )


@dataclass(slots=True)
class EyeStart:
    """Where eye paths begin: the primary rays, their weights and their densities."""

    ray: mi.Ray3f
    weight: mi.Spectrum  # that the sensor gives it
    density: mi.Float  # of the direction, in solid angle over the crop window; 0 where light cannot hit the sensor
    before_ray: mi.Float  # distance from the pinhole (or the point of the aperture) to the ray's origin


def primary_rays(sensor: mi.Sensor, rng: Sampler, pixel: mi.UInt32, *, joined: bool) -> EyeStart:
    """Rays through uniform points of the given pixels, which are numbered row by row in the crop window.

    Their densities are found only where light is ``joined`` to the lens. As the filter is a box, a sample counts for
    the pixel that it was drawn in.
    """
    size = mi.ScalarVector2u(sensor.film().crop_size())
    row = pixel // size[0]
    corner = mi.Point2f(mi.Float(pixel - row * size[0]), mi.Float(row))
    position = corner + rng.next_2d()
    aperture = rng.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    ray, weight = sensor.sample_ray(0, 0, position / mi.ScalarVector2f(size), aperture)
    if not joined:
        return EyeStart(ray, weight, mi.Float(0), mi.Float(0))
    ahead = dr.minimum(sensor.near_clip(), 0.5 * ray.maxt)
    point = dr.zeros(mi.Interaction3f)
    point.p = dr.fma(ray.d, ahead, ray.o)
    ds, importance = sensor.sample_direction(point, aperture)
    return EyeStart(ray, weight, importance[0] * dr.square(ds.dist), dr.maximum(ds.dist - ahead, 0))


def sample_sensor(
    sensor: mi.Sensor, si: mi.SurfaceInteraction3f, aperture: mi.Point2f, active: mi.Bool
) -> SensorSample:
    """Join a surface point to the lens. Visibility is left to the caller: test the segment from ``si`` to ``start``.

    The segment ends where primary rays begin, so objects before the near plane do not cast shadows and points outside
    the clipping range are not seen, as is the case for primary rays (``thinlens`` does not check this itself).
    """
    film = sensor.film()
    ds, weight = sensor.sample_direction(si, aperture, active)
    ray, _ = sensor.sample_ray(0, 0, ds.uv / mi.ScalarVector2f(film.crop_size()), aperture, active)
    along = dr.dot(si.p - ray.o, ray.d)
    return SensorSample(
        d=ds.d,
        position=ds.uv,
        weight=weight,
        area_density_over_cos=weight[0],
        start=ray.o,
        valid=active & (weight[0] > 0) & (along > 0) & (along <= ray.maxt),
    )


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
    note: NoteSplat | None = None  # where a guide is learned

    def add(self, position: mi.Point2f, value: mi.Spectrum, active: mi.Bool) -> None:
        """Add ``value`` at ``position``, in pixels of the crop window; what falls outside is lost."""
        inside = active & dr.all((position >= 0) & (position < mi.ScalarVector2f(self.width, self.height)))
        pixel = mi.UInt32(position.y) * self.width + mi.UInt32(position.x)
        self.sums.add(self.offset + pixel, value * self.scale, 0, inside)
        if self.note is not None:
            self.note(position, value, inside)


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
