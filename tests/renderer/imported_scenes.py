"""What tests of imported scenes ask them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import mitsuba as mi
import numpy as np

from photonfarm.renderer.tools.importing.imported import ImportedScene
from photonfarm.renderer.tools.importing.loading import load
from photonfarm.renderer.tools.importing.proposal.proposed import Proposal, propose
from photonfarm.renderer.tools.importing.proposal.surfaces import Frame
from photonfarm.renderer.tools.importing.readers import reader_of

Read = Callable[[Path], ImportedScene]
Loaded = Callable[[Path], tuple[ImportedScene, Any]]

FOUR = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]])
"""Red and green above blue and white."""


def colour_at(scene: Any, x: float, y: float) -> list[float]:
    """The diffuse reflectance below a place."""
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, y, 1), mi.Vector3f(0, 0, -1)))
    return [round(float(part), 2) for part in np.array(si.bsdf().eval_diffuse_reflectance(si)).ravel()]


def of_type(root: Element, kind: str) -> Element:
    """The first element of a type."""
    return next(node for node in root.iter() if node.get("type") == kind)


def losses(scene: ImportedScene) -> list[tuple[Any, str]]:
    """What of the picture differs: the effects and the names."""
    return [(change.effect, change.name) for change in scene.changes if change.effect is not None]


def proposed(file: Path, scratch: Path) -> tuple[Proposal, Any]:
    """The proposal for a file, and its Mitsuba scene."""
    scene = reader_of(file)(file, scratch, lambda _: None)
    made, frame = load(scene, scratch, lambda _: None), Frame((0, 1, 0))
    camera = None if scene.camera is None else frame.inward(np.array(scene.camera))
    return propose(made, frame, camera, scene.objects, lambda _: None), made
