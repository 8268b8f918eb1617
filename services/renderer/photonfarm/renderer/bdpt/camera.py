"""The sensor's side of light tracing, and the sensors and films that this integrator accepts."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from photonfarm.renderer.bdpt.randomness import Sampler

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
