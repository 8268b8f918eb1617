"""The spec's film and camera as one Mitsuba sensor, which is aimed in place."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.scene.arrays import matrix
from photonfarm.shared.scene.spec import SceneSpec
from photonfarm.shared.scene.view import Camera, View


class AimedSensor:
    """A perspective sensor whose transform is opaque to the compiler, so that views cost no compilation."""

    def __init__(self, spec: SceneSpec) -> None:
        self._spec = spec
        self.sensor = mi.load_dict(describe(spec))
        self._parameters = mi.traverse(self.sensor)

    @cached_property
    def at_origin(self) -> Any:
        """A sensor that stays at the origin and looks along +z, for the integrator to place."""
        return mi.load_dict(describe(self._spec))

    def aim(self, view: View) -> Any:
        """The sensor, looking at this view."""
        kind = type(self._parameters["to_world"])
        self._parameters["to_world"] = kind(matrix(self.place(view)))
        dr.make_opaque(self._parameters["to_world"])
        self._parameters.update()
        return self.sensor

    def place(self, view: View) -> NDArray[np.float64]:
        """The camera-to-world matrix (4, 4) of a view: Mitsuba's camera has +x to the left, +y up, +z ahead."""
        camera, to_world = Camera.of(view, self._spec), np.eye(4)
        to_world[:3] = np.stack([-camera.right, -camera.down, camera.forward, camera.origin], axis=1)
        return to_world


def describe(spec: SceneSpec) -> dict[str, Any]:
    """The sensor's description: float32 RGB film with a box filter, field of view along the width, clip planes."""
    film = {
        "type": "hdrfilm",
        "width": spec.film.width,
        "height": spec.film.height,
        "pixel_format": "rgb",
        "component_format": "float32",
        "rfilter": {"type": "box"},
    }
    return {
        "type": "perspective",
        "fov": spec.view.fov_deg,
        "fov_axis": "x",
        "near_clip": spec.view.near,
        "far_clip": spec.view.far,
        "film": film,
        "sampler": {"type": "independent", "sample_count": spec.transport.half_spp},
    }
