"""The constants of a scene that its network is built with.

Shape letters: P points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from photonfarm.core.records import F32, BasePointCloud, Geometry
from photonfarm.scene.spec import SceneSpec
from photonfarm.trainer.networks.projection import Optics
from photonfarm.trainer.runs.settings import NetworkSettings


@dataclass(frozen=True, slots=True, eq=False)
class SceneFrame:
    """The constants of a scene by which inputs are normalised to values near 1; all ours, as the supplement gives none.

    Positions are taken about the centre of the geometry's bounding box and, like depths, divided by half its diagonal.
    Emission is divided by its root mean square over the cloud: lamps, few points among many, stand out so far that
    maxima over the points encode their places before any step. With `emission = log` that is done once more with
    log(1 + emission): lamps and far brighter windows then stand out alike. Normals, rays and albedo are near 1 anyway.
    """

    optics: Optics
    centre: F32  # (3,)
    scale: float  # half the diagonal, scene units
    base: F32  # (P, 3) where each point is in the base configuration, world, scene units
    appearance: F32  # (P, 9) the constants of each point: normal, albedo, emission
    photon_paths: int  # light paths emitted in each configuration; 0: the scene has no photons
    photon_depth: int  # most hits stored of each
    exposure: float  # the spec's factor on radiance
    max_depth: int  # edges of a path of the images; −1: no limit
    area: float  # of all surfaces, scene units²
    photon_scale: float  # factor from a photon's power, over the number emitted, to a feature near 1

    @classmethod
    def of(cls, spec: SceneSpec, geometry: Geometry, cloud: BasePointCloud, settings: NetworkSettings) -> SceneFrame:
        """The frame of a scene, for the first `settings.points` points of its cloud (uniform draws, as all are).

        A photon's power is stored over the number emitted, so that more photons are weaker ones. Times that number it
        is the flux that a single photon would carry, whatever their number; spread over a disc of the scene's radius,
        and exposed, it is of the order of the scene's brightness under that light.
        """
        low, high = geometry.vertices.min(axis=0), geometry.vertices.max(axis=0)
        used = slice(settings.points)
        emission = _normalised(cloud.emission[used])
        if settings.emission == "log":
            emission = _normalised(np.log1p(emission))
        appearance = np.concatenate([cloud.normal[used], cloud.albedo[used], emission], axis=1)
        scale = max(0.5 * float(np.linalg.norm(high - low)), 1e-30)
        return cls(
            optics=Optics.of(spec, settings.occlusion, settings.occlusion_tolerance),
            centre=(0.5 * (low + high)).astype(np.float32),
            scale=scale,
            base=cloud.position[used].astype(np.float32),
            appearance=appearance.astype(np.float32),
            photon_paths=spec.photons.paths,
            photon_depth=spec.photons.depth,
            exposure=spec.exposure,
            max_depth=spec.transport.max_depth,
            area=float(geometry.areas().sum()),
            photon_scale=spec.photons.paths * spec.exposure / (math.pi * scale**2),
        )


def _normalised(emission: F32) -> F32:
    """Emission (P, 3) over its root mean square."""
    return np.asarray(emission / max(float(np.sqrt(np.mean(emission**2))), 1e-30), np.float32)
