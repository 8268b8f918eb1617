"""How much of the light a surface reflects, or lets through, by its other lobes than the diffuse one."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from photonfarm.renderer.gbuffer import diffuse_reflectance
from photonfarm.renderer.guides.pattern import STEPS, SUB_PIXELS

BSDF_SAMPLES = 2
"""Of each ray, for the directional albedo."""


def specular_of(bsdf: Any, si: Any, hit: Any) -> Any:
    """Directional albedo less diffuse reflectance, where the BSDF has more than a diffuse lobe; may be below 0.

    That of the light's power: radiance in glass is larger by the square of the refractive index.
    """
    flags, context = bsdf.flags(), mi.BSDFContext(mi.TransportMode.Importance)
    other = mi.has_flag(flags, mi.BSDFFlags.Delta) | mi.has_flag(flags, mi.BSDFFlags.Glossy)
    sampled = hit & other
    total = mi.Color3f(0)
    within = dr.arange(mi.UInt32, dr.width(hit)) % SUB_PIXELS
    for sample in range(BSDF_SAMPLES):
        u = [dr.fma(mi.Float(within * BSDF_SAMPLES + sample), step, 0.5) for step in STEPS]
        u = [x - dr.floor(x) for x in u]
        _, weight = bsdf.sample(context, si, u[0], mi.Point2f(u[1], u[2]), sampled)
        total += dr.select(sampled, weight, 0)
    return total / BSDF_SAMPLES - dr.select(sampled, diffuse_reflectance(si, sampled), 0)
