"""`photonfarm measure-frames`: what kinds of surface a frame shows, and what its parts cost."""

import shutil
from collections.abc import Callable
from itertools import islice, pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from photonfarm.core.archives import PARTS, FrameCosts, Surface
from photonfarm.core.errors import IncompleteError, StoreError
from photonfarm.plan.request import Request
from photonfarm.renderer.cli.sample_verbs import measure_frames
from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.renderer.tools.measure.frame_costs import (
    WARM_UPS,
    PartialFilm,
    TimedFrame,
    frame_costs,
    part_of,
    surface_kinds,
    take_turns,
)
from photonfarm.scene.modification import Modification, rest
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec, parse_spec
from photonfarm.scene.view import View
from photonfarm.store import SceneReader, Store

DIFFUSE = {"type": "diffuse"}
MIRROR = {"type": "conductor"}
SHINES = {"type": "area", "radiance": {"type": "rgb", "value": [1, 1, 1]}}
INTO_THE_BOX = View(np.array([0.1, 1, 3], np.float32), np.array([0, 1, 0], np.float32))


def plain(film: int = 16, **changes: Any) -> SceneSpec:
    """The static box, looked into from outside; anything in it is between near and far plane."""
    point = {"min": [-1, -1, -1], "max": [1, 1, 1]}
    described = {
        "name": "plain",
        "scene": {"builtin": "cornell"},
        "view": {"origin": point, "look_at": point, "fov_deg": 60},
        "film": {"width": film, "height": film},
        "points": 64,
        "photons": {"paths": 0},
        **changes,
    }
    return parse_spec(described, where="test")


def frame(view: View, modification: Modification, key: str = "same", row: int = 0) -> TimedFrame:
    return TimedFrame(row, modification, view, key.encode())


# ------------------------------------------------------------------------------------------------------------- surfaces


def kinds_of(shape: dict[str, Any], near: float = 0.01, far: float = 100) -> np.ndarray:
    """The kinds of surface of a rectangle at the origin, ±1 across, seen from 3 in front: it fills no corner."""
    mi = backend.load(1)
    scene = mi.load_dict({"type": "scene", "shape": {"type": "rectangle", **shape}}, optimize=False)
    spec = plain(view={**plain().view.model_dump(mode="json"), "near": near, "far": far})
    return surface_kinds(scene, View(np.array([0, 0, 3], np.float32), np.zeros(3, np.float32)), spec)


@pytest.mark.parametrize(
    ("shape", "kind"),
    [
        ({"bsdf": DIFFUSE}, Surface.DIFFUSE),
        ({"bsdf": {"type": "twosided", "bsdf": DIFFUSE}}, Surface.DIFFUSE),
        ({"bsdf": {"type": "mask", "opacity": 0.5, "bsdf": DIFFUSE}}, Surface.DIFFUSE),
        ({"bsdf": {"type": "plastic"}}, Surface.SPECULAR),
        ({"bsdf": {"type": "roughconductor"}}, Surface.SPECULAR),
        ({"bsdf": {"type": "blendbsdf", "weight": 0.5, "a": DIFFUSE, "b": MIRROR}}, Surface.SPECULAR),
        ({"bsdf": MIRROR}, Surface.MIRROR),
        ({"bsdf": {"type": "dielectric"}}, Surface.MIRROR),
        ({"bsdf": {"type": "null"}}, Surface.MIRROR),
        ({"bsdf": DIFFUSE, "emitter": SHINES}, Surface.EMITTER),
    ],
)
def test_a_surface_has_the_kind_of_its_lobes_and_around_it_is_nothing(shape: dict[str, Any], kind: Surface) -> None:
    kinds = kinds_of(shape)
    assert kinds.dtype == np.uint8
    assert (kinds[4:12, 4:12] == kind).all()
    assert (kinds[[0, 0, -1, -1], [0, -1, 0, -1]] == Surface.NOTHING).all()


@pytest.mark.parametrize("limits", [{"near": 3.1}, {"far": 2.9}])
def test_what_the_planes_cut_off_is_nothing(limits: dict[str, float]) -> None:
    assert (kinds_of({"bsdf": DIFFUSE}, **limits) == Surface.NOTHING).all()


# ------------------------------------------------------------------------------------------------------ fewer pixels


@pytest.mark.parametrize(("k", "size"), [(1, (24, 16)), (3, (14, 9)), (1000, (1, 1))])
def test_one_of_k_pixels_are_a_smaller_film_with_as_many_light_paths(
    small: Callable[..., SceneSpec], k: int, size: tuple[int, int]
) -> None:
    spec = small(load_spec("room"))
    part = part_of(spec, k)
    assert (part.film.width, part.film.height) == size
    assert part.transport.half_spp == spec.transport.half_spp
    light_paths = part.transport.light_ratio * size[0] * size[1]
    assert light_paths == (pytest.approx(24 * 16) if k < 64 else 64)


