"""What ids cover: what may change of a scene while its samples stay, and what another scene takes over."""

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from store_samples import reader_of

from photonfarm.core.errors import SpecError
from photonfarm.core.records import arrays_of
from photonfarm.farm.submission import submit
from photonfarm.plan.request import Request
from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.renderer.jobs.repeat import repeat
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import NamedSpec
from photonfarm.store import SceneStore, Store
from photonfarm.store.read.find import find_same_radiance

REQUEST = Request(modifications=3, views_per_modification=2)


def rendered(
    store: Store, spec: SceneSpec, analytic: ModuleType, load: Any = None, halves_from: str | None = None
) -> SceneStore:
    """The scene of a spec with all samples of a request rendered, in jobs of two."""
    store.plan(spec, REQUEST, shard_rows=2, halves_from=halves_from)
    scene: SceneStore = analytic.render_missing(store, spec.scene_id, load or analytic.AnalyticScene)
    return scene


def with_strategy(spec: SceneSpec, **strategy: Any) -> SceneSpec:
    return spec.model_copy(update={"transport": spec.transport.model_copy(update=strategy)})


@pytest.fixture
def spec(analytic: ModuleType) -> SceneSpec:
    return analytic.small_spec()  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    "changes",
    [
        {"exposure": 5.0},
        {"name": "renamed"},
        {"credits": {"title": "a room", "author": "ada", "licence": "CC0-1.0"}},
        {"transport": {"connections": 0, "light_ratio": 0.5, "guided_light": True, "light_samples": 4, "rr_depth": 9}},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_no_sample_is_lost_to_a_change_that_leaves_its_mean(
    tmp_path: Path, spec: SceneSpec, analytic: ModuleType, changes: dict[str, Any]
) -> None:
    store = Store(tmp_path / "store", create=True)
    before = rendered(store, spec, analytic)
    radiance = [sample.radiance for sample in map(reader_of(before).read, reader_of(before).rows)]
    changed = analytic.small_spec(**changes)
    assert changed.scene_id == spec.scene_id
    planned = store.plan(changed, REQUEST)
    assert (planned.new, planned.known) == (0, 6)
    reader = reader_of(store.scene(spec.scene_id))
    there = reader.spec.model_copy(update={"stored_exponent": None})
    assert there == changed
    assert reader.spec.radiance_exponent == spec.radiance_exponent, "that of the first submission"
    for row, halves in zip(reader.rows, radiance, strict=True):
        np.testing.assert_array_equal(reader.read(row).radiance, halves)


def test_each_jobs_marker_records_the_strategy_of_the_submission_before_it(
    tmp_path: Path, spec: SceneSpec, analytic: ModuleType
) -> None:
    store = Store(tmp_path / "store", create=True)
    store.plan(spec, REQUEST, shard_rows=2)
    worker = ShardRenderer(Store(tmp_path / "store"), worker="test", load=analytic.AnalyticScene.load)
    worker.render(spec.scene_id, 0)
    store.add(with_strategy(spec, connections=3))
    worker.render(spec.scene_id, 1)
    scene = store.scene(spec.scene_id)
    assert [scene.marker(job)["figures"]["strategy"]["connections"] for job in (0, 1)] == [1, 3]


def test_a_sample_is_repeated_by_the_strategy_that_it_was_rendered_by(
    tmp_path: Path, spec: SceneSpec, analytic: ModuleType
) -> None:
    class Strategic(analytic.AnalyticScene):  # type: ignore[name-defined, misc]
        """Adds the number of connections, so that another strategy gives other bytes."""

        def render_half(self, view: Any, seed: int) -> Any:
            return super().render_half(view, seed) + np.float32(self.spec.transport.connections)

    store = Store(tmp_path / "store", create=True)
    scene = rendered(store, spec, analytic, load=Strategic)
    other = analytic.small_spec(points=32)
    taken = rendered(store, other, analytic, load=Strategic, halves_from=scene.scene_id)
    for changed in (with_strategy(spec, connections=7), with_strategy(other, connections=7)):
        store.add(changed)
    for each in (scene, taken):
        again = repeat(store.root, each.scene_id, 0, None, print, load=Strategic)
        assert again.comparison is not None
        assert again.comparison.is_equal


@pytest.mark.parametrize("changes", [{"guides": {"light_samples": 0}}, {"points": 32}, {"photons": {"paths": 0}}])
def test_a_scene_with_other_inputs_takes_halves_over_and_renders_inputs_alone(
    tmp_path: Path, spec: SceneSpec, analytic: ModuleType, changes: dict[str, Any]
) -> None:
    store = Store(tmp_path / "store", create=True)
    scene = rendered(store, spec, analytic)
    other = analytic.small_spec(**changes)
    assert other.scene_id != spec.scene_id
    assert other.radiance_id == spec.radiance_id

    class NoHalves(analytic.AnalyticScene):  # type: ignore[name-defined, misc]
        def render_half(self, *_: Any) -> Any:
            raise AssertionError("halves are not to be rendered")

    taken = rendered(store, other, analytic, load=NoHalves, halves_from=scene.scene_id)
    there, here = reader_of(scene), reader_of(taken)
    assert there.rows_by_key() == here.rows_by_key()
    assert len(here.rows) == 6
    for row in here.rows:
        a, b = there.read(row, guides=True), here.read(row, guides=True)
        np.testing.assert_array_equal(a.radiance, b.radiance)
        for name, values in arrays_of(a.buffers).items():
            np.testing.assert_array_equal(values, getattr(b.buffers, name))
        assert a.guides is not None
        assert b.guides is not None
        same = np.array_equal(a.guides.direct, b.guides.direct)
        assert same == ("guides" not in changes)
    assert sum(taken.marker(job)["figures"]["taken_over"] for job in range(3)) == 6


def test_what_the_other_scene_lacks_is_rendered(tmp_path: Path, spec: SceneSpec, analytic: ModuleType) -> None:
    store = Store(tmp_path / "store", create=True)
    store.plan(spec, REQUEST, shard_rows=2)
    ShardRenderer(store, worker="test", load=analytic.AnalyticScene.load).render(spec.scene_id, 1)
    taken = rendered(store, analytic.small_spec(points=32), analytic, halves_from=spec.scene_id)
    assert [taken.marker(job)["figures"]["taken_over"] for job in range(3)] == [0, 2, 0]
    alone = rendered(Store(tmp_path / "alone", create=True), spec, analytic)
    for row in reader_of(alone).rows:
        np.testing.assert_array_equal(reader_of(alone).read(row).radiance, reader_of(taken).read(row).radiance)


def test_halves_of_another_radiance_are_refused(tmp_path: Path, spec: SceneSpec, analytic: ModuleType) -> None:
    store = Store(tmp_path / "store", create=True)
    rendered(store, spec, analytic)
    other = with_strategy(spec, half_spp=9)
    with pytest.raises(SpecError, match=r"its radiance is another one, as transport.half_spp differ"):
        store.plan(other, REQUEST, halves_from=spec.scene_id)
    with pytest.raises(SpecError, match="is the scene itself"):
        store.plan(spec, REQUEST, halves_from=spec.scene_id)
    assert store.scene_ids() == [spec.scene_id], "nothing was written"


def test_halves_that_are_damaged_there_are_rendered_and_the_healthy_scene_is_planned(
    tmp_path: Path, spec: SceneSpec, analytic: ModuleType
) -> None:
    store = Store(tmp_path / "store", create=True)
    scene = rendered(store, spec, analytic)
    file = scene.folder / "plans/000000/radiance/c.0.0.0.0.0"
    content = bytearray(file.read_bytes())
    content[40] ^= 1
    file.write_bytes(content)
    other = analytic.small_spec(points=32)
    taken = rendered(store, other, analytic, halves_from=scene.scene_id)
    assert [taken.marker(job)["figures"]["taken_over"] for job in range(3)] == [1, 2, 2]
    (scene.folder / "plans/000000/zarr.json").write_text("{")
    assert find_same_radiance(Store(tmp_path / "store"), other) is None
    assert find_same_radiance(Store(tmp_path / "store"), analytic.small_spec(points=48)) == other.scene_id


def test_a_submission_says_what_it_has_replaced_of_the_stored_spec(tmp_path: Path, analytic: ModuleType) -> None:
    store, replaced = tmp_path / "store", []
    for changes in ({}, {}, {"exposure": 2.0}, {"exposure": 2.0, "transport": {"connections": 0}}):
        named = NamedSpec("room.toml", analytic.small_spec(**changes), None)
        replaced.append(submit(named, store, None, REQUEST).replaced)
    assert replaced == [None, None, "exposure (1.0 before, 2.0 now)", "transport.connections (1 before, 0 now)"]
