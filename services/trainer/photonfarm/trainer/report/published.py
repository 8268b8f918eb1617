"""The published tables, to stand beside ours [supplement 4, Tables 1 and 2].

They are of four rooms at 256², on the authors' GPU: values cannot be compared with ours, but orders of errors can, and
ratios of networks' times. Denoisers' times are mostly rendering, of as many samples per pixel as the authors chose.
"""

from __future__ import annotations

from dataclasses import dataclass

from photonfarm.shared.scene.spec import SceneSpec


@dataclass(frozen=True, slots=True)
class Published:
    """A row of a published table."""

    seconds: float  # per frame
    mse: float
    mssim: float
    fid: float
    feature_l1: float


FIXED_LIGHTS = {
    "denoise_1": Published(1.5059, 0.0005, 0.880, 26.4, 0.163),
    "denoise_4": Published(0.3800, 0.0007, 0.867, 28.1, 0.172),
    "denoise_16": Published(0.0986, 0.0012, 0.835, 38.7, 0.203),
    "denoise_32": Published(0.0532, 0.0018, 0.813, 54.1, 0.233),
    "denoise_64": Published(0.0283, 0.0029, 0.781, 94.0, 0.281),
    "cnn": Published(0.0191, 0.0043, 0.835, 36.1, 0.195),
    "feature_projection": Published(0.0210, 0.0037, 0.841, 32.5, 0.185),
    "light_transport": Published(0.0243, 0.0044, 0.841, 31.4, 0.184),
    "light_transport_photons": Published(0.0459, 0.0028, 0.849, 30.6, 0.182),
}
MOVABLE_LIGHTS = {
    "denoise_1": Published(1.5059, 0.0002, 0.930, 17.1, 0.137),
    "denoise_4": Published(0.3801, 0.0002, 0.923, 17.6, 0.143),
    "denoise_16": Published(0.0988, 0.0005, 0.896, 23.5, 0.172),
    "denoise_32": Published(0.0518, 0.0008, 0.874, 38.6, 0.207),
    "denoise_64": Published(0.0283, 0.0016, 0.839, 84.1, 0.269),
    "cnn": Published(0.0190, 0.0100, 0.827, 33.7, 0.199),
    "feature_projection": Published(0.0208, 0.0098, 0.827, 32.9, 0.197),
    "light_transport": Published(0.0243, 0.0029, 0.871, 30.0, 0.184),
    "light_transport_photons": Published(0.0468, 0.0014, 0.887, 25.1, 0.172),
}

PublishedTable = dict[str, Published]
"""Rows by architecture, in the order of the published table."""


def table_of(spec: SceneSpec) -> tuple[str, PublishedTable] | None:
    """The name of the published table for scenes of this kind, and its rows; None for a static scene."""
    if spec.lights:
        return "Table 2, movable objects and lights", MOVABLE_LIGHTS
    return ("Table 1, movable objects and fixed lights", FIXED_LIGHTS) if spec.objects else None
