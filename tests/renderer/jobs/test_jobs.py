"""One job: the scene edited least, every half with its own seed, bad luck drawn again, wrong scenes refused."""

from itertools import islice
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from photonfarm.core.errors import IncompleteError, QueueError, SceneNotHereError
from photonfarm.core.keys import seed_of
from photonfarm.core.records import Visibility, arrays_of
from photonfarm.plan.request import Request
from photonfarm.renderer.jobs import estimates
from photonfarm.renderer.jobs import render as jobs
from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.scene.spec_loading import load_spec, locate
from photonfarm.scene.view import sample_view
from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.format import markers
from photonfarm.store.model.lease import LeasedError, hold_lease


@pytest.fixture
def scene(analytic: ModuleType, store: Store) -> SceneStore:
    """Two jobs: 3 modifications × 2 views × 2 passes, 8 samples a job."""
    request = Request(modifications=3, views_per_modification=2, passes=2)
    return store.scene(store.plan(analytic.small_spec(), request, shard_rows=8).scene_id)


@pytest.fixture
def recorded(analytic: ModuleType) -> type:
    """An analytic scene that writes down what is asked of it, and whose first `bad` renders are not finite."""

    class Recorded(analytic.AnalyticScene):  # type: ignore[name-defined, misc]
        calls: list[tuple[str, Any]] = []  # noqa: RUF012
        loads = 0
        bad = 0

        @classmethod
        def load(cls, spec: Any) -> Any:
            cls.loads += 1
            return cls(spec)

        def apply(self, modification: Any) -> None:
            self.calls.append(("apply", modification.vector.tobytes()))
            super().apply(modification)

        def inputs(self, views: Any, keys: Any, *how: Any) -> Any:
            self.calls += [("buffers", view.vector.tobytes()) for view in views]
            self.calls += [("guides", key) for key in keys]
            return super().inputs(views, keys, *how)

        def photons(self, seed: int) -> Any:
            self.calls.append(("photons", seed))
            return super().photons(seed)

        def render_half(self, view: Any, seed: int) -> Any:
            self.calls.append(("half", seed))
            image = super().render_half(view, seed)
            if type(self).bad > 0:
                type(self).bad -= 1
                image[0, 0, 0] = np.inf
            return image

    return Recorded


def asked(recorded: type, what: str) -> list[Any]:
    return [value for name, value in recorded.calls if name == what]


def render_all(scene: SceneStore, store: Store, kind: type) -> None:
    renderer = ShardRenderer(store, worker="test", load=kind.load)
    for job in scene.missing_jobs():
        assert renderer.render(scene.scene_id, job)


def test_each_modification_is_applied_once_a_job_and_each_view_seen_once_in_all(
    scene: SceneStore, store: Store, recorded: type
) -> None:
    render_all(scene, store, recorded)
    assert len(asked(recorded, "apply")) == 3
    assert len(asked(recorded, "buffers")) == len(set(asked(recorded, "buffers"))) == 6
    reader = SceneReader(store.root, scene.scene_id)
    keys = reader.view_keys(reader.refresh().tolist())
    assert sorted(asked(recorded, "guides")) == sorted(set(keys)), "their noise follows from the keys of their views"
    assert len(asked(recorded, "photons")) == 3
    assert recorded.loads == 1


@pytest.mark.parametrize("shard_rows", [1, 3])
def test_photons_that_another_job_stores_are_traced_again_and_seen_the_same(
    analytic: ModuleType, scene: SceneStore, store: Store, recorded: type, tmp_path: Path, shard_rows: int
) -> None:
    """The same 12 samples in jobs of 8 and in smaller ones, where views and modification of many are apart."""
    render_all(scene, store, recorded)
    split = Store(tmp_path / "split", create=True)
    request = Request(modifications=3, views_per_modification=2, passes=2)
    apart = split.scene(split.plan(analytic.small_spec(), request, shard_rows=shard_rows).scene_id)
    recorded.calls.clear()
    render_all(apart, split, recorded)
    traced = asked(recorded, "photons")
    assert len(set(traced)) == 3 < len(traced)
    whole, parts = seen_in(store, scene), seen_in(split, apart)
    assert whole.keys() == parts.keys()
    for name in ("points", "photons"):
        bits, again = (np.stack([getattr(of[key], name) for key in sorted(whole)]) for of in (whole, parts))
        assert 0.1 < bits.mean() < 0.9
        np.testing.assert_array_equal(bits, again, err_msg=name)


def seen_in(store: Store, scene: SceneStore) -> dict[bytes, Visibility]:
    """What each view sees, by its content key."""
    reader = SceneReader(store.root, scene.scene_id)
    return {reader.view_key(row): reader.read(row).visibility for row in reader.refresh().tolist()}


