"""`photonfarm infer`: samples of a store and camera paths, as pictures; the renderer's part by the analytic scene."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic_room import analytic_base, analytic_spec, render, visibility
from analytic_room_samples import commit_job, known
from click.testing import CliRunner
from PIL import Image

from photonfarm.cli.main import umbrella
from photonfarm.core.errors import PhotonfarmError, SpecError, StoreError
from photonfarm.core.pictures import display
from photonfarm.core.records import LIT_POINTS, Guides, arrays_of
from photonfarm.plan.hold_out import rows_held_out
from photonfarm.plan.request import Request
from photonfarm.predict import infer, open_run, opened_run
from photonfarm.predict.infer_result import list_made
from photonfarm.scene.camera_path import Frames, orbit
from photonfarm.scene.modification import Modification, rebuild
from photonfarm.scene.view import Camera, View
from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.trainer.networks.inputs import Inputs, map_tensors
from photonfarm.trainer.predictors.onnx_file import list_inputs
from photonfarm.trainer.predictors.trained import TrainedRun
from photonfarm.trainer.training.loop import train


@pytest.fixture
def scene(tmp_path: Path) -> SceneStore:
    """8 configurations of two views, with photons."""
    scene = Store(tmp_path / "store", create=True).add(analytic_spec(16, 256, photons=32))
    scene.write_base(*analytic_base(scene.spec))
    scene.plan(Request(modifications=8, views_per_modification=2), shard_rows=16)
    commit_job(scene, 0)
    return scene


@pytest.fixture
def store(scene: SceneStore) -> Path:
    return scene.folder.parent.parent


@pytest.fixture
def trained(store: Path, scene: SceneStore, tiny, run: Path):
    """Function (architecture) → a run of two steps."""

    def make(architecture: str = "light_transport") -> TrainedRun:
        settings = tiny(max_steps=2, hold_out=0.3, network={"width": 4, "architecture": architecture})
        train(SceneReader(store, scene.scene_id), settings, run)
        return TrainedRun.load(run)

    return make


@pytest.fixture
def frames(scene: SceneStore):
    """Function (configuration, views, photons) → what the renderer would write."""

    def make(modification: Modification, views: list[View], photons=None) -> Frames:
        rendered = [render(scene.spec, modification, view) for view in views]
        buffers = [each for _, each in rendered]
        guides = [arrays_of(known(clean, each, min(LIT_POINTS, scene.spec.points))) for clean, each in rendered]
        stacked = Guides(**{name: np.stack([each[name] for each in guides]) for name in guides[0]})
        images = (np.stack([getattr(b, name) for b in buffers]) for name in ("depth", "albedo", "normal"))
        told = scene.base()[1], modification
        seen = [visibility(scene.spec, *told, view, photons) for view in views]
        flags = (np.stack([getattr(each, name) for each in seen]) for name in ("points", "photons"))
        return Frames(scene.scene_id, modification, tuple(views), *images, *flags, photons, stacked)

    return make


def pixels(file: Path) -> np.ndarray:
    return np.asarray(Image.open(file))


def decoded(file: Path, width: int, height: int) -> np.ndarray:
    """The frames of a film, (F, H, W, 3)."""
    from imageio_ffmpeg import get_ffmpeg_exe

    command = [get_ffmpeg_exe(), "-loglevel", "error", "-i", str(file), *["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]]
    raw = subprocess.run(command, capture_output=True, check=True).stdout
    return np.frombuffer(raw, np.uint8).reshape(-1, height, width, 3)


@pytest.mark.parametrize(("architecture", "steps"), [("light_transport_photons", 1), ("cnn", 1), ("guided", 4)])
def test_a_frame_of_a_path_is_the_image_of_the_stored_sample_of_the_same_view(
    store: Path, scene: SceneStore, trained, frames, tmp_path: Path, architecture: str, steps: int
) -> None:
    """The store's buffers are rounded, so that a grey may differ by a step, and guides more."""
    reader = SceneReader(store, scene.scene_id)
    reader.refresh()
    run, sample = trained(architecture), reader.read(5)
    infer.show_sample(store, run, 5, tmp_path / "sample")
    other = orbit(scene.spec, 3)[1]
    path = frames(sample.modification, [other, sample.view], reader.read_photons(5))
    infer.show_frames(store, run, path, tmp_path / "path")
    shown, wanted = (pixels(tmp_path / name) for name in ("path/frame-0001.png", "sample/prediction.png"))
    assert shown.shape == (256, 256, 3)
    assert np.abs(shown.astype(int) - wanted).max() <= steps
    assert np.abs(pixels(tmp_path / "path/frame-0000.png").astype(int) - wanted).max() > 10


