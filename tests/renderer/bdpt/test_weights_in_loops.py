"""The weights that a real render uses, as its loops compute them, against the oracle's for the same paths.

The integrator's loops run step by step, in Python, with all their arrays at hand; nothing of them is replaced but the
loop itself.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from photonfarm.renderer.bdpt import eye_paths, light_paths, weights
from photonfarm.renderer.bdpt.camera import sample_sensor
from photonfarm.renderer.bdpt.guiding.learning import PathGuide
from photonfarm.renderer.bdpt.guiding.usefulness import Usefulness
from photonfarm.renderer.bdpt.integrator import connection_count
from photonfarm.renderer.bdpt.kept_vertices import KeptVertices
from photonfarm.renderer.bdpt.lights.emission import AREA, DIRECTION, POSITION, DirectSample, read_lights
from tests.stability.scenes import hard_scenes
from tests.stability.weights import oracle
from tests.stability.weights.joined_paths import Bounce, JoinedPaths, Pinhole, TechniqueCounts
from tests.stability.weights.oracle_paths import stored, usefulness
from tests.stability.weights.weight_check import random_guide, random_usefulness

EDGES, SIZE, SPP = 5, 16, 8
CONNECTIONS, LIGHT_RATIO = 1, 0.5


@dataclass
class Recorder:
    """What one render did, step by step."""

    eye: list[Any] = field(default_factory=list)  # states before each step, and the last one
    light: list[Any] = field(default_factory=list)
    direct: list[Any] = field(default_factory=list)  # DirectSample at each step
    start: Any = None  # Emission
    weights: dict[str, list[Any]] = field(default_factory=dict)  # by function, one for each call
    connected: list[Any] = field(default_factory=list)  # (number of the light path, edges up to its kept vertex)
    r2: list[Any] = field(default_factory=list)  # of each connection


@pytest.fixture
def recorder(monkeypatch: pytest.MonkeyPatch) -> Recorder:
    found = Recorder()

    def keeping(states: list[Any]) -> Any:
        def stepwise(*, state: Any, body: Any, **_: Any) -> Any:
            for _step in range(EDGES):
                dr.eval(state)
                states.append(copied(state[0]))
                state = body(state[0])
            states.append(copied(state[0]))
            return state

        return stepwise

    def keep_results(module: Any, name: str, into: list[Any]) -> None:
        function = getattr(module, name)

        def keep(*arguments: Any, **more: Any) -> Any:
            into.append(function(*arguments, **more))
            dr.eval(into[-1])
            return into[-1]

        monkeypatch.setattr(module, name, keep)

    monkeypatch.setattr(eye_paths, "loop_once", keeping(found.eye))
    monkeypatch.setattr(light_paths, "loop_once", keeping(found.light))
    for name in ("hit_emitter", "next_event", "light_tracing"):
        keep_results(weights, name, found.weights.setdefault(name, []))
    over_r2, connect, draw = weights.connection_over_r2, eye_paths._connect, KeptVertices.draw

    def keep_connection(count: Any, r2: Any, *sums: Any) -> Any:
        found.r2.append(r2)
        found.weights.setdefault("connection", []).append(over_r2(count, r2, *sums) * r2)
        return over_r2(count, r2, *sums)

    def keep_path(vertices: KeptVertices, slot: Any, active: Any) -> Any:
        vertex = draw(vertices, slot, active)
        found.connected.append((dr.gather(mi.UInt32, vertices.slots, slot, active), vertex.depth))
        return vertex

    def evaluated(*arguments: Any) -> Any:
        value = connect(*arguments)
        dr.eval(value, found.connected, found.r2, found.weights)
        return value

    monkeypatch.setattr(weights, "connection_over_r2", keep_connection)
    monkeypatch.setattr(KeptVertices, "draw", keep_path)
    monkeypatch.setattr(eye_paths, "_connect", evaluated)
    keep_results(eye_paths, "sample_direct", found.direct)
    starts: list[Any] = []
    keep_results(light_paths, "sample_emission", starts)
    found.start = starts
    return found


def copied(state: Any) -> Any:
    """A state whose arrays later steps do not change in place."""
    names = [name for name in ("active", "throughput", "dvcm", "dvc", "depth") if hasattr(state, name)]
    copies = {name: type(getattr(state, name))(getattr(state, name)) for name in names}
    ray = mi.Ray3f(state.ray)
    hit = mi.PreliminaryIntersection3f(state.arrival if hasattr(state, "arrival") else state.hit)
    dr.eval(copies, ray, hit)
    return {**copies, "ray": ray, "si": hit.compute_surface_interaction(ray, mi.RayFlags.All, copies["active"])}


# ------------------------------------------------ Paths of a render ------------------------------------------------


def bounces_of(states: list[Any], last: int) -> list[Bounce]:
    """Vertices 0 … last of a walk; only mirrors are met, so the proportion of their densities is 1."""
    return [
        Bounce(
            states[i]["si"],
            states[i]["si"].bsdf(),
            states[i + 1]["dvcm"] == 0 if i < last else mi.Bool(False),
            mi.Float(1),
        )
        for i in range(last + 1)
    ]


def number_of(lights: Any, emitter: Any) -> Any:
    index = mi.UInt32(0)
    for k in range(lights.count):
        index = dr.select(emitter == dr.gather(mi.EmitterPtr, lights.pointers, mi.UInt32(k)), k, index)
    return index


def seen_light(d: Any, p: Any, *, infinite: Any, delta: Any) -> DirectSample:
    nothing = mi.Float(0)
    return DirectSample(d, p, infinite, mi.Spectrum(0), nothing, delta, nothing, mi.Bool(True))


def hits(scene: Any, lights: Any, states: list[Any], step: int) -> JoinedPaths:
    """Paths whose last edge has hit a light."""
    si, ray = states[step]["si"], states[step]["ray"]
    emitter = si.emitter(scene)
    index = number_of(lights, emitter)
    lit = states[step]["active"] & (emitter != dr.zeros(mi.EmitterPtr)) & (dr.max(emitter.eval(si)) > 0)
    light = seen_light(ray.d, si.p, infinite=~si.is_valid(), delta=mi.Bool(False))
    walked = bounces_of(states, step - 1)
    walked[-1].delta = states[step]["dvcm"] == 0
    return JoinedPaths(walked[::-1], light, emitter, index, si, lights.is_kind(index, AREA), None, lit)


def next_events(scene: Any, lights: Any, states: list[Any], step: int, light: DirectSample) -> JoinedPaths:
    """Paths that next event estimation has made at a vertex."""
    walked = bounces_of(states, step)
    si = walked[-1].si
    hit = scene.ray_intersect(si.spawn_ray(light.d), light.valid)
    near = hit.is_valid() & (dr.norm(hit.p - light.p) < 1e-3)
    area = ~light.at_infinity & ~light.delta
    free = ~scene.ray_test(si.spawn_ray_to(light.p), light.valid & ~light.at_infinity)
    seen = dr.select(light.at_infinity, ~hit.is_valid(), dr.select(area, near, free))
    emitter = dr.select(area | (light.at_infinity & ~light.delta), hit.emitter(scene), dr.zeros(mi.EmitterPtr))
    for k, kind in enumerate(lights.kinds):  # a single delta light of each kind
        if kind in (POSITION, DIRECTION):
            one = dr.gather(mi.EmitterPtr, lights.pointers, mi.UInt32(k))
            emitter = dr.select(light.delta & (light.at_infinity == (kind == DIRECTION)), one, emitter)
    index = number_of(lights, emitter)
    value = walked[-1].bsdf.eval(mi.BSDFContext(), si, si.to_local(light.d))
    hit.p = light.p
    complete = states[step]["active"] & light.valid & seen & (dr.max(value) > 0)
    return JoinedPaths(walked[::-1], light, emitter, index, hit, lights.is_kind(index, AREA), None, complete)


def seen_by_lens(lights: Any, states: list[Any], step: int, start: Any, joined: Any) -> JoinedPaths:
    """Paths that a light path's vertex makes with the lens."""
    index = number_of(lights, start.emitter)
    area = lights.is_kind(index, AREA)
    ray = states[0]["ray"]
    on_light = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray))
    on_light.p, on_light.n, on_light.uv = dr.select(area, start.sample.p, ray.o), start.sample.n, start.sample.uv
    on_light.sh_frame.n = start.sample.n
    light = seen_light(-ray.d, on_light.p, infinite=start.at_infinity, delta=start.delta)
    complete = states[step]["active"] & joined
    return JoinedPaths(bounces_of(states, step), light, start.emitter, index, on_light, area, None, complete)


