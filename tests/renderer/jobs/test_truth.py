"""`photonfarm render` of what is asked for by names, and what it warns of."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from photonfarm.cli.main import umbrella
from photonfarm.core.errors import SpecError, StoreError
from photonfarm.core.keys import make_key
from photonfarm.core.statistics import block_z_test
from photonfarm.plan.request import Request
from photonfarm.renderer.jobs import truth
from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.renderer.jobs.truth import Amount, Truth, render_asked, render_truth
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.renderer.scene.surroundings import look_closer
from photonfarm.scene.arrangement import Shot
from photonfarm.scene.spec_loading import load_spec
from photonfarm.scene.view import View
from photonfarm.store import SceneReader, Store


def test_amounts_are_samples_or_seconds_or_an_error() -> None:
    amounts = [Amount(256), Amount(seconds=20), Amount(seconds=0.5), Amount(error=0.02)]
    assert [Amount.parse(text) for text in ("256", "20s", ".5s", "2%")] == amounts
    for text in ("0", "-1", "s", "0s", "0%", "1e3", "20 s", "2m", "inf"):
        with pytest.raises(SpecError, match="samples per pixel"):
            Amount.parse(text)
    for wrong in ({}, {"spp": 2, "error": 0.1}, {"error": float("nan")}, {"error": -1}, {"spp": 0}):
        with pytest.raises(SpecError, match="one of spp, seconds and error"):
            Amount(**wrong)


def test_a_truth_ends_where_its_own_error_is_small_enough_or_its_samples_are_many(
    room: LoadedScene, somewhere: View, monkeypatch: pytest.MonkeyPatch
) -> None:
    room.apply(Shot().apply(room.spec))
    key = make_key("error", room.spec.name)
    good = render_truth(room, key, somewhere, Amount(spp=768))
    fewer = 0
    for error in (0.1, 0.002):
        found = render_truth(room, key + b"other", somewhere, Amount(error=error))
        assert found.own_error() <= error * found.power()
        assert fewer < found.spp < good.spp
        fewer = found.spp
        # what it says of itself is what it is off by
        off = np.mean((found.radiance - good.radiance) ** 2) * room.spec.exposure**2 - good.own_error()
        assert off == pytest.approx(found.own_error(), rel=0.5)
    with pytest.raises(SpecError, match=r"an image of shape \(2, 3\), and the truth has"):
        good.error(np.zeros((2, 3)))
    monkeypatch.setattr(truth, "MOST_SPP", 128)
    assert render_truth(room, key, somewhere, Amount(error=1e-9)).spp == 128
    assert [render_truth(room, key, somewhere, Amount(spp=spp)).spp for spp in (1, 2, 5)] == [4, 4, 6], "two passes"


def test_an_error_is_a_sentence_also_in_the_dark_and_where_noise_hides_it() -> None:
    rng = np.random.default_rng(3)
    passes = np.ones(16, np.int64)
    dark = Truth(np.zeros((16, 2, 4, 4, 3)), passes, 32, 0.0, 2.0)
    grey = np.full((4, 4, 3), 0.1, np.float32)
    said = dark.describe_estimate(dark.error(grey), grey)
    assert said == "squared error 0.04000, 95 % interval 0.04000 … 0.04000: 0.04 on a black image"
    assert dark.describe_error(dark.own_error()) == "0 on a black image"
    noisy = Truth(1 + rng.normal(size=(16, 2, 4, 4, 3)), passes, 32, 0.0, 1.0)
    images = [np.full((4, 4, 3), value, np.float32) for value in (1, 3)]
    near, far = (noisy.describe_estimate(noisy.error(image), image) for image in images)
    assert near.endswith("; not told apart from 0: more samples would")
    assert " % of the image's mean square" in far
    assert "not told" not in far


def test_an_error_beside_a_lamp_is_also_said_without_it() -> None:
    image = np.full((2, 2, 3), 0.25, np.float32)
    image[0, 0] = 50
    truth = Truth(np.tile(image.astype(np.float64), (4, 2, 1, 1, 1)), np.ones(4, np.int64), 8, 0.0, 2.0)
    off = image + np.float32(0.05) * (image < 1)
    assert truth.error_below_white(off) == pytest.approx((0.75, 0.04))
    said = truth.describe_estimate(truth.error(off), off)
    assert said.endswith(": 0.0003 % of the image's mean square, and 4 % below white (75 % of the pixels)")


def test_what_stands_in_a_wall_or_beyond_and_a_camera_inside_of_something_are_said(
    room: LoadedScene, somewhere: View
) -> None:
    def look(view: View = somewhere, **asked: Any) -> list[str]:
        configuration = Shot.of(**asked).apply(room.spec)
        room.apply(configuration)
        return [doubt.partition(":")[0] for doubt in look_closer(room, configuration, view)]

    assert look() == look(place={"sofa": (0.9, 0, -0.5)}, without=["vase"]) == []
    outside, above = "outside the room (all that never moves)", View(np.float32([0, 9, 0]), somewhere.target)
    assert look(move={"lamp": (2, 0, 0)}) == [f"lamp reaches {outside}"]
    assert look(above) == [f"the camera is {outside}"]
    inside = View(np.float32([-2.1, 0.4, -1.35]), somewhere.target)
    assert look(inside) == ["the camera is inside 'pedestal'"]
    assert look(inside, without=["pedestal"]) == []


def test_a_group_in_a_solid_that_never_moves_and_a_camera_between_two_sheets_are_said(
    file_scene: Any, tmp_path: Path
) -> None:
    pillar, ball = (
        f'<shape type="cube" id="{name}"><transform name="to_world"><scale value="{size}"/>'
        f'<translate x="{x}" y="{size}" z="0"/></transform></shape>'
        for name, size, x in (("Pillar", 1, -2), ("Block", 0.25, 2))
    )
    lamp = '<shape type="sphere" id="Lamp"><point name="center" x="0" y="2.5" z="0"/><float name="radius" value="0.1"/>'
    lamp += '<emitter type="area"/></shape>'
    for y in (2.7, 2.8):
        lamp += '<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="3"/>'
        lamp += f'<translate x="0" y="{y}" z="0"/></transform></shape>'
    box = {"min": [-4, 0, -4], "max": [4, 0, 4]}
    block = {"name": "block", "shapes": ["Block"], "at": [2, 0, 0], "box": box}
    scene = file_scene(tmp_path, pillar + ball + lamp, objects=[block])
    view = View(np.float32([0, 1, 3]), np.float32([0, 1, 0]))
    for x, said in ((-2, ["block stands in 'Pillar'"]), (0, [])):
        configuration = Shot.of(place={"block": (x, 0, 0)}).apply(scene.spec)
        scene.apply(configuration)
        assert [doubt.partition(":")[0] for doubt in look_closer(scene, configuration, view)] == said
    between = View(np.float32([0, 2.75, 0]), np.float32([0, 1, 0]))
    assert look_closer(scene, configuration, between)[0].startswith("the camera sees hardly anything")


def test_the_truth_of_a_stored_view_has_the_mean_of_its_passes_and_other_seeds(tmp_path: Path, small: Any) -> None:
    store = Store(tmp_path / "store", create=True)
    spec = small(load_spec("room"))
    scene_id = store.plan(spec, Request(modifications=1, passes=32), shard_rows=32).scene_id
    assert ShardRenderer(store, worker="test", load=LoadedScene.load).render(scene_id, 0)
    reader = SceneReader(store.root, scene_id)
    stored = np.stack([reader.read(int(row)).radiance for row in reader.refresh()]).reshape(64, 16, 24, 3)
    truth = render_asked(store.root, "room", Shot(), 0, None, Amount(spp=128)).truth
    assert (truth.spp, len(truth.parts)) == (128, 16)
    test = block_z_test(truth.parts.reshape(32, 16, 24, 3), stored, blocks=4)
    assert test.passed, test
    assert abs(test.mean_ratio - 1) < 4 * test.mean_ratio_standard_error < 0.1
    brighter = block_z_test(1.15 * truth.parts.reshape(32, 16, 24, 3), stored, blocks=4)
    assert not brighter.passed, "so much would have been found"


def test_an_image_is_rendered_of_a_spec_without_a_store_and_of_a_scene_of_a_store(
    tmp_path: Path, small: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str, code: int = 0) -> Result:
        done = CliRunner().invoke(umbrella, ["render", *arguments, "--json"])
        assert done.exit_code == code, done.output
        return done

    Path("tiny.json").write_text(small(load_spec("room")).model_dump_json(exclude={"content"}))
    asked = ("--without", "sofa", "--place", "vase=0,0,0", "--camera", "1.9,1.6,1.7", "--spp", "8")
    found = run("tiny.json", *asked, "--out", "a.npz")
    said = json.loads(found.stdout)
    assert (said["without"], said["place"], said["spp"]) == (["sofa"], {"vase": [0, 0, 0]}, 8)
    with np.load("a.npz") as image:
        assert image["A"].shape == image["B"].shape == (16, 24, 3)
        assert not np.array_equal(image["A"], image["B"])
        shown = {said["groups"][number] for number in np.unique(image["group"])}
    assert "table" in shown
    assert "sofa" not in shown
    store = Store(tmp_path / "store", create=True)
    store.plan(small(load_spec("room")), Request(modifications=2), shard_rows=2)
    before = sorted(tmp_path.rglob("*"))
    of_row = json.loads(run("room", "--row", "1", "--without", "vase", "--spp", "8", "--out", "b.png").stdout)
    assert "vase" in of_row["without"]
    assert len(of_row["place"]) > 3
    assert {*tmp_path.rglob("*")} - {*before} == {tmp_path / "b.png"}
    assert said["files"] == ["a.npz"]
    for arguments, kind in (
        (("cornel", "--spp", "8"), StoreError),
        (("cornel", "--store", "none"), SpecError),
        (("room", "--like", "0" * 32), StoreError),
        (("room", "--without", "piano"), SpecError),
    ):
        assert isinstance(run(*arguments, code=1).exception, kind)
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    for out, said in (
        ("b.png/c/a.png", "cannot write an image: "),
        ("a.exr", "needs the package OpenEXR; pip install"),
    ):
        refused = run("no-such-spec", "--spp", "8", "--out", out, code=1)  # which would be known next
        assert said in str(refused.exception)
    for wrong in (("--pass", "1"), ("--spp", "soon"), ("--out", "a.jpg")):
        assert wrong[0] in run("room", "--without", "sofa", *wrong, code=2).stderr
