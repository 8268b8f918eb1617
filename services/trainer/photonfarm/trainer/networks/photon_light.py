"""The light that the photons of a configuration bring to the surfaces of a view.

Shape letters: B batch, H W image.
"""

from __future__ import annotations

import math

from torch import Tensor

from photonfarm.shared.core.errors import SpecError
from photonfarm.trainer.networks.frame import SceneFrame
from photonfarm.trainer.networks.inputs import Inputs, given
from photonfarm.trainer.networks.photon_map import arrives_on_seen_side, gathered, seen_area
from photonfarm.trainer.networks.projection import footprint


class PhotonLight:
    """The exposed radiance of white diffuse surfaces by the photons in windows of the image.

    It takes the photons whose path to the eye is no longer than the paths of the images, and whose light has been
    reflected at least `bounces` times.
    """

    def __init__(self, frame: SceneFrame, architecture: str, *, bounces: int = 0) -> None:
        """Take the scene's constants from a frame; raises SpecError for a scene without photons."""
        if not frame.photon_paths:
            raise SpecError(
                f"network.architecture = {architecture!r}: the scene has photons.paths = 0, and none are stored; set "
                "photons.paths in its spec and render it anew, or train an architecture without photons"
            )
        self._optics, self._exposure, self._first = frame.optics, frame.exposure, bounces
        self._last = frame.max_depth - 2 if frame.max_depth >= 0 else math.inf  # then one edge to the eye

    def __call__(self, inputs: Inputs) -> list[Tensor]:
        """(B, H, W, 3) for each of `photon_map.WINDOWS`."""
        photons, view = given(inputs.photons), (inputs.world_to_camera, inputs.depth, inputs.normal)
        on_side = arrives_on_seen_side(photons.position, photons.direction, photons.normal, inputs.world_to_camera)
        wanted = photons.present & on_side & (photons.bounce >= self._first) & (photons.bounce <= self._last)
        kept = footprint(photons.position, wanted, photons.seen, *view, self._optics)
        return gathered(photons.power * self._exposure, kept, seen_area(self._optics, *view))
