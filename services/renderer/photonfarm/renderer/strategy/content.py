"""What a scene contains and where its light goes, and what follows from that without comparing images.

Shape letters: N light paths, D bounces, C configurations.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.strategy.candidates import PLAIN, Candidate
from photonfarm.scene.spec import PhotonSpec, ViewSpec

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

PATHS = 4096
DEPTH = 16
"""The largest depth that a spec may have."""

LEAST_SHARE = 0.01
"""The smallest share of light paths near the cameras for which photons are stored.

It is also the largest share of the power there that omitted bounces may carry.
"""


@dataclass(frozen=True, slots=True)
class SceneContent:
    """The facts of one loaded scene in its present state."""

    lights: Mapping[str, int]  # lights that shine, by kind
    dark: int  # lights of radiance 0: they are never selected
    surfaces: int
    specular: int  # of these, those that only reflect or refract like a mirror or clear glass
    camera: str  # "pinhole", "thin lens", or Mitsuba's name of another


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
) -> tuple[list[Candidate], list[str]]:
    """The candidates that may help, and what is left out; `hit_share`: the share of light paths that hit a surface."""
    reason = _why_no_light_paths(content, max_depth, hit_share)
    if reason:
        return [PLAIN], [f"light paths, and with them connections: {reason}"]
    return list(candidates), []


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
    lines = [
        f"lights: {lights}",
        f"surfaces: {content.surfaces}, of which {content.specular} are mirrors or clear glass alone",
        f"camera: {content.camera}; paths of {'any number of' if max_depth < 0 else f'up to {max_depth}'} edges",
    ]
    if content.dark:
        lines.append(f"lights that do not shine: {content.dark}, selected with probability 0")
    return lines


# ----------------------------------------------------------------------------------------------------------- photons


@dataclass(frozen=True, slots=True)
class LightReach:
    """The shares of light paths, and of their power, that reach the cameras; (C, D): by configurations and bounces."""

    hit: float  # the share of light paths that hit any surface, mean over configurations
    near: tuple[tuple[float, ...], ...]  # (C, D) the share with such a bounce in the cameras' surroundings
    power: tuple[tuple[float, ...], ...]  # (C, D) the share of the power there; the sum over bounces is 1 (or 0)


def light_reach(scenes: Iterable[Any], view: ViewSpec, seed: int) -> LightReach:
    """Trace light paths in several configurations of a scene; each item is the scene in the next of them.

    The surroundings are the box around all cameras and look-at points, larger by a quarter on every side: the sky's
    light on a roof is not light in the room.
    """
    from photonfarm.renderer.bdpt import trace_photons

    hits, rows = [], []
    for i, scene in enumerate(scenes):
        photons = trace_photons(scene, seed=seed + i, paths=PATHS, depth=DEPTH)
        near = _inside(photons.position, view)
        of_bounce = [photons.bounce == d for d in range(DEPTH)]
        rows.append(
            [
                [float(np.sum(at & near)) / PATHS for at in of_bounce],
                [float(np.sum(photons.power[at & near], dtype=np.float64)) for at in of_bounce],
            ]
        )
        hits.append(np.sum(of_bounce[0]) / PATHS)
    near_share, power = np.array(rows).transpose(1, 0, 2)
    arrived = power.sum(axis=1, keepdims=True)
    shares = np.divide(power, arrived, out=np.zeros_like(power), where=arrived > 0)
    return LightReach(float(np.mean(hits)), *(tuple(map(tuple, each.tolist())) for each in (near_share, shares)))


def _inside(position: NDArray[np.float32], view: ViewSpec) -> NDArray[np.bool_]:
    low = np.minimum(view.origin.low, view.look_at.low)
    high = np.maximum(view.origin.high, view.look_at.high)
    margin = 0.25 * (high - low) + 0.05 * np.linalg.norm(high - low)
    return np.all((position >= low - margin) & (position <= high + margin), axis=1)


def recommend_photons(
    wanted: PhotonSpec, near: Sequence[Sequence[float]], power: Sequence[Sequence[float]], max_depth: int
) -> tuple[PhotonSpec, str]:
    """The photons worth storing, and the reason; never more than in the spec. `near` and `power` as in `LightReach`.

    The omitted part must be negligible in each configuration, as it is not measured again. A hit of bounce d lies
    on paths of at least d + 2 edges, so bounces beyond max_depth contribute to no image.
    """
    if not wanted.paths:
        return wanted, "photons: none, as the spec says"
    reaching = float(np.max(near))
    if reaching < LEAST_SHARE or max_depth in (0, 1):
        reason = f"{reaching:.1%} of the light paths, at most, reach the cameras' surroundings"
        if max_depth in (0, 1):
            reason = "max_depth shows no light that a surface reflects"
        return wanted.model_copy(update={"paths": 0}), f"photons: none, as {reason}; {_BY_HAND}"
    beyond = np.max(np.sum(power, axis=1, keepdims=True) - np.cumsum(power, axis=1), axis=0)
    enough = int(np.argmax(beyond < LEAST_SHARE)) + 1 if (beyond < LEAST_SHARE).any() else len(beyond)
    longest = max_depth - 1 if max_depth > 0 else wanted.depth
    depth = max(1, min(wanted.depth, enough, longest))
    sentence = (
        f"photons: {wanted.paths} paths of {depth} hits; up to {reaching:.0%} of the paths reach the cameras' "
        f"surroundings, and bounces beyond carry up to {max(0.0, beyond[depth - 1]):.1%} of the power there, in "
        f"{len(power)} draws of the configuration" + (f"; {_BY_HAND}" if depth < wanted.depth else "")
    )
    return wanted.model_copy(update={"depth": depth}), sentence


_BY_HAND = "no later plan undoes that once it is written: raise it by hand"
