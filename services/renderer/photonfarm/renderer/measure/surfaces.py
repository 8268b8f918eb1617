"""The kind of the first surface at each pixel's centre, by the lobes that its BSDF has.

Flags describe a whole BSDF and not a point on it: a blend or a `principled` whose glossy part is textured away
somewhere is glossy there too, and a two-sided surface has the lobes of both sides. A null lobe, which masks have beside
the lobes of what they mask, lets light pass unchanged, and does not count as a coat.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.scene.gbuffer import first_surfaces
from photonfarm.shared.core.frame_costs import Surface
from photonfarm.shared.scene.spec import SceneSpec
from photonfarm.shared.scene.view import Camera, View


def surface_kinds(scene: Any, view: View, spec: SceneSpec) -> NDArray[np.uint8]:
    """The kind of surface at each pixel's centre, (H, W) of `Surface`, between the view's clipping planes."""
    camera = Camera.of(view, spec)
    si = first_surfaces(scene, camera, camera.rays(), spec)
    kind = dr.select(si.shape.is_emitter(), mi.UInt32(Surface.EMITTER), _by_lobes(si.bsdf().flags()))
    found = np.array(dr.select(si.is_valid(), kind, int(Surface.NOTHING)))
    return found.astype(np.uint8).reshape(camera.height, camera.width)


def _by_lobes(flags: Any) -> Any:
    """The kind DIFFUSE, SPECULAR or MIRROR (UInt32), by a BSDF's flags."""
    diffuse = mi.has_flag(flags, mi.BSDFFlags.Diffuse)
    glossy = mi.has_flag(flags, mi.BSDFFlags.Glossy)
    delta = mi.has_flag(flags, mi.BSDFFlags.DeltaReflection) | mi.has_flag(flags, mi.BSDFFlags.DeltaTransmission)
    specular = glossy | (diffuse & delta)
    unmixed = dr.select(diffuse, mi.UInt32(Surface.DIFFUSE), mi.UInt32(Surface.MIRROR))
    return dr.select(specular, mi.UInt32(Surface.SPECULAR), unmixed)
