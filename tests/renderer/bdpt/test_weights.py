from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from photonfarm.renderer.bdpt import weights


class RandomPath:
    """A path of k edges with made-up densities, v₀ on the light and v_k on the lens.

    Its weights can be written down directly. Paths of two edges are made by s=0 and s=1 alone: light paths are not
    joined to the lens at their first vertex.
    """

    def __init__(self, k: int, n: float, n_t: float, seed: int) -> None:
        u = np.random.default_rng(seed).uniform(0.2, 2.0, (6, k + 1))
        self.k, self.n, self.n_t = k, n, n_t  # edges; technique counts of connections and of light tracing
        self.r2, self.cos_left, self.cos_right = u[0] ** 2, u[1] / 2, u[2] / 2  # of edge i: cosines at vᵢ and vᵢ₊₁
        self.light, self.eye = (
            u[3],
            u[4],
        )  # solid-angle densities of scattering at vⱼ, away from the light, and towards it
        self.emission, self.nee_area, self.p_cam = u[5, :3] if k >= 2 else (1.0, 1.0, 1.0)

    def density(self, s: int) -> float:
        """Density of the technique with s light vertices, times its count."""
        k = self.k
        p = 1.0
        if s == 1:
            p *= self.nee_area
        if s >= 2:
            p *= self.emission * self.cos_right[0] / self.r2[0]
            for j in range(1, s - 1):
                p *= self.light[j] * self.cos_right[j] / self.r2[j]
        t = k + 1 - s
        if t >= 2:
            p *= self.p_cam * self.cos_left[k - 1] / self.r2[k - 1]
            for j in range(k - 1, k - t + 1, -1):
                p *= self.eye[j] * self.cos_left[j - 1] / self.r2[j - 1]
        return p * self.count(s)

    def count(self, s: int) -> float:
        if s <= 1:
            return 1
        if s == self.k:
            return self.n_t if self.k > 2 else 0
        return self.n

    def light_state(self, vertices: int) -> tuple[float, float]:
        """(dVCM, dVC) on arriving at v_j, j = vertices − 1."""
        cos_in = self.cos_right[0]
        before = weights.light_start(self.nee_area, self.emission), self.cos_left[0] / self.emission
        dvcm, dvc = weights.arrive(*before, self.r2[0], cos_in)
        for j in range(1, vertices - 1):
            count = 1 if j == 1 else self.n
            dvcm, dvc = weights.scatter(dvcm, dvc, count, self.cos_left[j], self.light[j], self.eye[j])
            dvcm, dvc = weights.arrive(dvcm, dvc, self.r2[j], self.cos_right[j])
        return dvcm, dvc

    def eye_state(self, last: int) -> tuple[float, float]:
        """(dVCM, dVC) on arriving at v_last; at the light itself, dVCM from before the arrival."""
        k = self.k
        dvcm, dvc = weights.arrive(
            float(weights.eye_start(mi.Float(self.n_t), mi.Float(self.p_cam))[0]),
            0.0,
            self.r2[k - 1],
            self.cos_left[k - 1],
        )
        for j in range(k - 1, last, -1):
            count = 1 if j == k - 1 else self.n
            before = weights.scatter(dvcm, dvc, count, self.cos_right[j - 1], self.eye[j], self.light[j])
            dvcm, dvc = weights.arrive(*before, self.r2[j - 1], self.cos_left[j - 1])
            if j - 1 == 0:
                dvcm = before[0]
        return dvcm, dvc

    def weight(self, s: int) -> float:
        k = self.k
        nee_direction = self.nee_area * self.r2[0] / self.cos_left[0]
        if s == 0:
            dvcm, dvc = self.eye_state(0)
            return weights.hit_emitter(nee_direction, self.emission, dvcm, dvc if k > 2 else 0.0)
        if s == 1:
            ratio = self.emission * self.cos_right[0] / (nee_direction * self.cos_left[0])
            count = 0 if k == 2 else self.n
            return weights.next_event(self.eye[1] / nee_direction, ratio, count, self.light[1], *self.eye_state(1))
        if s == k:
            if k == 2:
                return 0.0
            count = self.n
            camera = self.p_cam * self.cos_left[k - 1] / self.r2[k - 1]
            return weights.light_tracing(camera, self.n_t, count, self.eye[k - 1], *self.light_state(k))
        y, x = s - 1, s  # the joined vertices
        y_vcm, y_vc = self.light_state(s)
        x_vcm, x_vc = self.eye_state(x)
        light_sum = self.eye[x] * self.cos_left[y] * ((1 if y == 1 else self.n) * y_vcm + self.eye[y] * y_vc)
        eye_sum = self.light[y] * self.cos_right[y] * ((1 if x == k - 1 else self.n) * x_vcm + self.light[x] * x_vc)
        return weights.connection_over_r2(self.n, self.r2[y], light_sum, eye_sum) * self.r2[y]


@pytest.mark.parametrize("k", [2, 3, 4, 5, 7])
@pytest.mark.parametrize(("n", "n_t"), [(1.0, 1.0), (0.33, 0.25), (4.0, 2.0)])
def test_weights_are_the_balance_heuristic_of_the_densities(k: int, n: float, n_t: float) -> None:
    path = RandomPath(k, n, n_t, seed=k)
    densities = [path.density(s) for s in range(k + 1)]
    for s in range(k + 1):
        assert path.weight(s) == pytest.approx(densities[s] / sum(densities), rel=1e-5)


def test_a_sensor_that_cannot_be_hit_leaves_out_light_tracing() -> None:
    assert weights.eye_start(mi.Float(1.0), mi.Float(0.0))[0] == 0


def test_a_connection_of_touching_vertices_has_a_finite_weight() -> None:
    assert np.isfinite(weights.connection_over_r2(1.0, 0.0, 0.0, 0.0))
