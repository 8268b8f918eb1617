"""Spots that fade as a profile says, which Mitsuba has by an image on a cone."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from photonfarm.renderer.importing import elements, images
from photonfarm.renderer.importing.meshes import Floats

Profile = Callable[[Floats, Floats], Floats]
"""The share of a spot's intensity at tangents (x, y) off its axis."""

WIDEST = math.radians(89.5)
"""The widest half angle of a spot, whose image is flat."""


def cone_image(profile: Profile, cut: float, file: Path) -> Path:
    """The image of a spot within an angle; `profile`: its share at tangents (x, y) off the axis."""
    texels = 1024 if cut < math.radians(80) else 2048  # as tangents are large there
    y, x = np.meshgrid(*[math.tan(cut) * (2 * (np.arange(texels) + 0.5) / texels - 1)] * 2, indexing="ij")
    return images.save(profile(x, y).astype(np.float32), file)


def put_cone(spot: Element, cut: float, file: Path) -> None:
    """Let a spot end at an angle and fade as an image says."""
    elements.put_value(spot, "cutoff_angle", math.degrees(cut))
    elements.put_value(spot, "beam_width", math.degrees(cut) * 0.999)
    elements.put_value(elements.put_bitmap(spot, "texture", file, raw=True), "wrap_mode", "clamp")
