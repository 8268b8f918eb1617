"""`photonfarm scene cost`: what samples cost, part by part, and how noisy they are."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from photonfarm.plan.sample_costs import SECONDS, SampleCosts, relative_variance
from photonfarm.renderer.cli.scene_verbs import scene_cost
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.renderer.tools.measure import sample_costs as measuring
from photonfarm.renderer.tools.measure.frame_costs import WARM_UPS
from photonfarm.renderer.tools.measure.sample_costs import (
    fewer_samples,
    line_through,
    measure_costs,
    sample_costs,
    time_work,
)
from photonfarm.scene.modification import Modification, rest
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec, parse_spec
from photonfarm.scene.view import View

SOME = SampleCosts("0" * 32, 0.5, 0.25, 0.125, 0.0625, 0.3)


def static(**view: Any) -> SceneSpec:
    """The static box, looked into from outside, through any of some windows."""
    inside = {"min": [-0.5, 0.5, -0.5], "max": [0.5, 1.5, 0.5]}
    described = {
        "name": "static",
        "scene": {"builtin": "cornell"},
        "view": {"origin": {"min": [-1, 0.5, 3], "max": [1, 1.5, 4]}, "look_at": inside, "fov_deg": 50, **view},
        "film": {"width": 16, "height": 16},
        "points": 64,
        "photons": {"paths": 0},
    }
    return parse_spec(described, where="test")


# -------------------------------------------------------------------------------------------------------------- times


def test_each_part_is_charged_with_its_own_seconds_and_the_medians_count(
    room: LoadedScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, slower, photons = [0.0], [1.0], room.photons(0)
    cloud = room.base()[1]
    halves = np.ones((2, 16, 24, 3), np.float32)
    halves[1] = 3

    def takes(seconds: Callable[..., float], result: Callable[..., Any]) -> Callable[..., Any]:
        def work(*arguments: Any) -> Any:
            clock[0] += slower[0] * seconds(*arguments)
            return result(*arguments)

        return work

    def configured(modification: Modification) -> None:
        slower[0] = {WARM_UPS + 1: 100.0}.get(len(applied), 1.0 if len(applied) >= WARM_UPS else 1e6)
        applied.append(modification)

    applied: list[Modification] = []
    rendered: list[tuple[Any, ...]] = []
    monkeypatch.setattr(room, "base", lambda: (None, cloud))
    monkeypatch.setattr(backend, "work_s", lambda: clock[0])
    monkeypatch.setattr(room, "apply", configured)
    monkeypatch.setattr(room, "photons", takes(lambda _: 100, lambda _: photons))
    monkeypatch.setattr(room, "buffers", takes(lambda _: 10, lambda _: None))
    monkeypatch.setattr(room, "inputs", takes(lambda *_: 15, lambda *_: None))
    monkeypatch.setattr(
        room, "sees", takes(lambda _, points: len(points), lambda _, points: np.ones((1, len(points)), bool))
    )

    def render(view: View, seeds: tuple[int, int], half_spp: int) -> np.ndarray:
        rendered.append((tuple(view.vector), *seeds, half_spp))
        return halves

    monkeypatch.setattr(room, "render_halves", takes(lambda _, __, spp: 7 + 2 * spp * 0.5, render))
    told: list[str] = []
    costs = sample_costs(room, 3, told.append)  # of which one takes a hundred times as long
    assert costs.configuration_s == pytest.approx(100)
    assert costs.view_s == pytest.approx(15 + 4096 + 8192)
    assert costs.guides_s == pytest.approx(15)
    assert costs.pass_s == pytest.approx(7)
    assert costs.spp_s == pytest.approx(0.5)
    assert costs.relative_variance == pytest.approx(2 * 2 * (2**2 / 4) / (2**2 * 1.01))
    assert len({modification.vector.tobytes() for modification in applied}) == len(applied) == WARM_UPS + 3
    assert len({view for view, *_ in rendered}) == WARM_UPS + 3
    assert [spp for *_, spp in rendered] == [2, 8] * (WARM_UPS + 3)
    seeds = [seed for _, one, other, _ in rendered for seed in (one, other)]
    assert len(set(seeds)) == len(seeds)
    assert told == [f"measuring what samples of room cost here, in 3 views after {WARM_UPS} that do not count"]


def test_a_pass_of_more_samples_takes_the_seconds_that_were_predicted() -> None:
    spec = static().model_copy(update={"film": static().film.model_copy(update={"width": 64, "height": 64})})
    scene = LoadedScene.load(spec)
    costs = sample_costs(scene, 5)
    view = View(np.array([0, 1, 3.5], np.float32), np.array([0, 1, 0], np.float32))
    scene.render_halves(view, (1, 2), 16)
    measured_s = min(time_work(lambda: scene.render_halves(view, (3, 4), 16), backend.work_s)[0] for _ in range(3))
    predicted_s = costs.seconds(32, configurations=0, views=0, samples=1)
    assert 0.4 < predicted_s / measured_s < 2.5


@pytest.mark.parametrize(
    ("few_s", "many_s", "fixed_s", "sample_s"),
    [(8.0, 20.0, 4.0, 0.5), (8.0, 44.0, 0.0, 1.5), (8.0, 7.0, 8.0, 0.0)],
)
def test_neither_part_of_a_pass_is_below_zero(few_s: float, many_s: float, fixed_s: float, sample_s: float) -> None:
    assert line_through(8, few_s, 32, many_s) == (fixed_s, sample_s)


@pytest.mark.parametrize(
    ("size", "half_spp", "few"), [(64, 4, 4), (64, 4096, 128), (256, 16, 8), (256, 4, 4), (4096, 4, 1)]
)
def test_clean_images_are_timed_with_fewer_samples(size: int, half_spp: int, few: int, small: Any) -> None:
    assert fewer_samples(small(load_spec("room"), size, size, half_spp)) == few


# -------------------------------------------------------------------------------------------------------------- noise


def test_the_noise_is_the_variance_between_many_images(room: LoadedScene, somewhere: View) -> None:
    room.apply(rest(room.spec))
    halves = room.render_halves(somewhere, range(64)).astype(np.float64)
    pairs = [relative_variance(a, b, 2 * 2) for a, b in zip(halves[::2], halves[1::2], strict=True)]
    variance = 2 * halves.var(axis=0, ddof=1).mean(axis=-1)  # of one sample per pixel
    grey = halves.mean(axis=(0, -1))
    around = np.kron(grey.reshape(2, 8, 3, 8).mean(axis=(1, 3)), np.ones((8, 8)))
    wanted = np.mean(variance / (around**2 + (0.1 * grey.mean()) ** 2))
    assert np.mean(pairs) == pytest.approx(wanted, rel=0.15)


def test_a_static_scene_is_measured_in_different_views() -> None:
    costs = measure_costs(static(), frames=2)
    assert costs.configuration_s < 0.1  # nothing moves, and there are no photons
    assert costs.view_s > 0
    assert costs.view_s > costs.guides_s > 0
    assert 0.01 < costs.relative_variance < 100


def test_views_that_show_nothing_have_no_noise_to_tell_of() -> None:
    away = {"min": [0, 1, 9], "max": [0, 1, 9]}
    scene = LoadedScene.load(static(look_at=away))
    assert sample_costs(scene, 2).relative_variance == 0


# ----------------------------------------------------------------------------------------------------------- the verb


@pytest.fixture
def tiny(tmp_path: Path, small: Callable[..., SceneSpec], monkeypatch: pytest.MonkeyPatch) -> Path:
    """The room on 24 × 16 pixels, and an empty folder for what is kept."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "tiny.json").write_text(small(load_spec("room")).model_dump_json(exclude={"content"}))
    return tmp_path / "tiny.json"


