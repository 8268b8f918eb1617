"""Which vertex of a light path is kept for connections, and with which throughput."""

from __future__ import annotations

from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from photonfarm.renderer.bdpt import light_paths, randomness
from photonfarm.renderer.bdpt.kept_vertices import KeptVertex
from photonfarm.renderer.bdpt.light_paths import PathOptions
from photonfarm.renderer.bdpt.lights.emission import read_lights
from tests.stability.scenes import hard_scenes

PATHS, EDGES = 1 << 15, 6


@pytest.fixture
def kept(monkeypatch: pytest.MonkeyPatch) -> tuple[KeptVertex, list[dict[str, np.ndarray]]]:
    """The kept vertices of light paths in the Cornell box, and what each step of the walk found."""
    steps: list[dict[str, np.ndarray]] = []

    def stepwise(*, state: Any, body: Any, **_: Any) -> Any:
        for _step in range(EDGES):
            dr.eval(state)
            (s,) = state
            si = s.hit.compute_surface_interaction(s.ray, mi.RayFlags.All, s.active)
            cos = dr.abs(dr.dot(si.n, s.ray.d))
            found = {"reached": s.active & (cos > 0) & (s.depth + 1 < EDGES), "cos": cos, "power": dr.max(s.throughput)}
            steps.append({name: np.array(column) for name, column in found.items()})
            state = body(s)
        return state

    monkeypatch.setattr(light_paths, "loop_once", stepwise)
    scene = mi.load_dict(hard_scenes.cornell(16), optimize=False)
    path = dr.arange(mi.UInt32, PATHS)
    sequence = randomness.stream(randomness.image_keys([3]), randomness.PHOTONS)
    rng = randomness.sampler(sequence + dr.zeros(mi.UInt32, PATHS), path)
    vertices = light_paths.trace_light_paths(
        scene,
        scene.sensors()[0],
        read_lights(scene),
        PathOptions(EDGES, 99, 1, mi.Float(1), mi.Float(1), connects=True, traces_light=False),
        rng=rng,
        path=path,
        paths=dr.opaque(mi.UInt32, PATHS),
        offset=mi.Float([0.5]),
        splat=cast(Any, None),
    )
    assert vertices is not None
    return vertices.read(path, mi.Bool(True)), steps


def test_a_vertex_is_drawn_in_proportion_to_its_throughput(kept: Any) -> None:
    vertex, steps = kept
    depth = np.array(vertex.depth)
    reached = np.stack([step["reached"] for step in steps])
    power = np.where(reached, np.stack([step["power"] for step in steps]), 0)
    assert ((depth > 0) == reached.any(0)).all()
    chosen, share = depth > 0, power / np.maximum(power.sum(0), 1e-30)
    assert share[:, chosen].std() > 0.2, "all vertices have the same throughput: nothing is tested"
    for k, expected in enumerate(share[: EDGES - 2], start=1):
        z = ((depth == k).sum() - expected.sum()) / np.sqrt((expected * (1 - expected)).sum() + 1e-30)
        assert (depth == k).sum() > 100
        assert abs(z) < 4, f"vertex {k}: {z:.1f} standard errors"


def test_the_kept_throughput_is_that_of_all_paths_over_their_number(kept: Any) -> None:
    """Every vertex stands for as much: paths of a larger throughput are drawn more often."""
    vertex, steps = kept
    depth = np.array(vertex.depth)
    chosen = np.flatnonzero(depth)
    reached = np.stack([step["reached"] for step in steps])
    power = np.where(reached, np.stack([step["power"] for step in steps]), 0)
    cos = np.stack([step["cos"] for step in steps])
    found = np.array(dr.max(vertex.throughput_over_cos))[chosen] * cos[depth[chosen] - 1, chosen]
    np.testing.assert_allclose(found, power.sum() / PATHS, rtol=1e-4)
