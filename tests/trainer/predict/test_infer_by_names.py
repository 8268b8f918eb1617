"""`photonfarm infer` of what is asked for by names: pictures, layers and figures, with the truth beside them."""

import json
import shutil
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
from click.testing import CliRunner
from PIL import Image
from small_room import rendered, trained

from photonfarm.cli.main import umbrella
from photonfarm.core.formatting import format_share
from photonfarm.core.pictures import GAP
from photonfarm.predict import open_run
from photonfarm.scene.arrangement import Shot
from photonfarm.scene.shot_files import read_configurations
from photonfarm.scene.spec_loading import load_spec
from photonfarm.scene.view import View
from photonfarm.store import SceneReader, Store
from photonfarm.store.read.find import find_start

SHEET = ("prediction.png", "truth.png", "difference.png")
"""The pictures of comparison.png."""


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rendered(load_spec("room"), tmp_path_factory.mktemp("infer"))


def test_the_verb_puts_the_truth_beside_the_network_and_writes_what_it_was(store: Path, tmp_path: Path) -> None:
    run = trained(store, tmp_path / "run", "guided")
    place = ["infer", "--store", str(store), "--run", str(run), "--out", str(tmp_path / "out")]
    asked = ["--row", "1", "--without", "vase", "--camera", "-1.9,1.6,1.7", "--truth", "8"]
    done = CliRunner().invoke(umbrella, [*place, *asked, "--json"], catch_exceptions=False)
    assert done.exit_code == 0
    compared = {"truth.png", "difference.png", "comparison.png"}
    names = compared | {"prediction.png", "frame.exr", "frame.npz", "frame.json"}
    said = json.loads((tmp_path / "out/frame.json").read_text())
    assert {*said["files"]} == names
    assert json.loads(done.stdout) == {**said, "files": [str(tmp_path / "out" / name) for name in said["files"]]}
    (scene_id,) = Store(store).scene_ids()
    spec = SceneReader(store, scene_id).spec
    start, view = find_start(store, scene_id, 1, None) or pytest.fail("row 1 is planned")
    assert "vase" in said["without"]
    assert said["camera"] == [-1.9, 1.6, 1.7]
    np.testing.assert_allclose(said["look_at"], view.target, rtol=1e-6)
    asked_again = Shot.of(place=said["place"], without=said["without"]).apply(spec)
    np.testing.assert_array_equal(asked_again.vector, Shot.of(without=["vase"]).apply(spec, start).vector)
    assert said["interval"][0] < said["squared_error"] < said["interval"][1]
    with np.load(tmp_path / "out/frame.npz") as layers:
        truth = (layers["A"] + layers["B"]) / 2
        np.testing.assert_allclose(layers["truth"], truth, rtol=1e-6)
        np.testing.assert_allclose(layers["difference"], layers["prediction"] - truth, atol=1e-6)
        shown = layers["group"]
    groups = open_run(run, store).find_groups(
        asked_again, View(np.float32(said["camera"]), np.float32(said["look_at"]))
    )
    np.testing.assert_array_equal(shown, groups)
    assert said["groups"] == ["", *(group.name for group in spec.groups)]
    assert said["groups"].index("vase") not in shown
    with OpenEXR.File(str(tmp_path / "out/frame.exr"), separate_channels=True) as image:
        np.testing.assert_array_equal(image.channels()["group.V"].pixels, shown)
    other = tmp_path / "other"
    shutil.copytree(store, other)
    place[2] = str(other)
    (tmp_path / "file").touch()
    nowhere = CliRunner().invoke(umbrella, [*place[:-1], str(tmp_path / "file/out"), *asked])
    assert "cannot write the pictures" in str(nowhere.exception)
    assert "loaded in" not in nowhere.stderr
    assert said["exposure"] == spec.exposure
    sheet, *single = (np.asarray(Image.open(tmp_path / "out" / name)) for name in ("comparison.png", *SHEET))
    height, width = single[0].shape[:2]
    for column, picture in enumerate(single):
        np.testing.assert_array_equal(sheet[-height:][:, column * (width + GAP) :][:, :width], picture)
    removed = f"removed from {tmp_path / 'out'}, as they showed something else: {', '.join(sorted(compared))}"
    for words in ("planned as a sample, row 4", "planned as a sample before, row 4"):
        again = CliRunner().invoke(umbrella, [*place, *asked[:-2], "--store-it"], catch_exceptions=False)
        assert words in again.stdout.splitlines()
        assert f"photonfarm work --store {other} --share 0/1 --until-complete" in again.stderr
        assert (removed in again.stderr.splitlines()) == ("before" not in words)
    assert len(Store(other).scene(scene_id).plans()) == 2
    ((configuration, seen),) = read_configurations(tmp_path / "out/frame.json", spec)
    np.testing.assert_array_equal(configuration.vector, asked_again.vector)
    assert seen is not None
    np.testing.assert_array_equal(seen.vector[:3], np.float32([-1.9, 1.6, 1.7]))
    (mine := tmp_path / "out/path.gif").touch()  # of a name that a call may give, but none has
    for more, left in (
        (["--without", "vase"], names - compared),
        (["--row", "1"], names - {"truth.png"} | {"target.png"}),
    ):
        CliRunner().invoke(umbrella, [*place, *more], catch_exceptions=False)
        assert {file.name for file in (tmp_path / "out").iterdir()} == {mine.name, *left}