def connections(lights: Any, recorder: Recorder, step: int, depth: int) -> JoinedPaths:
    """Paths that connect an eye path's vertex to a light path's vertex with ``depth`` edges behind it."""
    path, depths = recorder.connected[step]
    (start,) = recorder.start
    lit = seen_by_lens(lights, recorder.light, depth - 1, start, mi.Bool(True))

    def of_path(value: Any) -> Any:
        return dr.gather(type(value), value, path) if dr.width(value) > 1 else value

    own = bounces_of(recorder.eye, step)[::-1]
    others = [Bounce(of_path(b.si), of_path(b.bsdf), of_path(b.delta), b.turn) for b in lit.bounces]
    d = dr.normalize(others[-1].si.p - own[0].si.p)
    value = own[0].bsdf.eval(mi.BSDFContext(), own[0].si, own[0].si.to_local(d))
    joined = recorder.eye[step]["active"] & own[0].si.is_valid() & (depths == depth) & (dr.max(value) > 0)
    light = seen_light(
        *map(of_path, (lit.light.d, lit.light.p)),
        infinite=of_path(lit.light.at_infinity),
        delta=of_path(lit.light.delta),
    )
    index, area = of_path(lit.index), of_path(lit.is_area)
    return JoinedPaths([*others, *own], light, of_path(lit.emitter), index, of_path(lit.on_light), area, None, joined)


