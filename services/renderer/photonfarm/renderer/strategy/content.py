"""What a scene contains and where its light goes, and what follows from that without comparing images.

Shape letters: D bounces.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from photonfarm.renderer.bdpt.camera import SENSORS
from photonfarm.renderer.bdpt.lights.selection import sampling_weight
from photonfarm.scene.spec import PhotonSpec, ViewSpec

PATHS = 4096
DEPTH = 16
"""The largest depth that a spec may have."""

LEAST_SHARE = 0.01
"""The smallest share of light paths near the cameras for which photons are stored.

It is also the largest share of the power there that omitted bounces may carry.
"""


@dataclass(frozen=True, slots=True)
class SceneContent:
    """The facts of one loaded scene in its present state, seen by a camera."""

    lights: dict[str, int]  # lights that shine, by Mitsuba's names of their kinds
    dark: int  # lights of radiance 0: they are never selected
    surfaces: int
    specular: int  # of these, those that only reflect or refract like a mirror or clear glass
    camera: str  # Mitsuba's name of its kind

    @classmethod
    def of(cls, scene: Any, camera: Any) -> SceneContent:
        """The content of a Mitsuba scene, seen by one of Mitsuba's sensors."""
        import mitsuba as mi

        emitters, bsdfs = scene.emitters(), [shape.bsdf() for shape in scene.shapes()]
        shining = [emitter for emitter in emitters if sampling_weight(emitter, mi.traverse(emitter))[0] > 0]
        return cls(
            lights=dict(Counter(emitter.class_name() for emitter in shining)),
            dark=len(emitters) - len(shining),
            surfaces=len(bsdfs),
            specular=sum(b is not None and not mi.has_flag(b.flags(), mi.BSDFFlags.Smooth) for b in bsdfs),
            camera=camera.class_name(),
        )

    def why_no_light_paths(self, max_depth: int, hit_share: float) -> str | None:
        """Why light paths cannot help, if so; `hit_share` is the share of them that hit a surface."""
        if not self.lights:
            return "there is no light that shines"
        if max_depth in (0, 1):
            return f"max_depth is {max_depth}: only lights themselves are seen"
        if max_depth == 2:
            return "max_depth is 2: connections need 3 edges, and `bdpt` traces no light paths for direct light alone"
        if self.camera not in SENSORS:
            return f"they cannot be joined to a camera of type {self.camera}"
        if self.specular == self.surfaces:
            return "every surface is a mirror or clear glass, where they can be joined to nothing"
        if hit_share == 0:
            return "none can start from the lights there are, or none of them hits a surface"
        return None

    def sentences(self, max_depth: int) -> list[str]:
        """What every plan models, and the lights that are off."""
        lights = ", ".join(f"{count} {kind}" for kind, count in sorted(self.lights.items())) or "none"
        lines = [
            f"lights: {lights}",
            f"surfaces: {self.surfaces}, of which {self.specular} are mirrors or clear glass alone",
            f"camera: {self.camera}; paths of {'any number of' if max_depth < 0 else f'up to {max_depth}'} edges",
        ]
        if self.dark:
            lines.append(f"lights that do not shine: {self.dark}, selected with probability 0")
        return lines


# ----------------------------------------------------------------------------------------------------------- photons


@dataclass(frozen=True, slots=True)
class LightReach:
    """How light paths, and their power, reach the cameras' surroundings in some configurations."""

    configurations: int
    hit: float  # the share of light paths that hit any surface, mean over configurations
    near: float  # the share of light paths that have some bounce there, the largest of any bounce and configuration
    beyond: tuple[float, ...]  # (D,) the share of the power there beyond so many bounces, the largest of any


def light_reach(scenes: Iterable[Any], view: ViewSpec, seed: int) -> LightReach:
    """Trace light paths in several configurations of a scene; each item is the scene in the next of them.

    The surroundings are the box around all cameras and look-at points, larger by a quarter on every side: the sky's
    light on a roof is not light in the room.
    """
    from photonfarm.renderer.bdpt import trace_photons

    low, high = np.minimum(view.origin.low, view.look_at.low), np.maximum(view.origin.high, view.look_at.high)
    margin = 0.25 * (high - low) + 0.05 * np.linalg.norm(high - low)
    hits, near, beyond = [], [], []
    for i, scene in enumerate(scenes):
        photons = trace_photons(scene, seed=seed + i, paths=PATHS, depth=DEPTH)
        there = np.all((photons.position >= low - margin) & (photons.position <= high + margin), axis=1)
        bounce = np.where(there, photons.bounce, -1)
        power = np.array([photons.power[bounce == d].sum(dtype=np.float64) for d in range(DEPTH)])
        hits.append(np.sum(photons.bounce == 0) / PATHS)
        near.append(max(np.sum(bounce == d) for d in range(DEPTH)) / PATHS)
        beyond.append(1 - np.cumsum(power) / power.sum() if power.any() else np.zeros(DEPTH))
    return LightReach(len(hits), float(np.mean(hits)), float(max(near)), tuple(np.max(beyond, axis=0).tolist()))


def recommend_photons(wanted: PhotonSpec, reach: LightReach, max_depth: int) -> tuple[PhotonSpec, str]:
    """The photons worth storing, and the reason; never more than in the spec.

    The omitted part must be negligible in each configuration, as it is not measured again. A hit of bounce d lies
    on paths of at least d + 2 edges, so bounces beyond max_depth contribute to no image.
    """
    by_hand = "no later plan undoes that once it is written: raise it by hand"
    if not wanted.paths:
        return wanted, "photons: none, as the spec says"
    if reach.near < LEAST_SHARE or max_depth in (0, 1):
        reason = f"{reach.near:.1%} of the light paths, at most, reach the cameras' surroundings"
        if max_depth in (0, 1):
            reason = "max_depth shows no light that a surface reflects"
        return wanted.model_copy(update={"paths": 0}), f"photons: none, as {reason}; {by_hand}"
    enough = next((d for d, share in enumerate(reach.beyond, 1) if share < LEAST_SHARE), len(reach.beyond))
    longest = max_depth - 1 if max_depth > 0 else wanted.depth
    depth = max(1, min(wanted.depth, enough, longest))
    sentence = (
        f"photons: {wanted.paths} paths of {depth} hits; up to {reach.near:.0%} of the paths reach the cameras' "
        f"surroundings, and bounces beyond carry up to {max(0.0, reach.beyond[depth - 1]):.1%} of the power there, in "
        f"{reach.configurations} draws of the configuration" + (f"; {by_hand}" if depth < wanted.depth else "")
    )
    return wanted.model_copy(update={"depth": depth}), sentence
