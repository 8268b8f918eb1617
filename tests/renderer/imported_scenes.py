"""What tests of imported scenes ask them, and parts of the files that they are made from."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import drjit as dr
import mitsuba as mi
import numpy as np

from photonfarm.renderer.tools.importing.imported import ImportedScene
from photonfarm.renderer.tools.importing.loading import load
from photonfarm.renderer.tools.importing.proposal.proposed import Proposal, propose
from photonfarm.renderer.tools.importing.proposal.surfaces import Frame
from photonfarm.renderer.tools.importing.readers import reader_of

Read = Callable[[Path], ImportedScene]
Loaded = Callable[[Path], tuple[ImportedScene, Any]]
Obj = Callable[[str | bytes], Path]
Write = Callable[[str, str], Path]

FOUR = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]])
"""Red and green above blue and white."""

FOUR_V = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
SQUARE = f"{FOUR_V}vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"

COLOURS = {"red": (1, 0, 0), "green": (0, 1, 0), "blue": (0, 0, 1), "white": (1, 1, 1)}

CORNERS = ((0.25, 0.75), (0.75, 0.75), (0.25, 0.25), (0.75, 0.25))
"""Where four.png has the middles of its texels on the square."""

WHOLE = "usemtl it\nf 1/1 2/2 3/3 4/4"

SPHERE = '<shape type="sphere" id="Ball"/>'


def hit(made: Any, x: float, y: float, side: float = 5) -> Any:
    """What a ray down at (x, y) meets, or up if it comes from below."""
    return made.ray_intersect(mi.Ray3f(mi.Point3f(x, y, side), mi.Vector3f(0, 0, -1 if side > 0 else 1)))


def meets(made: Any, x: float, y: float) -> bool:
    """Whether a ray down at (x, y) meets anything."""
    return bool(np.array(hit(made, x, y, 50).is_valid()).ravel()[0])


def reflectance(made: Any, x: float, y: float) -> np.ndarray:
    """The diffuse reflectance of what a ray down at (x, y) meets."""
    si = hit(made, x, y)
    return np.array(si.bsdf().eval_diffuse_reflectance(si)).ravel()


def opacity(made: Any, x: float, y: float) -> float:
    """The opacity of what a ray down at (x, y) meets."""
    si = hit(made, x, y)
    return 1 - float(np.array(si.bsdf().eval_null_transmission(si)).ravel()[0])


def emission(made: Any, x: float, y: float, side: float = 5) -> np.ndarray:
    """What is emitted towards a ray down at (x, y)."""
    si = hit(made, x, y, side)
    return np.array(si.emitter(made).eval(si)).ravel()


def from_sky(made: Any, directions: np.ndarray) -> np.ndarray:
    """What comes from directions (N, 3); (N, 3)."""
    looked = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    looked.wi = mi.Vector3f(np.ascontiguousarray(-unit.T))
    return np.array(made.environment().eval(looked)).T


def area(made: Any) -> float:
    """The area of all shapes."""
    return sum(float(np.array(shape.surface_area()).ravel()[0]) for shape in made.shapes())


def said(scene: ImportedScene) -> str:
    """All changes."""
    return "\n".join(map(str, scene.changes))


def colour_at(made: Any, x: float, y: float) -> list[float]:
    """The diffuse reflectance below a place, rounded."""
    return [round(float(part), 2) for part in reflectance(made, x, y)]


def of_type(root: Element, kind: str) -> Element:
    """The first element of a type."""
    return next(node for node in root.iter() if node.get("type") == kind)


def losses(scene: ImportedScene) -> list[tuple[Any, str]]:
    """What of the picture differs: the effects and the names."""
    return [(change.effect, change.name) for change in scene.changes if change.effect is not None]


def lost(scene: ImportedScene) -> dict[str, Any]:
    """The same, as the effects by the names."""
    return {name: effect for effect, name in losses(scene)}


def proposed(file: Path, scratch: Path) -> tuple[Proposal, Any]:
    """The proposal for a file, and its Mitsuba scene."""
    scene = reader_of(file)(file, scratch, lambda _: None)
    made, frame = load(scene, scratch, lambda _: None), Frame((0, 1, 0))
    camera = None if scene.camera is None else frame.inward(np.array(scene.camera))
    return propose(made, frame, camera, scene.objects, lambda _: None), made
