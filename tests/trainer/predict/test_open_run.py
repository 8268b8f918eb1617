"""The frame call: a network's image of a configuration and a view, inputs rendered in the same process."""

import pickle
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from small_room import rendered, trained

from photonfarm.cli.main import umbrella
from photonfarm.core.errors import IncompleteError, SpecError
from photonfarm.core.pictures import display, display_values
from photonfarm.core.statistics import block_z_test, clean_error
from photonfarm.farm.devices import Card
from photonfarm.predict import infer, open_run
from photonfarm.predict.flicker import Flicker
from photonfarm.renderer.jobs.truth import Amount
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.scene.groups import Fov, Power, Turn
from photonfarm.scene.modification import rest
from photonfarm.scene.spec import GuideSpec, SceneSpec
from photonfarm.scene.spec_loading import load_spec
from photonfarm.scene.view import View, sample_view
from photonfarm.store import SceneReader, Store

PAGE = Path(__file__).resolve().parents[3] / "docs/what-if.md"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rendered(load_spec("room"), tmp_path_factory.mktemp("predict"))


@pytest.fixture(scope="module")
def zooming(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same where each view has its own field of view."""
    room = load_spec("room")
    view = room.view.model_copy(update={"fov": Fov(min=30, max=110)})
    return rendered(room.model_copy(update={"view": view}), tmp_path_factory.mktemp("zooming"))


@pytest.fixture(scope="module")
def turning(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same where furniture turns, and lamps change power and colour."""
    room = load_spec("room")
    light = {"power": Power(min=0.5, max=2), "colour": ((1.0, 1.0, 1.0), (1.0, 0.5, 0.25))}
    objects = tuple(each.model_copy(update={"turn": Turn(min=-180, max=180)}) for each in room.objects)
    lights = tuple(each.model_copy(update=light) for each in room.lights)
    return rendered(room.model_copy(update={"objects": objects, "lights": lights}), tmp_path_factory.mktemp("turning"))


def spec_of(store: Path) -> SceneSpec:
    (scene_id,) = Store(store).scene_ids()
    return SceneReader(store, scene_id).spec


@pytest.mark.parametrize(
    ("scene", "architecture"),
    [
        ("store", "cnn"),
        ("store", "light_transport_photons"),
        ("store", "guided_transport_photons"),
        ("turning", "light_transport"),
        ("turning", "guided_transport_photons"),
        ("zooming", "light_transport_photons"),
        ("zooming", "guided_transport_photons"),
    ],
)
def test_a_frame_is_the_image_of_the_stored_sample_of_its_configuration_and_view(
    request: pytest.FixtureRequest, tmp_path: Path, scene: str, architecture: str
) -> None:
    """Up to the rounding of the store's types."""
    store: Path = request.getfixturevalue(scene)
    run = trained(store, tmp_path / "run", architecture)
    opened = open_run(run, store)
    reader = SceneReader(store, opened.spec.scene_id)
    reader.refresh()
    sample = reader.read(2)
    with torch.no_grad():
        opened.predict(rest(opened.spec), sample.view)  # the scene comes from another configuration
        image = opened.predict(sample.modification, sample.view).radiance
    assert image.shape == (16, 24, 3)
    infer.show_sample(store, infer.TrainedRun.load(run), 2, tmp_path / "sample")
    wanted = infer.Image.open(tmp_path / "sample/prediction.png").resize((24, 16), infer.Image.Resampling.NEAREST)
    shown = display(image.numpy(), opened.spec.exposure).astype(int)
    off = np.abs(shown - np.asarray(wanted))
    assert np.quantile(off, 0.99) <= 2, "the rest are edges that rays of another rounding hit or miss"
    assert off.mean() < 0.3


OWN = """
import torch
from torch import nn
from photonfarm.trainer.networks.inputs import Needs

class Share(nn.Module):
    needs = Needs(points=True, guides=True)

    def __init__(self, settings, frame):
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(1))

    def forward(self, inputs):
        share = inputs.points.seen.float().mean(dim=1)
        return inputs.albedo * 0 + share[:, None, None, None] + self.bias
"""


def test_a_network_of_one_s_own_is_given_the_points_that_a_view_sees(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside guides, too, with which the built-in ones need no more than which points there are."""
    (tmp_path / "own_share.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    opened = open_run(trained(store, tmp_path / "run", "own_share:Share"), store)
    reader = SceneReader(store, opened.spec.scene_id)
    reader.refresh()
    sample = reader.read(1)
    opened.predict(sample.modification, sample.view)
    seen = opened._inputs(sample.view).points.seen[0].numpy()
    assert np.mean(seen != sample.point_cloud.seen) < 0.005, "up to rays of another rounding"
    assert seen.mean() < 0.9


def test_a_network_runs_where_torch_has_no_card_though_one_renders(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The device is said to be a card; what renders is a processor."""
    run = trained(store, tmp_path / "run", "cnn")
    card = backend.Device(backend.DEFAULT_VARIANT, Card(0, "a card", "9.0", 1 << 34), "")
    monkeypatch.setattr(backend, "device", lambda: card)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    opened = open_run(run, store)
    assert opened._device == torch.device("cpu")
    assert repr(opened) == f"<run cnn (run), scene room ({opened.scene_id}), 24 × 16 pixels, on cpu>"


def test_a_frame_of_a_denoiser_has_a_noisy_image_of_its_own_and_lamps_in_glass_as_the_store_has_them(
    store: Path, tmp_path: Path
) -> None:
    opened = open_run(trained(store, tmp_path / "run", "denoise_4", reflectance=True), store)
    view = sample_view(opened.spec, b"view of a test..", 0, 0)
    with torch.no_grad():
        one, again = (opened.predict(view=view).radiance for _ in range(2))
    torch.testing.assert_close(one, again, rtol=0, atol=0)
    noisy = opened._noisy(view)
    assert int(noisy.kept.sum()) == 24 * 16 // 4
    assert float(noisy.colour.sum()) > 0
    ball, none = View(np.array([-1.6, 1.1, -0.9]), np.array([-2.1, 0.89, -1.35])), np.zeros((1, 3), np.float32)
    stored, without = (
        opened._scene.inputs([ball], [bytes(16)], guides, (none, none + 1))[0][1].emission * opened.spec.exposure
        for guides in (opened.spec.guides, GuideSpec())
    )
    np.testing.assert_allclose(opened._inputs(ball).surface.emission[0], stored, rtol=1e-5)
    assert (stored > without).any()


def test_a_noisy_image_that_is_not_finite_is_drawn_again(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = open_run(trained(store, tmp_path / "run", "denoise_1"), store)
    view, plain, seeds = sample_view(opened.spec, b"view of a test..", 0, 0), LoadedScene.render_halves, []

    def spoil_first(scene: LoadedScene, view: View, asked: Sequence[int], *more: int) -> np.ndarray:
        seeds.extend(asked)
        return plain(scene, view, asked, *more) * (np.nan if len(seeds) == 1 else 1)

    monkeypatch.setattr(LoadedScene, "render_halves", spoil_first)
    colour = opened._noisy(view).colour[0].numpy()
    assert len(set(seeds)) == 2
    np.testing.assert_array_equal(colour, plain(opened._scene, view, seeds[1:])[0] * np.float32(opened.spec.exposure))


def test_a_frame_from_a_noisy_half_goes_from_one_pass_to_several_and_to_two_halves(store: Path, tmp_path: Path) -> None:
    opened = open_run(trained(store, tmp_path / "run", "guided_denoise"), store)
    view, at = sample_view(opened.spec, b"view of a test..", 0, 0), rest(opened.spec)
    with torch.no_grad():
        one, several, both = (
            opened.predict(at, view, **how).radiance for how in ({}, {"passes": 3}, {"passes": 3, "both": True})
        )
    three, others = opened._noisy(view, 3), opened._noisy(view, 3, other=True)
    assert three.variance is not None
    spread = float((three.colour - others.colour).mean(dim=-1).square().mean())
    assert spread == pytest.approx(2 * float(three.variance.mean()), rel=0.5)
    assert not torch.equal(one, several)
    assert not torch.equal(several, both)
    with pytest.raises(SpecError, match="passes = 0"):
        opened.predict(at, view, passes=0)


@pytest.mark.parametrize(("architecture", "how"), [("denoise_4", {"passes": 3}), ("guided", {"both": True})])
def test_halves_that_a_network_is_not_given_are_refused(
    architecture: str, how: dict[str, Any], store: Path, tmp_path: Path
) -> None:
    opened = open_run(trained(store, tmp_path / "run", architecture), store)
    with pytest.raises(SpecError, match=f"{next(iter(how))} = .*: {architecture} is given no"):
        opened.predict(rest(opened.spec), sample_view(opened.spec, b"view of a test..", 0, 0), **how)


def test_a_frame_is_differentiable_and_follows_a_configuration_that_is_changed_in_place(
    store: Path, tmp_path: Path
) -> None:
    opened = open_run(trained(store, tmp_path / "run", "guided_transport"), store)
    view = View(np.array([1.9, 1.6, 1.7], np.float32), np.array([-0.7, 0.6, -0.5], np.float32))
    configuration = rest(opened.spec)
    image = opened.predict(configuration, view).radiance
    image.mean().backward()
    assert all(weights.grad is not None for weights in opened.network.parameters())
    configuration.present[:] = False
    with torch.no_grad():
        empty = opened.predict(configuration, view).radiance
    assert float((empty - image.detach()).abs().mean()) > 0.01


def test_a_film_flickers_and_a_frame_that_is_not_finite_is_refused_with_its_number(store: Path, tmp_path: Path) -> None:
    opened = open_run(trained(store, tmp_path / "run", "cnn"), store)
    view = sample_view(opened.spec, b"view of a test..", 0, 0)
    broken = View(np.full(3, np.nan, np.float32), view.target)
    with pytest.raises(IncompleteError, match="frame-0000 came out non-finite"):
        infer.show_path(opened, rest(opened.spec), [broken, view], tmp_path / "out")
    near = View(view.origin + np.float32(0.02), view.target)
    shown = infer.show_path(opened, rest(opened.spec), [view, near], tmp_path / "out", amount=Amount(spp=32))
    found = re.findall(r"(the network|the truth|OIDN of 16 samples) ([0-9.e-]+)", shown.sentence)
    told = {name: float(value) for name, value in found}
    assert told == pytest.approx({name: value for name, value in shown.about["flicker"].items() if value}, rel=0.01)
    flicker = Flicker(opened.spec)
    for seen in (view, near):
        with torch.no_grad():
            frame = opened.predict(rest(opened.spec), seen)
        a, b = map(display_values, opened.truth(rest(opened.spec), seen, spp=32).halves)  # of exposure 1
        films = {"the network": [display_values(frame.radiance.numpy())], "the truth": [a, b], "half": [a]}
        flicker.add(seen, frame.inputs.depth[0].numpy(), films)
    expected = flicker.result()
    assert expected.pop("the truth") is shown.about["flicker"]["the truth"] is None, "its noise hides it"
    assert "the truth (not told apart from 0: more samples would)" in shown.sentence
    assert 0 < told.pop("OIDN of 16 samples") < 0.95 * expected.pop("half")
    assert told == pytest.approx(expected, rel=0.01)
    away = View(view.origin, 2 * view.origin - view.target)
    shown = infer.show_path(opened, rest(opened.spec), [view, away], tmp_path / "out")
    assert shown.sentence.endswith("flicker: no surface stays in view")


def test_a_frame_is_asked_for_by_names_and_says_what_the_network_never_saw(store: Path, tmp_path: Path) -> None:
    opened = open_run(trained(store, tmp_path / "run", "guided"), store)
    asked = {"place": {"sofa": (0.9, 0, -0.5)}, "without": ["vase"], "camera": (-1.9, 1.6, 1.7), "look_at": (0, 1, 0)}
    configuration = rest(opened.spec)
    groups = [group.name for group in opened.spec.groups]
    configuration.translation[groups.index("sofa")] = np.array([0.9, 0, -0.5]) - np.array([1.85, 0, 0.3])
    configuration.present[groups.index("vase")] = False
    view = View(np.float32([-1.9, 1.6, 1.7]), np.float32([0, 1, 0]))
    with torch.no_grad():
        frame, same = opened.predict(**asked), opened.predict(configuration, view)
        other = opened.predict(**asked | {"place": {"sofa": (0.9, 0, 3)}})
    np.testing.assert_array_equal(frame.configuration.vector, configuration.vector)
    assert torch.equal(frame.radiance, same.radiance)
    assert frame.inputs.depth.shape == (1, 16, 24)
    assert set(frame.seconds) == {"edit", "inputs", "network"}
    assert not frame.doubts
    beyond, closer = other.doubts
    assert beyond.startswith("sofa stands at 0.9,0,3, outside its box")
    assert beyond.endswith(": the network never saw that")
    assert closer == "sofa reaches outside the room (all that never moves)", "which samples may show"
    assert opened.look_closer(**asked | {"place": {"sofa": (0.9, 0, 3)}}) == (closer,)
    assert pickle.loads(pickle.dumps(other)).doubts == other.doubts
    with pytest.raises(SpecError, match="one of spp, seconds and error"):
        opened.truth(**asked)
    for wrong in ({"sofa": (0.9, 0, 3)}, None), (None, (0, 1, 0)):
        with pytest.raises(SpecError, match=r"is no (Modification|View); names"):
            opened.predict(*wrong)  # type: ignore[arg-type]


def test_a_truth_is_unbiased_and_the_error_of_an_image_has_an_interval_that_holds_the_true_one(
    store: Path, tmp_path: Path
) -> None:
    """The true error is that against another truth of many samples, less the noise of that."""
    opened = open_run(trained(store, tmp_path / "run", "cnn"), store)
    asked: dict[str, Any] = {"without": ["table"], "camera": (-1.9, 1.6, 1.7), "look_at": (0.7, 0.6, -0.5)}
    with torch.no_grad():
        image = opened.predict(**asked).radiance.numpy()
    truth, view = opened.truth(**asked, spp=96), View(np.float32(asked["camera"]), np.float32(asked["look_at"]))
    assert (truth.spp, truth.parts.shape) == (96, (16, 2, 16, 24, 3))
    halves = [opened._scene.render_halves(view, (seed, 1000 + seed), 16) for seed in range(12)]
    test = block_z_test(truth.parts.reshape(32, 16, 24, 3), np.concatenate(halves), blocks=4)
    assert test.passed
    a, b = np.mean(halves, axis=0) * opened.spec.exposure
    low, high = truth.error(image).interval or (0, 0)
    assert 0 < low < clean_error(image * np.float32(opened.spec.exposure), a, b) < high < 3 * low
    timed = opened.truth(**asked, seconds=1e-3)
    assert timed.spp == 2 * 2


def test_another_field_of_view_is_that_of_inputs_network_and_sensor(store: Path, tmp_path: Path) -> None:
    run = trained(store, tmp_path / "run", "light_transport")
    wide, usual = open_run(run, store, fov=100), open_run(run, store)
    camera = {"camera": (-1.9, 1.6, 1.7), "look_at": (0.7, 0.6, -0.5)}
    with torch.no_grad():
        frames = [opened.predict(**camera) for opened in (wide, usual)]
    assert float(frames[0].inputs.depth[0, 8, 0]) != pytest.approx(float(frames[1].inputs.depth[0, 8, 0]), rel=0.05)
    assert frames[0].inputs.focal_px.tolist() == [pytest.approx(12 / np.tan(np.radians(50)))]
    assert frames[1].inputs.focal_px is None
    assert [len(frame.doubts) for frame in frames] == [1, 0]
    import mitsuba as mi

    assert float(mi.traverse(wide._scene._sensor.aim(frames[0].view))["x_fov"][0]) == pytest.approx(100)
    with pytest.raises(SpecError, match="fov = 190"):
        open_run(run, store, fov=190)


def test_a_view_is_shown_and_planned_with_the_field_of_view_that_is_asked_for(zooming: Path, tmp_path: Path) -> None:
    run, store = trained(zooming, tmp_path / "run", "light_transport"), tmp_path / "store"
    shutil.copytree(zooming, store)
    opened, (scene_id,) = open_run(run, store), Store(store).scene_ids()
    camera = {"camera": (-1.9, 1.6, 1.7), "look_at": (0.7, 0.6, -0.5)}
    with torch.no_grad():
        near, usual, far, beyond = (opened.predict(**camera, fov=fov) for fov in (40, None, 100, 120))
    assert [frame.view.fov for frame in (near, usual, far)] == [40, opened.spec.view.fov_deg, 100]
    assert near.inputs.focal_px[0] > usual.inputs.focal_px[0] > far.inputs.focal_px[0]
    assert [len(frame.doubts) for frame in (near, usual, far, beyond)] == [0, 0, 0, 1]
    place = ["infer", "--store", str(store), "--run", str(run), "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(umbrella, [*place, "--row", "1", "--fov", "45", "--store-it"], catch_exceptions=False)
    assert "planned as a sample, row 4" in done.stdout.splitlines()
    assert Store(store).scene(scene_id).plans()[-1].rows.view[0, 6] == 45
    found = CliRunner().invoke(
        umbrella, ["store", "find", "--store", str(store), "--fov", "45"], catch_exceptions=False
    )
    assert "--fov 45" in found.stdout


def test_the_lines_of_the_page_make_a_frame_and_its_truth(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (lines,) = [
        block for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL) if "open_run" in block
    ]
    assert len(lines.splitlines()) <= 12
    trained(store, tmp_path / "run", "guided")
    (tmp_path / "store").symlink_to(store)
    monkeypatch.chdir(tmp_path)
    left: dict[str, Any] = {}
    exec(lines.replace("spp=256", "spp=8"), left)
    assert left["frame"].radiance.shape == left["truth"].radiance.shape == (16, 24, 3)
    assert left["error"].mean > 0