def test_the_verb_shows_each_configuration_of_a_file_with_its_truth(store: Path, tmp_path: Path) -> None:
    run, out = trained(store, tmp_path / "run", "cnn"), tmp_path / "out"
    (rooms := tmp_path / "rooms.csv").write_text(
        "sofa.x,sofa.present,camera.x,camera.y,camera.z\n0.9,,-1.9,1.6,1.7\n,0,,,\n"
    )
    place = ["infer", "--store", str(store), "--run", str(run), "--out", str(out), "--configurations", str(rooms)]
    asked = ["--without", "vase", "--camera", "1.9,1.6,1.7", "--fov", "50", "--truth", "4"]
    done = CliRunner().invoke(umbrella, [*place, *asked], catch_exceptions=False)
    assert done.exit_code == 0
    said = [json.loads((out / f"frame-{i:04}/frame.json").read_text()) for i in range(2)]
    for i, each in enumerate(said):
        assert f"own squared error is {format_share(each['truth_error'] / each['mean_square'])} of" in done.stdout
        assert {*map(str, (out / f"frame-{i:04}").iterdir())} <= {*done.stdout.splitlines()}
    assert [each["without"] for each in said] == [["vase"], ["sofa", "vase"]]
    assert [each["place"] for each in said] == [{"sofa": [0.9, 0, 0.3]}, {}]
    assert [each["camera"] for each in said] == [[-1.9, 1.6, 1.7], [1.9, 1.6, 1.7]]
    opened = open_run(run, store, fov=50)
    for number, each in enumerate(said):
        shot = {name: each[name] for name in ("place", "without", "camera", "look_at")}
        with torch.no_grad(), np.load(out / f"frame-{number:04}/frame.npz") as layers:
            np.testing.assert_array_equal(layers["prediction"], opened.predict(**shot).radiance.numpy())
            np.testing.assert_array_equal(layers["truth"], opened.truth(**shot, spp=4).radiance)
    matrix = [[1, 0, 0, 1.9], [0, 1, 0, 1.6], [0, 0, 1, 1.7], [0, 0, 0, 1]]
    (cameras := tmp_path / "transforms.json").write_text(json.dumps({"frames": 2 * [{"transform_matrix": matrix}]}))
    done = CliRunner().invoke(umbrella, [*place, "--cameras", str(cameras), "--json"], catch_exceptions=False)
    assert len(json.loads(done.stdout)) == 1 + 2, "the first has its own camera"
    (own := out / "frame.json").write_text(json.dumps(said[0]))
    CliRunner().invoke(umbrella, [*place[:-1], str(own)], catch_exceptions=False)
    assert {file.name for file in out.iterdir()} == {"frame-0000", own.name}, "what it reads stays"
    rooms.write_text("sofa.x\n0.9\n")
    CliRunner().invoke(umbrella, place, catch_exceptions=False)
    assert {file.name for file in out.iterdir()} == {"frame-0000"}
    assert not (out / "frame-0000/truth.png").exists()
    refused = CliRunner().invoke(umbrella, [*place, "--cameras", str(cameras), "--camera", "0,1,0"])
    assert "--cameras and --camera exclude each other" in refused.stderr
