"""Multiple importance weights of the bidirectional path tracer: pure functions of two running sums.

A path of k edges can be made by several techniques: s vertices from a light, t from the camera. The balance heuristic
with technique counts weights a sample of technique i by nᵢpᵢ / Σⱼ nⱼpⱼ (Veach, *Robust Monte Carlo Methods for Light
Transport Simulation*, 1997, §9.2.4, §10.2.1). Each sub-path carries the part of Σⱼ nⱼpⱼ / pᵢ that its own vertices
decide in two numbers, dVCM and dVC (Georgiev, *Implementing Vertex Connection and Merging*, 2012, eqs. 31–46, with the
merging terms left out).

Counts, per eye path: 1 for a hit emitter (s=0) and for next event estimation (s=1), ``connection_count`` times the
usefulness of the light vertex for a connection, and ``light_ratio`` for light tracing (t=1), but 0 for paths of two
edges; for these alone the count of s=1 may be more, which multiplies its density. A technique that is left out has
count 0; the weights stay a partition of unity over the others, so the estimate stays unbiased for every choice. Russian
roulette is in none of the densities: it thins samples of a technique and compensates each, so it does not change what a
technique's density is.

Letters: p solid-angle densities, cos = |n_geometric · d|, "in" the edge by which a vertex was reached, "rev" against
the walk. All functions take and return ``mi.Float``, or plain floats: tests sum the weights of one path by hand.
"""

from __future__ import annotations

from typing import TypeAlias

import drjit as dr
import mitsuba as mi

Number: TypeAlias = "mi.Float | float"
"""What the weights are made of: arrays of the renderer, or plain numbers of the tests."""

LARGEST = 1e30
"""Sums are clamped to this, so that no infinity meets a zero; weights of such samples are below 1e-20 either way."""


def light_start(nee_density: Number, emission: Number) -> Number:
    """dVCM of a light path's first ray: p_NEE(y₀)/e (Georgiev 2012, eq. 31), completed on arrival.

    ``nee_density`` is per area at y₀. For a light at infinity, whose "position" is a direction, it is per solid angle,
    over the r² that arriving multiplies with (§5.1, last paragraph).
    """
    return dr.minimum(nee_density / emission, LARGEST)


def eye_start(light_ratio: Number, p_camera: Number) -> Number:
    """dVCM of a primary ray: n_T/p_cam (eq. 31), completed on arrival; 0 where the sensor cannot be hit.

    ``p_camera`` is the density of the ray's direction per solid angle, normalised over the crop window.
    """
    return dr.select(p_camera > 0, dr.minimum(light_ratio / p_camera, LARGEST), 0)


def arrive(dvcm: Number, dvc: Number, r2: Number, cos_in: Number) -> tuple[Number, Number]:
    """(dVCM, dVC) on arrival at a later vertex, where solid-angle densities become area densities.

    This is what lies between eqs. 31–33 and 34–36.
    """
    return dr.minimum(dvcm * r2 / cos_in, LARGEST), dr.minimum(dvc / cos_in, LARGEST)


def scatter(
    dvcm: Number, dvc: Number, count_before: Number, cos_out: Number, p_forward: Number, p_reverse: Number
) -> tuple[Number, Number]:
    """(dVCM, dVC) after a non-delta bounce: 1/p_fwd and cos_out/p_fwd·(n·dVCM + p_rev·dVC) (eqs. 34, 35).

    ``count_before`` is the count of the technique that joins this sub-path, ended one vertex earlier, to the rest.
    """
    return (
        dr.minimum(1 / p_forward, LARGEST),
        dr.minimum(cos_out / p_forward * (count_before * dvcm + p_reverse * dvc), LARGEST),
    )


def scatter_delta(dvc: Number, cos_out: Number) -> tuple[Number, Number]:
    """(dVCM, dVC) after a delta bounce: nothing joins at either side of it, and p_fwd = p_rev cancel (eqs. 53, 54)."""
    return dr.zeros(type(dvc)) if dr.is_array_v(dvc) else 0.0, cos_out * dvc


def hit_emitter(nee_direction_density: Number, emission: Number, dvcm: Number, dvc: Number) -> Number:
    """Weight of s=0: 1/(1 + p_ω·dVCM + e·dVC) (eqs. 37, 43), dVCM from *before* and dVC from *after* the arrival.

    It is written with p_ω instead of the area density, so that r²/cos cancels and the environment needs no case of its
    own.
    """
    return 1 / (1 + nee_direction_density * dvcm + emission * dvc)


def next_event(
    p_bsdf_over_p_nee: Number, ratio: Number, count_before: Number, p_reverse: Number, dvcm: Number, dvc: Number
) -> Number:
    """Weight of s=1: 1/(1 + wL + wC), wC = ratio·(n·dVCM + p_rev·dVC) (eqs. 37, 44, 45).

    ``ratio`` is e·cos_x/(p_NEE·cos₀): the density with which a light path from the same point would arrive at x, over
    p_NEE.
    """
    return 1 / (1 + p_bsdf_over_p_nee + ratio * (count_before * dvcm + p_reverse * dvc))


def light_tracing(
    sensor_area_density: Number, light_ratio: Number, count_before: Number, p_reverse: Number, dvcm: Number, dvc: Number
) -> Number:
    """Weight of t=1: 1/(1 + wL), wL = p_cam,A/n_T·(n·dVCM + p_rev·dVC) (eqs. 37, 46)."""
    return 1 / (1 + sensor_area_density / light_ratio * (count_before * dvcm + p_reverse * dvc))


def connection_over_r2(count: Number, r2: Number, light_sum: Number, eye_sum: Number) -> Number:
    """Weight of a connection divided by r²: n/(n·r² + wL·r² + wC·r²) (eqs. 37, 40, 41); no 0/0, no spike as r → 0.

    ``light_sum`` = p_x→y·cos_y·(n·dVCM + p_rev·dVC) of the light vertex, ``eye_sum`` the same with x and y exchanged.
    """
    return count / dr.maximum(count * r2 + light_sum + eye_sum, 1e-35)
