"""The right weights of paths, computed from their vertices in float64 without the integrator's formulas.

A path of k edges has vertices v₀ (on the light) … v_k (the lens). The technique with s light vertices makes the first s
of them from the light and the others from the lens, and joins the two ends. Its density is the product of the densities
of all steps in area measure (for a light at infinity, of its direction). The weight of a technique is its count times
its density, over the sum of these products of all techniques (Veach, *Robust Monte Carlo Methods for Light Transport
Simulation*, 1997, §8.2.2, §9.2.4, §10.2.1).

At a mirror or a smooth interface the densities of both directions are infinite, in a fixed ratio, and no technique
joins two ends there. The ratio is 1 for reflection. For refraction it is dω/dω' with dω cosθ n² = dω' cosθ' n'² (Veach
1997, §5.2). The integrator leaves this ratio out, as do all that follow Georgiev. Its weights still sum to 1, and the
ratios multiply to 1 over a body that light enters and leaves at equal angles, such as a sphere or a pane.

Shape letters: N paths, k edges; arrays by vertex have k + 1 columns, arrays by edge k.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class OraclePaths:
    """N paths of k edges, with the densities of their single steps.

    Columns of path ends that have no such value are not read: the lens and a point light have no normal.
    """

    position: F64  # [N, k + 1, 3]
    normal: F64  # [N, k + 1, 3]: geometric
    to_light: F64  # [N, k + 1]: solid-angle density of the BSDF's sampling from the eye's side towards the light
    to_eye: F64  # [N, k + 1]: solid-angle density of the BSDF's sampling from the light's side towards the eye
    delta: Mask  # [N, k + 1]: scattered by a mirror or a smooth interface here
    turn: F64  # [N, k + 1]: at delta vertices, density towards the eye over that towards the light; 1 for a mirror
    infinite: Mask  # [N]: the light is at infinity: v₀ stands for a direction
    distant: F64  # [N, 3]: direction to it
    hittable: Mask  # [N]: a ray can find the light
    light_has_cosine: Mask  # [N]: the light lies on a surface
    next_event: F64  # [N]: density of v₀ seen from v₁ in area (or of its direction; delta: probability), with selection
    emission: F64  # [N]: density of a light path's start, per area and direction, without cosines, with selection
    camera: F64  # [N]: solid-angle density of the primary ray

    @property
    def edges(self) -> int:
        """The number k."""
        return int(self.position.shape[1]) - 1


def technique_counts(k: int, connection_count: float, light_ratio: float) -> F64:
    """The samples of each technique for each eye path, [k + 1]: hits, next events, connections, light tracing.

    Light paths are not joined to the lens at their first vertex, which is the case k = 2.
    """
    counts = np.full(k + 1, connection_count)
    counts[:2] = 1
    if k >= 2:
        counts[k] = light_ratio if k > 2 else (0 if k == 2 else 1)
    return counts


def weights(paths: OraclePaths, counts: F64) -> F64:
    """The weight of each technique, [N, k + 1]; 0 if it cannot make the path, NaN if none can."""
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = log_densities(paths) + np.log(counts)
        weighted = np.exp(logs - logs.max(axis=1, keepdims=True))
    total: F64 = weighted.sum(axis=1, keepdims=True)
    return weighted / total


def log_densities(paths: OraclePaths) -> F64:
    """The logarithm of each technique's density, [N, k + 1]; −∞ if it cannot make the path."""
    k = paths.edges
    r2, at_light_end, at_eye_end = _edges(paths)
    area_from_light, area_from_eye = at_eye_end / r2, at_light_end / r2  # density per solid angle → area
    area_from_light[:, 0] = np.where(paths.infinite, at_eye_end[:, 0], area_from_light[:, 0])
    area_from_eye[:, 0] = np.where(paths.infinite, 1, area_from_eye[:, 0])
    to_light, to_eye = np.where(paths.delta, 1, paths.to_light), np.where(paths.delta, paths.turn, paths.to_eye)

    with np.errstate(divide="ignore"):
        from_light = _log_from_light(paths, np.log(to_eye), np.log(area_from_light), at_light_end[:, 0])
        from_eye = _log_from_eye(paths, np.log(to_light), np.log(area_from_eye))
    logs = np.stack([from_light[s] + from_eye[k + 1 - s] for s in range(k + 1)], axis=1)
    for s in range(1, k + 1):  # both ends of the edge that is joined must scatter in other directions, too
        logs[:, s] = np.where(paths.delta[:, s - 1] | paths.delta[:, s], -np.inf, logs[:, s])
    logs[:, 0] = np.where(paths.hittable, logs[:, 0], -np.inf)
    return logs


def _edges(paths: OraclePaths) -> tuple[F64, F64, F64]:
    """(squared length, |cos| at the end nearer the light, |cos| at the other) of each edge, [N, k]."""
    offset = np.diff(paths.position, axis=1)
    offset[:, 0] = np.where(paths.infinite[:, None], -paths.distant, offset[:, 0])
    r2 = (offset**2).sum(axis=-1)
    direction = offset / np.sqrt(r2)[..., None]
    at_light_end = np.abs((paths.normal[:, :-1] * direction).sum(axis=-1))
    at_eye_end = np.abs((paths.normal[:, 1:] * direction).sum(axis=-1))
    return r2, at_light_end, at_eye_end


def _log_from_light(paths: OraclePaths, to_eye: F64, area: F64, cos_0: F64) -> list[F64]:
    """The log densities of the first s vertices, made from the light, for s = 0 … k."""
    start = np.log(paths.emission) + np.log(np.where(paths.light_has_cosine, cos_0, 1))
    logs = [np.zeros(len(cos_0)), np.log(paths.next_event), start + area[:, 0]]
    for j in range(1, paths.edges):
        logs.append(logs[-1] + to_eye[:, j] + area[:, j])
    return logs


def _log_from_eye(paths: OraclePaths, to_light: F64, area: F64) -> list[F64]:
    """The log densities of the last t vertices, made from the lens, for t = 0 … k + 1; that of the lens itself is 0."""
    k = paths.edges
    logs = [np.zeros(len(area)), np.zeros(len(area)), np.log(paths.camera) + area[:, k - 1]]
    for j in range(k - 1, 0, -1):
        logs.append(logs[-1] + to_light[:, j] + area[:, j - 1])
    return logs
