"""What tests of Mitsuba's XML have in common."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from photonfarm.renderer.tools.importing.imported import ImportedScene

Loaded = Callable[[Path], tuple[ImportedScene, Any]]


Read = Callable[[Path], ImportedScene]


def reflectance(made: Any, x: float, y: float) -> np.ndarray:
    """The colour of what a ray down at (x, y) meets."""
    hit = made.ray_intersect(mi.Ray3f([x, y, 5], [0, 0, -1]))
    return np.array(hit.bsdf().eval_diffuse_reflectance(hit)).ravel()


def from_sky(made: Any, directions: np.ndarray) -> np.ndarray:
    """What comes from directions (N, 3); (N, 3)."""
    looked = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    looked.wi = mi.Vector3f(np.ascontiguousarray(-unit.T))
    return np.array(made.environment().eval(looked)).T


SPHERE = '<shape type="sphere" id="Ball"/>'
