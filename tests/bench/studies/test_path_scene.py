"""The built-in room by Mitsuba's `path` instead of `bdpt`: the same light, other noise, all else equal."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from bench.harness.room_study import planned
from bench.studies import path_scene
from bench.studies.path_scene import Costs
from photonfarm.core.records import F32, arrays_of
from photonfarm.plan.request import Request
from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec
from photonfarm.scene.view import sample_view
from photonfarm.store import Sample, SceneReader, Store

SIZE, SPP = 16, 72


def tiny_room() -> SceneSpec:
    room = load_spec("room").model_dump()
    room |= {"points": 256, "photons": {"paths": 64, "depth": 2}}
    room["film"] |= {"width": SIZE, "height": SIZE}
    room["transport"] |= {"half_spp": 16}
    return SceneSpec.model_validate(room)


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Sample]]:
    """Two samples of each kind, rendered into a store of its own."""
    spec, found = tiny_room(), {}
    for kind, load in (("bdpt", None), ("path", partial(path_scene.load_path, spp=SPP))):
        store = Store(tmp_path_factory.mktemp(kind) / "store", create=True)
        scene = planned(spec, store, [Request(modifications=2, seed=3)], 2)
        renderer = ShardRenderer(store, worker="test", **({"load": load} if load else {}))
        for job in scene.missing_jobs():
            assert renderer.render(spec.scene_id, job)
        reader = SceneReader(store.root, spec.scene_id)
        found[kind] = [reader.read(row) for row in reader.refresh().tolist()]
        assert path_scene.rendered(store, spec, SPP).core_s > 0
    return found


def standard_error(halves: F32) -> float:
    """The standard error of the mean over both halves' pixels (2, H, W, 3), which have noise of their own."""
    apart = (halves[0].astype(np.float64) - halves[1]).mean(axis=-1) / 2
    return math.sqrt(float(np.sum(apart**2))) / apart.size


def test_both_kinds_have_the_same_mean(samples: dict[str, list[Sample]]) -> None:
    for ours, theirs in zip(samples["bdpt"], samples["path"], strict=True):
        off = float(theirs.radiance.mean(dtype=np.float64) - ours.radiance.mean(dtype=np.float64))
        error = math.hypot(standard_error(ours.radiance), standard_error(theirs.radiance))
        assert error < 0.05 * ours.radiance.mean()
        assert abs(off) < 4 * error


def test_all_but_the_noise_is_the_same(samples: dict[str, list[Sample]]) -> None:
    for ours, theirs in zip(samples["bdpt"], samples["path"], strict=True):
        np.testing.assert_array_equal(ours.view.vector, theirs.view.vector)
        np.testing.assert_array_equal(ours.modification.vector, theirs.modification.vector)
        np.testing.assert_array_equal(ours.visibility.points, theirs.visibility.points)
        for name, values in arrays_of(ours.buffers).items():
            np.testing.assert_array_equal(values, arrays_of(theirs.buffers)[name])
        images = [half for sample in (ours, theirs) for half in sample.radiance]
        assert all(np.any(images[i] != images[j]) for i in range(4) for j in range(i))


def test_samples_of_path_are_stratified_and_as_many_as_asked_for() -> None:
    scene, spec = path_scene.load_path(tiny_room(), 20), tiny_room()
    view = sample_view(spec, bytes(16), 0, 0)
    sampler = scene._sensor.aim(view).sampler()
    assert scene.render_halves(view, (1, 2)).shape == (2, SIZE, SIZE, 3)
    assert (sampler.class_name(), sampler.sample_count()) == ("MultijitterSampler", 20)


def test_a_sample_of_path_costs_about_what_one_of_bdpt_does_and_fills_a_grid() -> None:
    costs = Costs(bdpt_s=0.5, path_fixed_s=0.04, path_spp_s=0.02)
    assert costs.path_spp == 24  # of 23
    assert [path_scene.filling_a_grid(spp) for spp in (-1, 0.1, 2, 4, 8, 16, 21, 64)] == [3, 3, 3, 3, 9, 15, 20, 63]
    assert Costs(bdpt_s=0.05, path_fixed_s=0.04, path_spp_s=0.2).path_spp == 3


def test_costs_are_measured_once(tmp_path: Path) -> None:
    (tmp_path / "costs.json").write_text('{"bdpt_s": 0.5, "path_fixed_s": 0.1, "path_spp_s": 0.1}')
    assert path_scene.costs_of(tiny_room(), tmp_path) == Costs(0.5, 0.1, 0.1)