def test_points_of_a_removed_group_are_not_seen_even_if_the_scene_says_so(
    analytic: ModuleType, store: Store, recorded: type, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All points of the analytic scene are of its one object."""
    monkeypatch.setattr(recorded, "sees", lambda _, views, position: np.ones((len(views), len(position)), np.bool_))
    (movable,) = analytic.small_spec().model_dump()["objects"]
    spec = analytic.small_spec(objects=[{**movable, "removal_probability": 0.5}])
    scene = store.scene(store.plan(spec, Request(modifications=16), shard_rows=16).scene_id)
    render_all(scene, store, recorded)
    reader = SceneReader(store.root, scene.scene_id)
    samples = [reader.read(row) for row in reader.refresh().tolist()]
    assert {bool(sample.modification.present[0]) for sample in samples} == {True, False}
    for sample in samples:
        assert (sample.visibility.points == sample.modification.present[0]).all()
        assert sample.visibility.photons.all()


def test_every_half_has_its_own_seed_which_follows_from_the_samples_key(
    scene: SceneStore, store: Store, recorded: type
) -> None:
    render_all(scene, store, recorded)
    seeds = asked(recorded, "half")
    samples = [s for job in range(2) for s in scene.job_rows(job).samples]
    assert seeds == [seed_of(s.key, half) for s in samples for half in ("half A", "half B")]
    assert len(set(seeds)) == 24
    reader = SceneReader(store.root, scene.scene_id)
    for row in reader.refresh():
        a, b = reader.read(int(row)).radiance
        assert not np.array_equal(a, b)


def test_samples_rendered_together_are_stored_as_if_each_had_been_rendered_alone(
    store: Store, small: Any, tmp_path: Path
) -> None:
    """The built-in room: two configurations, of which each has two views and two passes of these."""
    spec = small(load_spec("room"))
    request, seen = Request(modifications=2, views_per_modification=2, passes=2), []
    for together, where in ((1, store), (3, Store(tmp_path / "together", create=True))):
        scene = where.scene(where.plan(spec, request, shard_rows=8).scene_id)

        def load(spec: Any, together: int = together) -> LoadedScene:
            loaded = LoadedScene.load(spec)
            loaded.samples_at_once = together
            return loaded

        assert ShardRenderer(where, worker="test", load=load).render(scene.scene_id, 0)
        reader = SceneReader(where.root, scene.scene_id)
        seen.append([reader.read(row, guides=True) for row in reader.refresh().tolist()])
    assert len(seen[0]) == len(seen[1]) == 8
    for alone, with_others in zip(*seen, strict=True):
        np.testing.assert_array_equal(alone.radiance, with_others.radiance)
        for part in ("buffers", "guides", "visibility"):
            there = arrays_of(getattr(with_others, part))
            for name, values in arrays_of(getattr(alone, part)).items():
                np.testing.assert_array_equal(values, there[name], err_msg=name)


@pytest.mark.parametrize(
    ("side", "light_ratio", "together"), [(32, 1.0, 8), (64, 0.25, 8), (128, 1.0, 2), (256, 1.0, 1), (64, 0.0001, 1)]
)
def test_a_processor_renders_a_few_samples_of_small_images_together_if_their_bytes_stay(
    small: Any, side: int, light_ratio: float, together: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the last ratio an image has one light path or two, and ends within a vector."""
    monkeypatch.setattr(backend, "paths_at_once", lambda: None)
    spec = small(load_spec("cornell"), side, side)
    transport = spec.transport.model_copy(update={"light_ratio": light_ratio})
    assert LoadedScene.load(spec.model_copy(update={"transport": transport})).samples_at_once == together


def test_of_samples_rendered_together_only_what_is_not_finite_is_drawn_again(
    scene: SceneStore, store: Store, recorded: type, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorded, "samples_at_once", 3, raising=False)
    monkeypatch.setattr(recorded, "bad", 2)
    render_all(scene, store, recorded)
    seeds = asked(recorded, "half")
    assert len(seeds) == len(set(seeds)) == 24 + 2
    assert [scene.marker(job)["figures"]["redrawn"] for job in (0, 1)] == [2, 0]
    samples = [s for job in range(2) for s in scene.job_rows(job).samples]
    first = [seed_of(s.key, half) for s in samples for half in ("half A", "half B")]
    again = [seed_of(samples[0].key, f"{half}, attempt 1") for half in ("half A", "half B")]
    assert seeds == [*first[:6], *again, *first[6:]]


@pytest.mark.parametrize("bad", [0, 1])
def test_the_first_half_alone_is_that_of_the_sample_also_where_it_is_drawn_again(
    analytic: ModuleType, recorded: type, bad: int
) -> None:
    loaded, key = recorded.load(analytic.small_spec()), b"k" * 16
    view = sample_view(loaded.spec, key, 0, 0)
    recorded.bad = bad
    alone = estimates.half_of(loaded, key, view)
    recorded.bad = bad
    ((halves, thrown),) = estimates.halves_of(loaded, [(key, view)])
    assert thrown == bad
    np.testing.assert_array_equal(alone, halves[0])


def test_a_half_never_takes_the_seed_of_the_other() -> None:
    taken = seed_of(b"k" * 16, "half B")
    tried = list(islice(estimates._seeds(b"k" * 16, "half B", (taken,)), estimates.ATTEMPTS))
    assert len(tried) == len(set(tried)) == estimates.ATTEMPTS
    assert taken not in tried


def test_after_three_renders_that_are_not_finite_the_job_fails_and_nothing_is_stored(
    scene: SceneStore, store: Store, recorded: type
) -> None:
    recorded.bad = 4  # both halves of the first try, then A twice
    with pytest.raises(IncompleteError, match="half A"):
        render_all(scene, store, recorded)
    assert scene.missing_jobs() == [0, 1]


@pytest.mark.parametrize(("place", "name"), [(0, "normal"), (1, "direct")])
def test_buffers_and_guides_that_are_not_finite_fail_the_job_and_name_view_and_sample(
    scene: SceneStore, store: Store, recorded: type, monkeypatch: pytest.MonkeyPatch, place: int, name: str
) -> None:
    plain = recorded.inputs

    def broken(*how: Any) -> Any:
        made = plain(*how)
        getattr(made[0][place], name)[0, 0, 0] = np.nan
        return made

    monkeypatch.setattr(recorded, "inputs", broken)
    with pytest.raises(IncompleteError, match=f"{name} of view 0 .sample "):
        render_all(scene, store, recorded)
    assert scene.missing_jobs() == [0, 1]


def test_a_job_that_is_not_committed_says_who_came_between(
    scene: SceneStore, store: Store, recorded: type, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Another commits it before we do."""
    place = markers.place_marker

    def meanwhile(*about: Any) -> bool:
        monkeypatch.setattr(markers, "place_marker", place)
        assert ShardRenderer(Store(store.root), worker="other", load=recorded.load).render(scene.scene_id, 0)
        return place(*about)

    monkeypatch.setattr(markers, "place_marker", meanwhile)
    assert not ShardRenderer(store, worker="test", load=recorded.load).render(scene.scene_id, 0)
    (said,) = [record.getMessage() for record in caplog.records]
    assert scene.is_committed(0)
    assert "was committed by another worker" in said


def test_a_job_tells_its_phases_and_each_sample_and_only_the_first_compiles(
    scene: SceneStore, store: Store, recorded: type
) -> None:
    told: list[tuple[str, int, int]] = []
    renderer = ShardRenderer(store, worker="test", load=recorded.load, on_progress=lambda *said: told.append(said))
    for job in (0, 1):
        told.clear()
        renderer.render(scene.scene_id, job)
        count = len(scene.job_rows(job).samples)
        first = jobs.COMPILES if job == 0 else jobs.RENDERS_SAMPLES
        loads = [(jobs.LOADS, 0, 0)] if job == 0 else []
        steps = [(first if done == 0 else jobs.RENDERS_SAMPLES, done, count) for done in range(count)]
        assert told == [*loads, *steps, (jobs.COMMITS, count, count)]


def test_few_scenes_are_kept_loaded(analytic: ModuleType, store: Store, recorded: type) -> None:
    renderer = ShardRenderer(store, worker="test", load=recorded.load)
    ids = [
        store.plan(analytic.small_spec(points=n), Request(modifications=2), shard_rows=1).scene_id for n in (1, 2, 3)
    ]
    for scene_id, job in [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1)]:
        renderer.render(ids[scene_id], job)
    assert recorded.loads == 4


def test_a_scene_file_that_is_not_the_planned_one_is_refused(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recorded: type
) -> None:
    from photonfarm.scene.spec import SceneSpec
    from photonfarm.scene.spec_loading import parse_spec

    folders = [tmp_path / "planned", tmp_path / "here"]
    for i, folder in enumerate(folders):
        folder.mkdir()
        (folder / "scene.xml").write_text(f'<scene version="3.0.0"><integer name="n" value="{i}"/></scene>')
    unit = {"min": [0, 0, 0], "max": [1, 1, 1]}
    described = {"name": "file", "scene": {"file": "scene.xml"}, "view": {"origin": unit, "look_at": unit}}
    spec: SceneSpec = parse_spec(described, where="test", beside=folders[0])
    result = store.plan(spec, Request())
    renderer = ShardRenderer(store, worker="test", load=recorded.load)
    with pytest.raises(SceneNotHereError, match="PHOTONFARM_SCENES"):
        renderer.render(result.scene_id, 0)
    monkeypatch.setenv("PHOTONFARM_SCENES", str(folders[1]))
    with pytest.raises(SceneNotHereError):
        renderer.render(result.scene_id, 0)
    monkeypatch.setenv("PHOTONFARM_SCENES", str(folders[0]))
    assert locate(spec) == spec


def test_a_job_that_is_not_planned_is_refused_and_one_of_a_forgotten_scene_is_dropped(
    store: Store, scene: SceneStore, recorded: type
) -> None:
    renderer = ShardRenderer(store, worker="test", load=recorded.load)
    with pytest.raises(QueueError, match="has no job 99"):
        renderer.render(scene.scene_id, 99)
    assert not renderer.render("0" * 32, 0)


def test_a_leased_scene_is_not_rendered(store: Store, scene: SceneStore, recorded: type) -> None:
    renderer = ShardRenderer(store, worker="test", load=recorded.load)
    with hold_lease(store.storage, scene.scene_id, "store join", pytest.fail), pytest.raises(LeasedError):
        renderer.render(scene.scene_id, 0)
    assert renderer.render(scene.scene_id, 0)