def run(spec: Path | str, *options: str) -> Result:
    return CliRunner().invoke(scene_cost, [str(spec), *options])


def test_the_verb_measures_once_and_answers_from_what_is_kept(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = run(tiny, "--frames", "2", "--json")
    assert first.exit_code == 0, first.output
    costs = SampleCosts.read(first.stdout)
    assert costs.scene_id == load_spec(tiny).scene_id
    said = f"measuring what samples of room cost here, in 2 views after {WARM_UPS} that do not count"
    assert first.stderr.splitlines()[:2] == ["loading room", said]
    monkeypatch.setattr(measuring, "costs_within", lambda _, frames, *__: (SOME, frames))
    monkeypatch.setattr(LoadedScene, "load", lambda *_: None)
    again = run(tiny, "--frames", "2", "--json")
    assert (again.stdout, again.stderr) == (first.stdout, "")
    words = run(tiny, "--frames", "2").stdout
    assert all(f"{name.removesuffix('_s')} {getattr(costs, name):.4f} s" in words for name in SECONDS)
    assert SampleCosts.read(run(tiny, "--frames", "3", "--json").stdout) == SOME
    assert SampleCosts.read(run(tiny, "--frames", "2", "--again", "--json").stdout) == SOME
    assert SampleCosts.read(run(tiny, "--frames", "2", "--json").stdout) == SOME


def test_a_measurement_that_is_kept_but_damaged_is_made_again(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measuring, "costs_within", lambda _, frames, *__: (SOME, frames))
    monkeypatch.setattr(LoadedScene, "load", lambda *_: None)
    run(tiny)
    (file,) = (tiny.parent / "cache/photonfarm/costs").iterdir()
    whole = file.read_text()
    file.write_text(whole[:-9])
    assert "loading" in run(tiny).stderr
    assert file.read_text() == whole


def test_a_folder_that_cannot_be_written_costs_but_a_line(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measuring, "costs_within", lambda _, frames, *__: (SOME, frames))
    monkeypatch.setattr(LoadedScene, "load", lambda *_: None)
    (tiny.parent / "cache").write_text("no folder")
    result = run(tiny, "--json")
    assert SampleCosts.read(result.stdout) == SOME
    assert str(tiny.parent / "cache") in result.stderr