def test_a_sample_is_shown_beside_its_target(store: Path, scene: SceneStore, trained, tmp_path: Path) -> None:
    """An error is told only of what is held out: what was trained on may be known with its noise."""
    run, reader = trained("denoise_4"), SceneReader(store, scene.scene_id)
    source = SceneReader(store, scene.scene_id)
    rows = source.refresh().tolist()
    sides = dict(zip(rows, rows_held_out(source, rows, 0.3), strict=True))
    assert 0 < sum(sides.values()) < len(rows)
    for wanted in (True, False):
        row = next(row for row, held in sides.items() if held is wanted)
        found = infer.show_sample(store, run, row, tmp_path / "out")
        reader.refresh()
        target = display(reader.read(row).radiance.mean(axis=0), scene.spec.exposure)
        shown = pixels(tmp_path / "out/target.png")[::16, ::16].astype(int)
        assert np.abs(shown - target).max() <= 1
        with np.load(tmp_path / "out/frame.npz") as layers:
            np.testing.assert_array_equal([layers["A"], layers["B"]], reader.read(row).radiance)
            linear = display(layers["prediction"], scene.spec.exposure)
        assert np.abs(pixels(tmp_path / "out/prediction.png")[::16, ::16].astype(int) - linear).max() <= 1
        about = json.loads((tmp_path / "out/frame.json").read_text())
        assert ("squared_error" in about, about["held_out"], about["row"]) == (wanted, wanted, row)
        assert {"place", "without", "camera", "look_at", "doubts", "mean_square", "truth_error"} <= {*about}
        assert {"prediction.png", "target.png", "frame.npz", "frame.json"} < {*about["files"]}
        said = f"row {row}: held out; squared error " if wanted else f"row {row}: a training sample, "
        assert found.sentence.startswith(said)


def test_a_file_of_buffers_has_the_inputs_of_an_onnx_network_as_the_page_says(
    store: Path, scene: SceneStore, trained, frames, tmp_path: Path
) -> None:
    run = replace(trained("guided_transport_photons"), exposure=2.0)
    (reader := SceneReader(store, scene.scene_id)).refresh()
    file = tmp_path / "walk.npz"
    frames(reader.read(5).modification, orbit(scene.spec, 2), reader.read_photons(5)).write(file)
    with np.load(file) as archive:
        stored = dict(archive)
    source, light = run.scene(store), ("emission", "direct", "gloss", "point_light")
    position, present = rebuild(source.base()[1], Modification.from_vector(stored["modification"]))
    cameras = [Camera.of(View.from_vector(view), source.spec) for view in stored["view"]]
    made = {"world_to_camera": np.stack([camera.world_to_camera for camera in cameras])}
    for name, values in stored.items():
        if name.startswith("guide_"):
            bare = name.removeprefix("guide_")
            made[bare] = values * source.spec.exposure if bare in light else values
        elif name in ("depth", "albedo", "normal", "point_seen", "photon_seen"):
            made[name] = values
        elif name.startswith("photon_"):
            made[name] = np.stack([values] * 2)
    made |= {"point_position": np.stack([position] * 2), "point_present": np.stack([present] * 2)}
    asked = list_inputs(run, source.spec, 1)
    assert made.keys() == asked.keys()
    for i, batch in enumerate(infer._read_frames(run, Frames.read(file), source)):
        tensors = {name: torch.from_numpy(made[name][i : i + 1]).to(like.dtype) for name, like in asked.items()}
        map_tensors(lambda one, other: torch.testing.assert_close(one, other) or one, Inputs.of(tensors), batch.inputs)


def test_a_row_that_is_not_there_is_told_from_one_that_is_not_complete(
    store: Path, scene: SceneStore, trained, tmp_path: Path
) -> None:
    run = trained()
    scene.plan(Request(modifications=8, views_per_modification=3))
    for row, said, code in ((99, "24 rows", 4), (17, "wait for the workers", 7), (24, "24 rows", 4)):
        with pytest.raises(PhotonfarmError, match=said) as caught:
            infer.show_sample(store, run, row, tmp_path / "out")
        assert caught.value.exit_code == code
    assert not (tmp_path / "out").exists()