def test_all_pixels_are_the_scenes_own_image_and_fewer_show_the_same(room: LoadedScene, somewhere: View) -> None:
    room.apply(rest(room.spec))
    whole = PartialFilm(room.spec, 1).render(room.scene, somewhere, 5)
    np.testing.assert_array_equal(whole, room.render_half(somewhere, 5))
    spec = room.spec.model_copy(update={"transport": room.spec.transport.model_copy(update={"half_spp": 256})})
    few = PartialFilm(spec, 16)
    assert few.spec.film.width * few.spec.film.height == 24
    image = few.render(room.scene, somewhere, 6)
    averaged = PartialFilm(spec, 1).render(room.scene, somewhere, 7).reshape(4, 4, 6, 4, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(image, averaged, rtol=0.25, atol=0.02)


# ---------------------------------------------------------------------------------------------------------------- times


def test_a_sixteenth_of_the_pixels_takes_less_than_half_the_time_of_all() -> None:
    transport = {"light_ratio": 0, "connections": 0, "half_spp": 16}
    spec = plain(film=128, transport=transport)
    scene = LoadedScene.load(spec)
    costs = frame_costs(
        scene, scene.base()[1], [frame(INTO_THE_BOX, rest(spec))], amounts=[(16, 1), (1, 1), (1, 4)], timed=5
    )
    times = {amount: render.median for amount, render in costs.renders().items()}
    assert 0 < times[16, 1] < 0.5 * times[1, 1]
    assert times[1, 1] < times[1, 4] < 5 * times[1, 1]
    for name in PARTS:
        assert (getattr(costs, name) > 0).all() == ("photons" not in name), name
    assert costs.parts()["photons_s"].median == costs.parts()["photons_seen_s"].median == 0  # a scene without


def test_neighbouring_frames_differ_in_configuration(somewhere: View) -> None:
    at_rest = rest(plain())
    frames = [frame(somewhere, at_rest, key, row) for row, key in enumerate("AAABBC")]
    assert [each.row for each in islice(take_turns(frames), 10)] == [0, 3, 5, 1, 4, 5, 2, 3, 5, 0]
    assert all(one.key != other.key for one, other in pairwise(islice(take_turns(frames), 50)))


@pytest.mark.parametrize("configurations", [1, 2])
def test_every_timed_frame_comes_from_another_configuration(
    room: LoadedScene, somewhere: View, monkeypatch: pytest.MonkeyPatch, configurations: int
) -> None:
    shifted = [rest(room.spec) for _ in range(configurations)]
    for place, modification in enumerate(shifted):
        modification.translation[0] = 0.1 * (1 + place)
    frames = [frame(somewhere, each, str(place), place) for place, each in enumerate(shifted)]
    applied: list[float] = []
    monkeypatch.setattr(room, "apply", lambda modification: applied.append(float(modification.translation[0, 0])))
    frame_costs(room, room.base()[1], frames, amounts=[(1, 1)], timed=2)
    timed = applied[-(WARM_UPS + 2) * (3 - configurations) :]  # a single one is left for the scene at rest in between
    assert timed == pytest.approx([0, 0.1] * 4 if configurations == 1 else [0.1, 0.2] * 2)


def test_each_part_is_charged_with_its_own_seconds(
    room: LoadedScene, somewhere: View, monkeypatch: pytest.MonkeyPatch
) -> None:
    cloud, photons, clock = room.base()[1], room.photons(0), [0.0]

    def takes(seconds: Callable[..., float], result: Callable[..., Any]) -> Callable[..., Any]:
        def work(*arguments: Any) -> Any:
            clock[0] += seconds(*arguments)
            return result(*arguments)

        return work

    monkeypatch.setattr(
        "photonfarm.renderer.tools.measure.frame_costs.time", SimpleNamespace(perf_counter=lambda: clock[0])
    )
    monkeypatch.setattr("photonfarm.renderer.scene.backend.work_s", lambda: clock[0])
    monkeypatch.setattr(room, "apply", takes(lambda _: 1, lambda _: None))
    monkeypatch.setattr(room, "buffers", takes(lambda _: 10, lambda _: None))
    monkeypatch.setattr(
        room, "inputs", takes(lambda _, __, wanted, ___: 500 * (1 + (wanted.light_samples > 0)), lambda *_: None)
    )
    monkeypatch.setattr(room, "photons", takes(lambda _: 100, lambda _: photons))
    monkeypatch.setattr(
        room, "sees", takes(lambda _, points: len(points), lambda _, points: np.ones((1, len(points)), bool))
    )
    monkeypatch.setattr(
        PartialFilm,
        "render",
        takes(lambda film, *_: film.spec.film.width * film.spec.transport.half_spp, lambda *_: None),
    )
    costs = frame_costs(room, cloud, [frame(somewhere, rest(room.spec))], amounts=[(4, 1), (1, 1), (1, 3)], timed=2)
    assert {name: part.median for name, part in costs.parts().items()} == {
        "edit_s": 1,
        "buffers_s": 10,
        "surface_s": 500,
        "guides_s": 1000,
        "points_s": 4096,
        "photons_s": 100,
        "photons_seen_s": 8192,
    }
    half_spp = room.spec.transport.half_spp
    times = {amount: render.median / half_spp for amount, render in costs.renders().items()}
    assert times == {(4, 1): 12, (1, 1): 24, (1, 3): 72}
    for seconds, timed in ((1, 1), (1.5 * sum(part.median for part in costs.parts().values()), 2)):
        few = frame_costs(room, cloud, [frame(somewhere, rest(room.spec))], amounts=[], timed=5, seconds=seconds)
        assert (len(few.edit_s), few.renders()) == (timed, {}), "in limited time after the warm-ups; without images"


# ------------------------------------------------------------------------------------------------------------- the verb


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory, small: Callable[..., SceneSpec]) -> Store:
    """A store with four rows of the room: two views of each of two configurations."""
    made = Store(tmp_path_factory.mktemp("rows") / "store", create=True)
    request = Request(modifications=2, views_per_modification=2, seed=1)
    scene_id = made.plan(small(load_spec("room")), request, shard_rows=4).scene_id
    ShardRenderer(made, worker="test").render(scene_id, 0)
    return made