def errors(lights: Any, lens: Pinhole, counts: TechniqueCounts, joined: JoinedPaths, technique: int, ours: Any) -> Any:
    """[N]: relative difference of the loop's weight from the oracle's."""
    complete = np.array(joined.complete)
    if not complete.any():
        return np.zeros(0)
    paths = stored(lights, joined, lens)
    nominal = oracle.technique_counts(paths.edges, counts.count, counts.light_ratio)
    truth = oracle.weights(paths, nominal * usefulness(counts, paths))[:, technique]
    found = np.abs(np.broadcast_to(np.array(ours), complete.shape)[complete] - truth) / np.maximum(truth, 1e-4)
    return found[np.isfinite(truth)]


# ------------------------------------------------ Scenes ------------------------------------------------


def lit_by_everything(size: int) -> Any:
    """All kinds of lights, one wall a mirror, one rough."""
    scene = hard_scenes.many_lights(size)
    del scene["beam"]
    scene["left"] = {**scene["left"], "bsdf": {"type": "conductor"}}
    scene["back"] = {**scene["back"], "bsdf": {"type": "roughplastic", "alpha": 0.3}}
    return scene


@pytest.mark.parametrize(
    ("build", "guided"),
    [
        (hard_scenes.cornell, False),
        (hard_scenes.cornell, True),
        pytest.param(lit_by_everything, False, marks=pytest.mark.slow),
        (lit_by_everything, True),
    ],
)
def test_weights_of_a_render_are_the_oracles(build: Any, guided: bool, recorder: Recorder) -> None:
    scene = mi.load_dict(build(SIZE), optimize=False)
    lights, lens, guide, useful = read_lights(scene), Pinhole.of(scene), None, None
    bdpt = {"type": "bdpt", "max_depth": EDGES, "connections": CONNECTIONS, "light_ratio": LIGHT_RATIO, "rr_depth": 99}
    if guided:
        guide = PathGuide(random_guide(lights.count, seed=4), random_usefulness(seed=5))
        lights, useful = lights.guide_with(guide.starts, scene), Usefulness.over(scene, guide.usefulness_table)
    mi.load_dict(bdpt | {"guided_light": guided}).render(scene, seed=1, spp=SPP, guide=guide)
    counts = TechniqueCounts(connection_count(CONNECTIONS, EDGES, guided=guided), LIGHT_RATIO, useful)
    off: dict[str, list[Any]] = {"hit": [], "next event": [], "light tracing": [], "connection": []}
    for step in range(EDGES):
        if step > 0:
            paths = hits(scene, lights, recorder.eye, step)
            off["hit"].append(errors(lights, lens, counts, paths, 0, recorder.weights["hit_emitter"][step]))
        if step < EDGES - 1:
            paths = next_events(scene, lights, recorder.eye, step, recorder.direct[step])
            off["next event"].append(errors(lights, lens, counts, paths, 1, recorder.weights["next_event"][step]))
    for step in range(1, EDGES - 1):
        (start,) = recorder.start
        si = recorder.light[step]["si"]
        smooth = recorder.light[step]["active"] & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Smooth)
        seen = sample_sensor(scene.sensors()[0], si, mi.Point2f(0.5), smooth)
        value = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(seen.d))
        paths = seen_by_lens(lights, recorder.light, step, start, seen.valid & (dr.max(value) > 0))
        off["light tracing"].append(
            errors(lights, lens, counts, paths, step + 2, recorder.weights["light_tracing"][step])
        )
    for step in range(EDGES - 2):
        for depth in range(1, EDGES - 1 - step):
            paths = connections(lights, recorder, step, depth)
            off["connection"].append(
                errors(lights, lens, counts, paths, depth + 1, recorder.weights["connection"][step])
            )
    for technique, each in off.items():
        found = np.concatenate(each)
        assert len(found) > (20 if technique == "hit" else 200), technique
        # Rays start a little off the surface, so where a path is short or grazing, its vertices are not quite on it
        said = f"{technique}: {np.percentile(found, [50, 90, 99])} of {len(found)}"
        assert np.median(found) < 5e-4, said
        assert np.mean(found < 5e-3) > 0.97, said