def test_a_path_becomes_pictures_an_animation_and_a_film(
    store: Path, scene: SceneStore, trained, frames, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("imageio_ffmpeg", reason="the extra `video` is not installed")
    path = frames(Modification.from_vector(np.tile([0, 0, 0, 1], (2, 1))), orbit(scene.spec, 5))
    found = infer.show_frames(store, trained(), path, tmp_path / "out", fps=10)
    films = {"path.gif", "path.mp4", "frame.json"}
    assert {file.name for file in found.files} == {f"frame-000{i}.png" for i in range(5)} | films
    with Image.open(tmp_path / "out/path.gif") as gif:
        assert (gif.n_frames, gif.info["duration"], gif.info["loop"]) == (5, 100, 0)
    film = decoded(tmp_path / "out/path.mp4", 256, 256)
    assert len(film) == 5
    assert np.abs(film[2].astype(int) - pixels(tmp_path / "out/frame-0002.png")).mean() < 8
    Image.new("RGB", (47, 33), (200, 200, 200)).save(tmp_path / "frame-0000.png")
    infer.write_mp4([tmp_path / "frame-0000.png"], tmp_path / "odd.mp4", 12)
    odd = decoded(tmp_path / "odd.mp4", 48, 34)
    assert np.abs(odd[0, :33, :47].astype(int) - 200).max() <= 16
    with pytest.raises(StoreError, match="ffmpeg"):
        infer.write_mp4([tmp_path / "frame-0000.png"], tmp_path / "odd.unknown", 12)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    without = infer.show_frames(store, TrainedRun.load(tmp_path / "run"), path, tmp_path / "other")
    assert not (tmp_path / "other/path.mp4").exists()
    assert "pip install -c constraints.txt '.[video]'" in without.sentence


def test_files_of_an_earlier_call_are_those_that_it_names_in_its_folder(tmp_path: Path) -> None:
    for folder, about in ((".", {"files": ["prediction.png", "../a.png", "mine.txt"]}), ("frame-0001", [1])):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / "frame.json").write_text(json.dumps(about))
    assert list_made(tmp_path) == {tmp_path / "prediction.png"}


def test_what_cannot_be_shown_is_refused(
    store: Path, scene: SceneStore, trained, frames, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = trained("light_transport_photons")
    path = frames(Modification.from_vector(np.tile([0, 0, 0, 1], (2, 1))), orbit(scene.spec, 2))
    denoiser = replace(
        run,
        settings=run.settings.model_copy(
            update={"network": run.settings.network.model_copy(update={"architecture": "denoise_4"})}
        ),
    )
    refused = [
        ("photons", run, path),
        ("scene other", run, replace(path, scene_id="other")),
        ("denoise_4", denoiser, path),
    ]
    for named, network, buffers in refused:
        with pytest.raises(SpecError, match=named):
            infer.show_frames(store, network, buffers, tmp_path / "out")
    monkeypatch.setattr(opened_run, "can_render", lambda: False)
    with pytest.raises(SpecError, match=r"photonfarm buffers --scene"):
        open_run(run.folder, store)
    monkeypatch.undo()
    for show in (
        lambda: infer.show_sample(tmp_path, run, 7, tmp_path / "out"),
        lambda: infer.show_frames(tmp_path, run, path, tmp_path / "out"),
    ):
        with pytest.raises(StoreError):
            show()
    assert not (tmp_path / "out").exists()


def test_the_verb_shows_a_row_or_a_file_of_buffers(
    store: Path, scene: SceneStore, trained, frames, tmp_path: Path
) -> None:
    run = trained()
    reader = SceneReader(store, scene.scene_id)
    reader.refresh()

    def shown(*arguments: str) -> bytes:
        place = ["infer", "--store", str(store), "--run", str(run.folder), "--out", str(tmp_path / "out"), "--json"]
        result = CliRunner().invoke(umbrella, [*place, *arguments], catch_exceptions=False)
        assert result.exit_code == 0, result.output
        return Path(json.loads(result.stdout)["files"][0]).read_bytes()

    wanted = shown("--row", "7")
    assert shown("--row", "6") != wanted
    frames(reader.read(7).modification, orbit(scene.spec, 2)).write(tmp_path / "buffers.npz")
    assert shown("--buffers", str(tmp_path / "buffers.npz"))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--camera-path", __file__, "--orbit", "3"], "--camera-path and --orbit"),
        (["--buffers", __file__, "--truth", "8"], "--buffers and --truth"),
        (["--truth", "5x"], "'5x': samples per pixel are required"),
        (["--device", "gpu"], "'gpu' is none of auto"),
        (["--run", __file__, "--row", "1"], "is a network on its own"),
        (["--buffers", __file__, "--without", "sofa"], "--buffers and what stands where"),
        (["--orbit", "0"], "'--orbit'"),
        (["--place", "sofa"], "NAME=X,Y,Z"),
        (["--place", "sofa=1,0,0", "--place", "sofa=2,0,0"], "each name once"),
        (["--camera", "1,nan,0"], "3 finite numbers"),
        (["--move", "sofa=1,0"], "3 finite numbers"),
        (["--turn", "sofa=left"], "a finite number is required, as DEGREES"),
        (["--fov", "171"], "'--fov'"),
    ],
)
def test_the_verb_refuses_what_excludes_each_other_and_what_is_no_point(arguments: list[str], said: str) -> None:
    result = CliRunner().invoke(umbrella, ["infer", *arguments])
    assert result.exit_code == 2
    assert said in result.stderr
