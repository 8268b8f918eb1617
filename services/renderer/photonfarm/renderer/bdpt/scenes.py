"""The variants of Mitsuba and the scenes that this integrator accepts, and how large scenes are."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

UNSAMPLED = {"Instance": "an instance", "BSplineCurve": "a curve", "LinearCurve": "a curve"}
"""The classes of shapes whose surfaces Mitsuba cannot sample, in words; it fails if a scene has any of them."""


def require_variant() -> str:
    """The active variant's name; raises RuntimeError if none is set, ValueError for one the integrator cannot use."""
    variant = mi.variant()
    if variant is None:
        raise RuntimeError(
            "photonfarm.renderer.bdpt: no Mitsuba variant is set, and its types are bound on import; "
            "call mitsuba.set_variant('llvm_ad_rgb') before importing this package"
        )
    unsupported = [word for word in ("scalar", "spectral", "polarized") if word in variant]
    if unsupported:
        raise ValueError(
            f"photonfarm.renderer.bdpt: variant {variant!r} is {unsupported[0]}; the integrator needs a vectorised, "
            "unpolarised RGB variant, because its loops are traced by Dr.Jit and its light paths carry neither "
            "wavelengths nor Mueller matrices; use 'llvm_ad_rgb' or 'cuda_ad_rgb'"
        )
    return str(variant)


def check_scene(scene: mi.Scene, *, light_paths: bool) -> None:
    """Raise ValueError for media and for lights that shine along their normal only.

    Where there are ``light_paths``, also for scenes that have both area lights and shapes without area sampling.
    """
    shapes = scene.shapes()
    for shape in shapes:
        if shape.interior_medium() is not None or shape.exterior_medium() is not None:
            raise ValueError(
                f"bdpt: shape {shape.id()!r} bounds a participating medium; only surfaces are allowed, because "
                "neither sub-path samples distances in a medium; remove the medium, or render with 'volpath'"
            )
        if shape.is_emitter() and shape.emitter().class_name() == "DirectionalArea":
            raise ValueError(
                f"bdpt: shape {shape.id()!r} is a 'directionalarea' light; no camera path can find it, and light "
                "paths would need a density of their own; use 'directional', or render with 'ptracer'"
            )
    unsampled = next((shape for shape in shapes if shape.class_name() in UNSAMPLED), None)
    if light_paths and unsampled is not None and any(shape.is_emitter() for shape in shapes):
        raise ValueError(
            f"bdpt: the scene has area lights and shape {unsampled.id()!r}, {UNSAMPLED[unsampled.class_name()]}; light "
            "paths cannot start in it, because Mitsuba cannot sample a shape's surface where some shapes are of this "
            "kind; use light_ratio=0 and connections=0"
        )


def bounding_box(scene: mi.Scene) -> mi.ScalarBoundingBox3f:
    """The scene's bounding box, or that of a unit sphere where there is no shape."""
    box = scene.bbox()
    return box if box.valid() and scene.shapes() else mi.ScalarBoundingBox3f([-1, -1, -1], [1, 1, 1])


def bounding_sphere(scene: mi.Scene) -> tuple[mi.Point3f, mi.Float]:
    """(centre, radius) of a sphere around everything, as data: an object that moves past it recompiles nothing."""
    sphere = bounding_box(scene).bounding_sphere()
    radius = max(float(sphere.radius) * (1 + 1e-3), 1e-6)
    return mi.Point3f(*(dr.opaque(mi.Float, float(sphere.center[k])) for k in range(3))), dr.opaque(mi.Float, radius)
