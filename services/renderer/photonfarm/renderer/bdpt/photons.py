"""Photons are the surface hits of light sub-paths as arrays, from the same walk as the renderer's light paths."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from photonfarm.renderer.bdpt import randomness
from photonfarm.renderer.bdpt.light_paths import LightState, first_state, scatter
from photonfarm.renderer.bdpt.lights.emission import Lights, read_lights, sample_emission
from photonfarm.renderer.bdpt.recording import Recorders, call_recorded, loop_once
from photonfarm.renderer.bdpt.scenes import check_scene

Floats = npt.NDArray[np.float32]
Columns: TypeAlias = "tuple[mi.Point3f, mi.Vector3f, mi.Normal3f, mi.Spectrum]"
"""Positions, directions, normals and powers of all slots, on the device."""


@dataclass(frozen=True, slots=True, eq=False)
class TracedPhotons:
    """Photons in P = paths · depth slots: slot d·paths + i holds hit d + 1 of path i, or bounce −1 and zeros."""

    position: Floats  # [P, 3], scene units
    direction: Floats  # [P, 3], unit: the way the light travels on arriving
    normal: Floats  # [P, 3], unit: geometric, as the surface is oriented
    power: Floats  # [P, 3], watts (RGB) in scene units, over the number of emitted paths: they sum to the arriving flux
    bounce: npt.NDArray[np.int32]  # [P]: surfaces met before (0: straight from a light), −1 empty


def trace_photons(
    scene: mi.Scene, *, seed: int, paths: int, depth: int, recorders: Recorders | None = None
) -> TracedPhotons:
    """Trace ``paths`` light paths of up to ``depth`` surface hits each.

    ``power`` of a hit is what arrives there, before reflection, divided by ``paths`` (those of dead lights
    bring none), so that sums over a region estimate the flux that arrives in it, whatever ``paths`` is. There is no
    Russian roulette, since the slots are fixed anyway. Lights that can only be hit (see ``lights.emission``) emit none.

    Nothing is compiled again for another seed, or for a scene that was edited in place. With
    ``recorders`` Python runs but once, which saves most of the time in scenes of many materials. Raises ValueError for
    scenes with media, and for numbers below 1.
    """
    if paths < 1 or depth < 1:
        raise ValueError(f"trace_photons: paths is {paths} and depth {depth}; each must be at least 1")
    check_scene(scene, light_paths=True)
    if not scene.emitters():
        zeros = np.zeros((paths * depth, 3), np.float32)
        return TracedPhotons(zeros, zeros.copy(), zeros.copy(), zeros.copy(), np.full(paths * depth, -1, np.int32))
    with dr.suspend_grad():
        lights = read_lights(scene)
        keys = randomness.image_keys([seed & 0xFFFFFFFF])
        arguments = (lights, keys, dr.opaque(mi.UInt32, paths), paths, depth)
        out, bounce = call_recorded(recorders, trace, (paths, depth, lights.kinds), scene, None, *arguments)
    position, direction, normal, power = (np.ascontiguousarray(np.array(column).T, dtype=np.float32) for column in out)
    return TracedPhotons(position, direction, normal, power / np.float32(paths), np.array(bounce))


def trace(
    scene: mi.Scene, _: None, lights: Lights, keys: mi.UInt32, path_count: mi.UInt32, paths: int, depth: int
) -> tuple[Columns, mi.Int32]:
    """(columns, bounces) of all slots; ``path_count`` is ``paths`` as data, so that kernels do not depend on it."""
    slots = paths * depth
    sequence = randomness.stream(keys, randomness.PHOTONS)
    path = dr.arange(mi.UInt32, paths)
    rng = randomness.sampler(sequence + dr.zeros(mi.UInt32, paths), path)
    start = sample_emission(lights, rng, path, path_count)
    out = (
        dr.zeros(mi.Point3f, slots),
        dr.zeros(mi.Vector3f, slots),
        dr.zeros(mi.Normal3f, slots),
        dr.zeros(mi.Spectrum, slots),
    )
    bounce = dr.full(mi.Int32, -1, slots)
    loop_once(
        state=(first_state(scene, lights, start, rng),),
        cond=lambda s: s.active,
        body=partial(_hit, scene=scene, depth=depth, out=out, bounce=bounce, path_count=path_count),
        labels=("photon",),
        label="photons",
    )
    dr.eval(out, bounce)
    return out, bounce


def _hit(
    s: LightState, *, scene: mi.Scene, depth: int, out: Columns, bounce: mi.Int32, path_count: mi.UInt32
) -> tuple[LightState]:
    """One vertex of a light path: write it into its slot, scatter."""
    si = s.hit.compute_surface_interaction(s.ray, mi.RayFlags.All, s.active)
    cos_in = dr.abs(dr.dot(si.n, s.ray.d))
    active = s.active & (cos_in > 0)
    slot = (s.depth - 1) * path_count + dr.arange(mi.UInt32, dr.width(s.active))
    for column, value in zip(out, (si.p, s.ray.d, si.n, s.throughput), strict=True):
        dr.scatter(column, value, slot, active)
    dr.scatter(bounce, mi.Int32(s.depth) - 1, slot, active)
    state = replace(s, active=active & (s.depth < depth), depth=s.depth + 1)
    scatter(state, si, si.bsdf(), cos_in)
    state.hit = scene.ray_intersect_preliminary(state.ray, active=state.active)
    state.active &= state.hit.is_valid()
    return (state,)