def verb(store: Store, out: Path, *more: str, scene: str = "room") -> list[str]:
    return ["--store", str(store.root), "--scene", scene, "--out", str(out / "costs.npz"), *more]


def test_the_verb_measures_rows_and_leaves_the_store_as_it_is(tmp_path: Path, store: Store, room: LoadedScene) -> None:
    before = sorted(Path(store.root).rglob("*"))
    options = [
        "--row",
        "3",
        "--row",
        "0",
        "--kept",
        "1",
        "--kept",
        "4",
        "--halves",
        "2",
        "--timed",
        "3",
        "--points",
        "100",
    ]
    result = CliRunner().invoke(measure_frames, verb(store, tmp_path, *options), catch_exceptions=False)
    assert result.exit_code == 0
    parts, last = result.stdout.splitlines()
    assert "render_s 1/4 0." in parts
    assert last == f"{tmp_path / 'costs.npz'}: 2 rows, 3 timed frames"
    costs = FrameCosts.read(tmp_path / "costs.npz")
    assert costs.scene_id == room.spec.scene_id
    assert (costs.rows.tolist(), [*costs.renders()]) == ([3, 0], [(1, 1), (4, 1), (1, 2)])
    assert all((getattr(costs, name) > 0).all() and getattr(costs, name).shape == (3,) for name in PARTS)
    assert costs.render_s.shape == (3, 3)
    assert (costs.render_s > 0).all()
    reader = SceneReader(store.root, room.spec.scene_id)
    reader.refresh()
    for row, surface in zip((3, 0), costs.surface, strict=True):
        modification, view, _ = reader.inputs(row)
        room.apply(modification)
        np.testing.assert_array_equal(surface, surface_kinds(room.scene, view, room.spec))
    assert len(np.unique(costs.surface)) >= 3
    assert sorted(Path(store.root).rglob("*")) == before


@pytest.mark.parametrize(
    ("scene", "rows", "named"),
    [
        ("room", ["2", "4"], "no row 4"),
        ("attic", ["0"], "'attic'"),
    ],
)
def test_a_row_or_a_scene_that_is_not_there_is_named(
    tmp_path: Path, store: Store, scene: str, rows: list[str], named: str
) -> None:
    options = [part for row in rows for part in ("--row", row)]
    result = CliRunner().invoke(measure_frames, verb(store, tmp_path, *options, scene=scene))
    assert isinstance(result.exception, StoreError)
    assert result.exception.exit_code == 4
    assert named in str(result.exception)
    assert not list(tmp_path.iterdir())


def test_a_row_that_is_not_complete_is_incomplete_work(tmp_path: Path, store: Store) -> None:
    shutil.copytree(store.root, tmp_path / "store")
    grown = Store(tmp_path / "store")
    grown.scenes()[0].plan(Request(modifications=4, views_per_modification=2))
    result = CliRunner().invoke(measure_frames, verb(grown, tmp_path, "--row", "2", "--row", "5"))
    assert isinstance(result.exception, IncompleteError)
    assert result.exception.exit_code == 7
    assert "row 5" in str(result.exception)
