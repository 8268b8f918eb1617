"""The guides of a view, inputs of networks: emission, direct light, gloss, and what mirrors and glass show.

All are means over a regular grid of rays in each pixel, as albedo is. A ray that meets a surface of delta lobes alone
(a mirror, smooth glass, a null surface) is *followed* along the lobe that takes more than half of the light, to the
first surface that scatters otherwise. Light emitted on the way counts as seen; if the spec says so (`lights_in_glass`),
so do lights that the other lobe meets first, as a lamp that a glass ball reflects.

**Direct light** comes straight from lights to that surface and is reflected by its diffuse part: one sum over shadow
rays, with lights chosen as the integrator chooses them. Its points are one low-discrepancy set in each pixel, shifted
by a random vector of the pixel's own (Cranley and Patterson 1976), so that it is unbiased and independent of every
sample's radiance. All other guides do not depend on the seed.

**Gloss** is the reflection of the same light by all other lobes. Lobes may be narrow, and so the shadow rays are joined
by one ray along a sample of the BSDF, weighted by the balance heuristic [Veach and Guibas 1995]. It is the whole minus
the diffuse part, part of which a coat may absorb: so it may be below 0.

**Point light** is the irradiance of the cloud's first points by the same light, by 16 shadow rays each.

**Specular** is the directional albedo of all lobes but the diffuse one, by the BSDF's own sampling at fixed points: for
plastic the Fresnel reflectance of its coat, for glass 1, for a mask including the light that passes. **Roughness** is α
of the microfacet distribution as the material states it, the mean of a texture.

Shape letters: H W image, L lit points, N rays: pixel by pixel, and within a pixel row by row of its grid.
"""

from __future__ import annotations

from photonfarm.renderer.scene.guides.direct import FOLLOWED, GuideSettings, irradiance, point_light
from photonfarm.renderer.scene.guides.images import trace, view_guides

__all__ = ["FOLLOWED", "GuideSettings", "irradiance", "point_light", "trace", "view_guides"]
