"""`photonfarm scene exposure`: an exposure for pictures of a given brightness."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from photonfarm.core.pictures import display_values
from photonfarm.core.waiting import Steps, WorkLog
from photonfarm.renderer.cli.scene_verbs import scene_exposure
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.renderer.tools.measure import exposure
from photonfarm.renderer.tools.measure.exposure import DarkError, Pictures, propose
from photonfarm.scene.spec import Film, SceneSpec
from photonfarm.scene.spec_loading import load_spec


def pictures(values: np.ndarray, noise: float = 0.0) -> Pictures:
    """Views (N, H, W, 3), each in two halves of that much relative noise."""
    rng = np.random.default_rng(0)
    factors = 1 + noise * rng.standard_normal((len(values), 2, *values.shape[1:]))
    return Pictures((values[:, None] * factors).astype(np.float32))


# ------------------------------------------------------------------------------------------------------- the search


@pytest.mark.parametrize(("radiance", "target"), [(1e-6, 0.1), (3e5, 0.95)])
def test_pictures_of_one_radiance_get_the_exposure_of_the_formula(radiance: float, target: float) -> None:
    """(e · r)^(1/2.2) = t for e = t^2.2 / r."""
    found = pictures(np.full((2, 8, 8, 3), radiance)).find_exposure(target)
    assert found == pytest.approx(target**2.2 / radiance, rel=2e-4)


def test_where_half_of_the_pixels_are_black_half_is_the_most() -> None:
    images = np.zeros((2, 8, 8, 3))
    images[:, :4] = 1
    assert pictures(images).find_exposure(0.49) == pytest.approx(0.98**2.2, rel=2e-4)
    assert pictures(images).find_exposure(0.51) is None


def test_noise_is_taken_out_of_the_display_mean() -> None:
    clean = np.random.default_rng(1).uniform(0.02, 0.6, (4, 64, 64, 3))
    noisy, true = pictures(clean, 0.25), pictures(clean).display_means(1.0)
    before, after = noisy.noisy_means(1.0) - true, noisy.display_means(1.0) - true
    assert before.mean() < -1e-3
    assert np.abs(after.mean()) < 0.2 * np.abs(before.mean())


# ------------------------------------------------------------------------------------------------------ of a scene


def test_the_verb_renders_as_many_views_as_an_import_does() -> None:
    assert {option.name: option.default for option in scene_exposure.params}["frames"] == exposure.FRAMES


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exposure, "PATHS", 1 << 13)


def cornell(**film: int) -> SceneSpec:
    return load_spec("cornell").model_copy(update={"film": Film(**{"width": 32, "height": 32, **film})})


def test_other_images_of_a_scene_have_the_display_mean_that_was_wanted(quick: None) -> None:
    told: list[str] = []
    found = propose(cornell(), None, WorkLog(told.append), target=0.4, frames=16)
    assert told[0] == "rendering 16 views of cornell, 32 × 32, 2 × 8 spp"
    assert found.scene_id == cornell().scene_id
    assert found.low < found.exposure < (found.high or 0)
    scene = LoadedScene.load(exposure.shrink_film(cornell(), exposure.SIDE).model_copy(update={"exposure": 1.0}))
    halves = np.stack(list(exposure._render_pairs(scene, 16, 32, Steps(16))))  # more samples
    assert display_values(np.float32(found.exposure) * halves.mean(axis=1)).mean() == pytest.approx(0.4, abs=0.004)
    again = propose(cornell().model_copy(update={"exposure": 9.0}), None, WorkLog(told.append), target=0.4, frames=16)
    assert again.exposure == found.exposure  # whatever the spec says
    assert (again.present, found.present) == (9.0, 3.0)
    assert again.present_mean > found.present_mean


def test_where_too_much_is_black_it_is_said_how_bright_it_can_get(quick: None) -> None:
    described = cornell()
    away = described.view.model_copy(
        update={"look_at": described.view.look_at.model_copy(update={"min": (0.0, 1.0, 9.0), "max": (0.0, 1.0, 9.0)})}
    )
    with pytest.raises(DarkError, match="stays below 0"):
        propose(described.model_copy(update={"view": away}), None, WorkLog(lambda _: None), frames=2)


def test_what_is_lit_gets_the_target_if_that_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    images = np.zeros((2, 2, 8, 8, 3), np.float32)
    images[:, :, :2] = 0.5  # a quarter
    monkeypatch.setattr(exposure, "_render_pairs", lambda *_: iter(images))
    work = WorkLog(lambda _: None)
    with pytest.raises(DarkError, match=r"stays below 0\.25"):
        propose(cornell(), None, work, frames=2, least=0.3)
    found = propose(cornell(), None, work, frames=2, least=0.2)
    assert found.exposure == pytest.approx(0.45**2.2 / 0.5, rel=1e-3)


@pytest.mark.parametrize(("film", "small"), [((64, 64), (64, 64)), ((1280, 720), (64, 32)), ((2048, 8), (64, 8))])
def test_large_films_are_rendered_small(film: tuple[int, int], small: tuple[int, int]) -> None:
    found = exposure.shrink_film(cornell(width=film[0], height=film[1]), exposure.SIDE).film
    assert (found.width, found.height) == small


# -------------------------------------------------------------------------------------------------------- the verb


@pytest.fixture
def spec_file(tmp_path: Path, small: Callable[..., SceneSpec]) -> Path:
    file = tmp_path / "tiny.json"
    file.write_text(small(load_spec("room"), 16, 16).model_dump_json(exclude={"content"}))
    return file


def run(spec: Path | str, *options: str) -> Result:
    return CliRunner().invoke(scene_exposure, [str(spec), *options])


def test_the_verb_says_an_exposure_and_leaves_the_spec_alone(quick: None, spec_file: Path) -> None:
    before = spec_file.read_bytes()
    told = run(spec_file, "--frames", "3", "--target", "0.3", "--json")
    assert told.exit_code == 0, told.output
    found = json.loads(told.stdout)
    assert found["scene_id"] == load_spec(spec_file).scene_id
    assert (found["target"], found["frames"], found["half_spp"]) == (0.3, 3, 32)
    words = run(spec_file, "--frames", "3", "--target", "0.3").stdout
    assert words.startswith(f"exposure {found['exposure']:.3g} ({found['low']:.3g} … ")
    assert "the spec's 1 gives" in words
    assert spec_file.read_bytes() == before


@pytest.mark.parametrize("options", [["--target", "0"], ["--target", "1"], ["--frames", "1"]])
def test_what_cannot_be_wanted_is_wrong_usage(options: list[str], spec_file: Path) -> None:
    assert run(spec_file, *options).exit_code == 2
