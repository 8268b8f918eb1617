"""The content of a scene, and the restrictions that follow from it without a measurement."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from photonfarm.renderer.strategy.candidate import PLAIN, Candidate

_LIGHTS = {
    "AreaLight": "area",
    "ConstantBackgroundEmitter": "constant environment",
    "EnvironmentMapEmitter": "environment map",
    "PointLight": "point",
    "SpotLight": "spot",
    "Projector": "projector",
    "DirectionalEmitter": "directional",
}
_BRIGHTNESS = ("radiance.", "intensity.", "irradiance.")
_CAMERAS = {"PerspectiveCamera": "pinhole", "ThinLensCamera": "thin lens"}
"""The cameras that light paths can be joined to."""


@dataclass(frozen=True, slots=True)
class SceneContent:
    """The facts of one loaded scene in its present state."""

    lights: Mapping[str, int]  # lights that shine, by kind
    dark: int  # lights of radiance 0: they are never selected
    surfaces: int
    specular: int  # of these, those that only reflect or refract like a mirror or clear glass
    camera: str  # "pinhole", "thin lens", or Mitsuba's name of another


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A technique that is left out, and the reason."""

    what: str
    why: str

    def __str__(self) -> str:
        return f"{self.what}: {self.why}"


def read(scene: Any, camera: Any) -> SceneContent:
    """Read the content of a Mitsuba scene, seen by one of Mitsuba's sensors."""
    shining = [emitter for emitter in scene.emitters() if _shines(emitter)]
    kinds = Counter(_LIGHTS.get(emitter.class_name(), emitter.class_name()) for emitter in shining)
    return SceneContent(
        lights=dict(kinds),
        dark=len(scene.emitters()) - len(shining),
        surfaces=len(scene.shapes()),
        specular=sum(map(_is_specular, scene.shapes())),
        camera=_CAMERAS.get(camera.class_name(), camera.class_name()),
    )


def _shines(emitter: Any) -> bool:
    """Whether any of its brightness parameters is above zero, and its scale and image too, if it has them."""
    import mitsuba as mi

    parameters = mi.traverse(emitter)
    names = [name for name in parameters.keys() if not name.endswith("to_uv")]  # noqa: SIM118 - no mapping
    factors = [[name] for name in names if name in ("data", "scale")]
    brightness = [name for name in names if name.startswith(_BRIGHTNESS)]
    return all(
        any(np.any(np.array(parameters[name], np.float64) > 0) for name in factor)
        for factor in [*factors, brightness]
        if factor
    )


def _is_specular(shape: Any) -> bool:
    import mitsuba as mi

    return shape.bsdf() is not None and not mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Smooth)


def restrict(
    content: SceneContent, max_depth: int, hit_share: float, candidates: Iterable[Candidate]
) -> tuple[list[Candidate], list[LeftOut]]:
    """The candidates that may help, and what is left out; `hit_share`: the share of light paths that hit a surface."""
    candidates = list(candidates)
    reason = _why_no_light_paths(content, max_depth, hit_share)
    if reason:
        return [PLAIN], [LeftOut("light paths, and with them connections", reason)]
    return candidates, []


def _why_no_light_paths(content: SceneContent, max_depth: int, hit_share: float) -> str | None:
    if not content.lights:
        return "there is no light that shines"
    if max_depth in (0, 1):
        return f"max_depth is {max_depth}: only lights themselves are seen"
    if max_depth == 2:
        return "max_depth is 2: connections need 3 edges, and `bdpt` traces no light paths for direct light alone"
    if content.camera not in _CAMERAS.values():
        return f"they cannot be joined to a camera of type {content.camera}"
    if content.specular == content.surfaces:
        return "every surface is a mirror or clear glass, where they can be joined to nothing"
    if hit_share == 0:
        return "none can start from the lights there are, or none of them hits a surface"
    return None


def sentences(content: SceneContent, max_depth: int) -> Sequence[str]:
    """What every plan models, and the lights that are off."""
    lights = ", ".join(f"{count} {kind}" for kind, count in sorted(content.lights.items())) or "none"
    found = [
        f"lights: {lights}",
        f"surfaces: {content.surfaces}, of which {content.specular} are mirrors or clear glass alone",
        f"camera: {content.camera}; paths of {'any number of' if max_depth < 0 else f'up to {max_depth}'} edges",
    ]
    if content.dark:
        found.append(f"lights that do not shine: {content.dark}, selected with probability 0")
    return found
