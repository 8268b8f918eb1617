"""The share of light that a surface reflects or transmits by lobes other than the diffuse one.

The BSDF evaluates these lobes alone, by the context's `type_mask`. Subtracting the diffuse reflectance from the total
would not work: the coat of a plastic leaves its base less light, so the difference is too small, and often below 0.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from photonfarm.renderer.scene.gbuffer import diffuse_reflectance
from photonfarm.renderer.scene.guides.pattern import STEPS, SUB_PIXELS

BSDF_SAMPLES = 2
"""The samples of each ray, for the directional albedo."""


def specular_of(bsdf: Any, si: Any, hit: Any, diffuse_kept: Any) -> Any:
    """The directional albedo of all lobes but the diffuse one, 0 if there are none; it may be below 0 for `principled`.

    `diffuse_kept` is that of `Materials`. The albedo is a share of the light's power: radiance in glass is larger by
    the square of the refractive index.
    """
    flags, context = bsdf.flags(), mi.BSDFContext(mi.TransportMode.Importance)
    context.type_mask = int(mi.BSDFFlags.All) & ~int(mi.BSDFFlags.Diffuse)
    other = mi.has_flag(flags, mi.BSDFFlags.Delta) | mi.has_flag(flags, mi.BSDFFlags.Glossy)
    sampled = hit & other
    total = mi.Color3f(0)
    within = dr.arange(mi.UInt32, dr.width(hit)) % SUB_PIXELS
    for sample in range(BSDF_SAMPLES):
        u = [dr.fma(mi.Float(within * BSDF_SAMPLES + sample), step, 0.5) for step in STEPS]
        u = [x - dr.floor(x) for x in u]
        _, weight = bsdf.sample(context, si, u[0], mi.Point2f(u[1], u[2]), sampled)
        total += dr.select(sampled, weight, 0)
    return total / BSDF_SAMPLES - dr.select(sampled, diffuse_kept * diffuse_reflectance(si, sampled), 0)
