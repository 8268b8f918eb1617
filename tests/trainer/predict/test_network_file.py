"""A network on its own: the file that `pack` writes predicts as its run does, anywhere; and as ONNX."""

import gc
import io
import json
import re
import shlex
import shutil
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import CliRunner, Result
from PIL import Image
from small_room import rendered, trained

from photonfarm.cli.main import umbrella
from photonfarm.core.errors import PhotonfarmError, SpecError, StoreError
from photonfarm.predict import open_run
from photonfarm.predict.opened_run import Frame
from photonfarm.predict.verb import live, pack
from photonfarm.scene.spec_loading import load_spec
from photonfarm.trainer.predictors.half_filter import HalfFilter, uses_denoiser
from photonfarm.trainer.predictors.network_file import ABOUT, WEIGHTS
from photonfarm.trainer.predictors.trained import TrainedRun
from photonfarm.trainer.runs import checkpoint
from photonfarm.trainer.runs.settings import TrainSettings

PAGE = Path(__file__).resolve().parents[3] / "docs/what-if.md"

SCENE = """
<scene version="3.0.0">
  <default name="paint" value="diffuse"/>
  <shape type="obj" id="floor">
    <string name="filename" value="meshes/floor.obj"/>
    <bsdf type="$paint"><texture type="bitmap" name="reflectance">
      <string name="filename" value="textures/tiles.png"/></texture></bsdf>
  </shape>
  <shape type="sphere" id="ball"><point name="center" x="0" y="0.5" z="0"/><float name="radius" value="0.3"/>
    <bsdf type="diffuse"/></shape>
  <emitter type="constant" id="sky"><rgb name="radiance" value="1, 0.8, 0.6"/></emitter>
</scene>
"""
SPEC = """
name = "yard"
[scene]
file = "yard/scene.xml"
[[objects]]
name = "ball"
shapes = ["ball"]
at = [0, 0.5, 0]
box = { min = [-1, 0.5, -1], max = [1, 0.5, 1] }
[view]
origin = { min = [-1, 1, 3], max = [1, 2, 3] }
look_at = { min = [0, 0.3, 0], max = [0, 0.5, 0] }
"""
CORNERS = "v -2 0 -2\nv 2 0 -2\nv 2 0 2\nv -2 0 2\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 3/3 2/2 1/1\nf 4/4 3/3 1/1\n"
ASKED = {"place": {"ball": (0.5, 0.5, 0.25)}, "camera": (0.5, 1.5, 3.2), "look_at": (0, 0.4, 0)}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder of a scene with a mesh and a texture, which is found while the tests of this module run."""
    folder = tmp_path_factory.mktemp("scenes")
    for part in ("meshes", "textures"):
        (folder / "yard" / part).mkdir(parents=True)
    (folder / "yard/scene.xml").write_text(SCENE)
    (folder / "yard/meshes/floor.obj").write_text(CORNERS)
    Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3) * 5).save(folder / "yard/textures/tiles.png")
    (folder / "yard.toml").write_text(SPEC)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PHOTONFARM_SCENES", str(folder))
        yield folder


@pytest.fixture(scope="module")
def store(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rendered(load_spec(scenes / "yard.toml"), tmp_path_factory.mktemp("yard"))


@pytest.fixture(scope="module")
def packed(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network that needs no more than buffers, in a folder of its own."""
    folder = tmp_path_factory.mktemp("packed")
    invoke("--store", store, "--run", trained(store, folder / "run", "cnn"), "--out", folder / "yard.photonfarm")
    return folder / "yard.photonfarm"


def invoke(*args: object) -> Result:
    return CliRunner().invoke(pack, list(map(str, args)), catch_exceptions=False)


def take(run: Path, store: Path | str = "nowhere", asked: dict[str, Any] = ASKED, passes: int = 1) -> tuple[Any, ...]:
    opened = open_run(run, store)
    with torch.no_grad():
        frame = opened.predict(**asked, passes=passes)
    return frame.radiance.numpy(), opened.truth(**asked, spp=2).halves, frame.doubts


@pytest.mark.parametrize(
    "architecture",
    [
        "guided_transport",
        pytest.param("guided_denoise", marks=pytest.mark.slow),
        pytest.param("light_transport_photons", marks=pytest.mark.slow),
    ],
)
def test_a_network_on_its_own_predicts_bit_for_bit_what_its_run_does_and_renders_the_truth(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, architecture: str
) -> None:
    """The store, the run and the scene's files are not there; and it leaves no trace."""
    run, passes = trained(store, tmp_path / "run", architecture), 2 if architecture == "guided_denoise" else 1
    image, truth, doubts = take(run, store, passes=passes)
    invoke("--store", store, "--run", run, "--out", tmp_path / "elsewhere/yard.photonfarm")
    (unpacked := tmp_path / "unpacked").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(unpacked))
    monkeypatch.delenv("PHOTONFARM_SCENES")
    monkeypatch.chdir(tmp_path / "elsewhere")
    alone, its_truth, its_doubts = take(Path("yard.photonfarm"), passes=passes)
    assert np.array_equal(alone, image)
    assert np.array_equal(its_truth, truth)
    assert its_doubts == doubts
    loaded = TrainedRun.load(Path("yard.photonfarm"))
    assert loaded.trained["step"] == 1
    assert loaded.trained["store"]["plans"][0]["samples"] == 4
    assert any(unpacked.rglob("floor.obj"))
    del loaded
    gc.collect()
    assert not any(unpacked.iterdir())


def test_what_needs_a_store_is_refused_and_the_page_s_command_makes_such_a_file(
    store: Path, packed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (line,) = re.findall(r"^ +photonfarm (pack .*photonfarm)\b", PAGE.read_text(), re.MULTILINE)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "store").symlink_to(store)
    shutil.copytree(packed.parent / "run", "run")
    made = invoke(*shlex.split(line)[1:])
    assert made.exit_code == 0
    assert Path("room.photonfarm").stat().st_size == packed.stat().st_size
    Path("store").unlink()
    run = CliRunner().invoke
    for option in (["--row", "1"], ["--like", "aa"], ["--store-it"], ["--store", str(store)]):
        refused = run(umbrella, ["infer", "--run", "room.photonfarm", *option])
        assert refused.exit_code == 2
        assert option[0] in refused.output
        assert "is a network on its own, and knows no store" in " ".join(refused.output.split())
    assert run(live, ["--run", "room.photonfarm", "--may-submit"]).exit_code == 2
    shown = run(umbrella, ["infer", "--run", "room.photonfarm", "--place", "ball=1,0.5,0", "--orbit", "2"])
    assert shown.exit_code == 0, shown.output
    assert Path("shown/path.gif").exists()
    with pytest.raises(SpecError, match="copy it"):
        invoke("--run", "room.photonfarm", "--out", "again.photonfarm")


def rewrite(file: Path, to: Path, change: Callable[[dict[str, bytes]], None], **how: Any) -> Path:
    """A copy of a file with other members."""
    with zipfile.ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    with zipfile.ZipFile(to, "w", **how) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return to


def describe(**changes: Any) -> Callable[[dict[str, bytes]], None]:
    def change(members: dict[str, bytes]) -> None:
        members[ABOUT] = json.dumps({**json.loads(members[ABOUT]), **changes}).encode()

    return change


def name_scene(content: str) -> Callable[[dict[str, bytes]], None]:
    """Another scene in the place of its own."""
    scene = f'<scene version="3.0.0">{content}</scene>'
    return lambda members: members.update({"scene/scene.xml": scene.encode()})


def edit_base(name: str, edit: Callable[[np.ndarray], np.ndarray]) -> Callable[[dict[str, bytes]], None]:
    """Another array in the place of one of the base."""

    def change(members: dict[str, bytes]) -> None:
        arrays = dict(np.load(io.BytesIO(members["base.npz"])))
        np.savez(made := io.BytesIO(), **{**arrays, name: edit(arrays[name])})
        members["base.npz"] = made.getvalue()

    return change


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        (edit_base("cloud.position", lambda array: array[:5]), StoreError),
        (edit_base("cloud.normal", lambda array: array[:, 0]), StoreError),
        (edit_base("cloud.albedo", lambda array: array.astype("U8")), StoreError),
        (edit_base("cloud.group", lambda array: array + 9), StoreError),
        (edit_base("geometry.faces", lambda array: array + 9), StoreError),
        (lambda members: members.update({"scene/../../stolen.obj": b""}), StoreError),
        (lambda members: members.update({"/tmp/stolen.obj": b""}), StoreError),
        (lambda members: members.update({"scene/plugins/evil.so": b""}), StoreError),
        (lambda members: members.update({WEIGHTS: members[WEIGHTS][:-8]}), StoreError),
        (lambda members: members.pop(WEIGHTS), StoreError),
        (lambda members: members.update({"base.npz": b"no archive"}), StoreError),
        (lambda members: members.update({ABOUT: b"{"}), StoreError),
        (lambda members: members.update({ABOUT: b"[]"}), StoreError),
        (describe(format=2), StoreError),
        (describe(spec={}), StoreError),
        (name_scene('<bsdf type="../evil"/>'), SpecError),
        (name_scene('<default name="a" value="/evil"/><bsdf type="$a"/>'), SpecError),
        (name_scene('<string name="filename" value="/etc/x.obj"/>'), SpecError),
        (name_scene('<default name="a" value="/evil"/><default name="a" value="b"/><bsdf type="$a"/>'), SpecError),
        (name_scene('<default name="k" value="a"/><default name="$k" value="/evil"/><bsdf type="$a"/>'), SpecError),
        (name_scene('<default name="a" value="filename"/><string name="$a" value="/etc/x.obj"/>'), SpecError),
        (name_scene('<spectrum name="a" filename="/etc/x.spd"/>'), SpecError),
        (name_scene('<path value="/etc"/><string name="filename" value="x.obj"/>'), SpecError),
        (name_scene('<string name="filename" value="evil.so"/>'), SpecError),
        (name_scene("<no XML"), StoreError),
    ],
)
def test_a_file_that_pack_did_not_write_is_refused_by_its_name(
    packed: Path, tmp_path: Path, change: Callable[[dict[str, bytes]], None], kind: type[PhotonfarmError]
) -> None:
    made = rewrite(packed, tmp_path / "made.photonfarm", change)
    with pytest.raises(kind, match="made"):
        TrainedRun.load(made)
    assert [file.name for file in tmp_path.iterdir()] == ["made.photonfarm"]


def test_a_file_that_is_cut_short_or_would_grow_is_refused(packed: Path, tmp_path: Path) -> None:
    bomb = rewrite(packed, tmp_path / "bomb.photonfarm", describe(more=" " * 10**6), compression=zipfile.ZIP_DEFLATED)
    (short := tmp_path / "short.photonfarm").write_bytes(packed.read_bytes()[:-100])
    (base := tmp_path / "base.npz").write_bytes(zipfile.ZipFile(packed).read("base.npz"))
    np.lib.format.write_array_header_1_0(
        header := io.BytesIO(), {"descr": "<f4", "fortran_order": False, "shape": (10**13,)}
    )
    deflated = rewrite(base, tmp_path / "deflated", lambda _: None, compression=zipfile.ZIP_DEFLATED).read_bytes()
    vast = rewrite(base, tmp_path / "vast", lambda arrays: arrays.update({"cloud.face.npy": header.getvalue()}))
    made = [
        rewrite(packed, tmp_path / "deflated.photonfarm", lambda members: members.update({"base.npz": deflated})),
        rewrite(packed, tmp_path / "vast.photonfarm", lambda members: members.update({"base.npz": vast.read_bytes()})),
    ]
    for file in (bomb, short, *made):
        refused = CliRunner().invoke(umbrella, ["infer", "--run", str(file)])
        assert isinstance(refused.exception, SystemExit | StoreError)
        with pytest.raises(StoreError, match=file.name):
            TrainedRun.load(file)


def test_code_of_one_s_own_is_neither_packed_nor_imported(
    store: Path, packed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def name_module(members: dict[str, bytes]) -> None:
        (whole := tmp_path / WEIGHTS).write_bytes(members[WEIGHTS])
        state = checkpoint.load(whole)
        state["settings"]["network"]["architecture"] = "marking:Network"
        checkpoint.save(whole, state)
        members[WEIGHTS] = whole.read_bytes()

    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "marking.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    with pytest.raises(StoreError, match="code"):
        TrainedRun.load(rewrite(packed, tmp_path / "made.photonfarm", name_module))
    assert not (tmp_path / "ran").exists()
    own = Path(__file__).parent / "test_open_run.py"  # which has one
    (tmp_path / "own_share.py").write_text(re.findall(r'OWN = """\n(.*?)"""', own.read_text(), re.DOTALL)[0])
    with pytest.raises(SpecError, match="own_share:Share"):
        invoke(
            "--store",
            store,
            "--run",
            trained(store, tmp_path / "run", "own_share:Share"),
            "--out",
            tmp_path / "it.photonfarm",
        )


# ------------------------------------------------------------------------------------------------------------- as ONNX


def name_inputs(frame: Frame, settings: TrainSettings) -> dict[str, np.ndarray]:
    """What a frame's network was given, by the names of a torch dataset."""
    inputs = HalfFilter(settings)(frame.inputs) if uses_denoiser(settings) else frame.inputs
    named = {}
    for kind, prefix in (("points", "point_"), ("photons", "photon_"), ("guides", ""), ("noisy", "noisy_")):
        record = getattr(inputs, kind)
        for field in fields(record) if record is not None else ():
            if (value := getattr(record, field.name)) is not None:
                named[prefix + field.name] = value.numpy()
    own = {name: getattr(inputs, name).numpy() for name in ("world_to_camera", "depth", "albedo", "normal")}
    return own | named


@pytest.mark.slow
@pytest.mark.parametrize(
    ("architecture", "passes"),
    [
        ("cnn", 1),
        ("feature_projection", 1),
        ("light_transport_photons", 1),
        ("denoise_4", 1),
        ("guided", 1),
        ("guided_transport_photons", 1),
        ("guided_denoise", 4),
    ],
)
def test_the_onnx_makes_the_network_s_image_of_named_inputs_whatever_the_batch(
    store: Path, tmp_path: Path, architecture: str, passes: int
) -> None:
    """The two agree to a hundred-thousandth of the brightest value, as they add in another order."""
    onnxruntime = pytest.importorskip("onnxruntime")
    run = trained(store, tmp_path / "run", architecture)
    assert invoke("--store", store, "--run", run, "--out", tmp_path / "it.onnx").exit_code == 0
    session = onnxruntime.InferenceSession(tmp_path / "it.onnx")
    opened = open_run(run, store)
    with torch.no_grad():
        frames = [opened.predict(**asked, passes=passes) for asked in (ASKED, {"camera": (0, 1.2, 3)})]
    about = json.loads(session.get_modelmeta().custom_metadata_map["photonfarm"])
    assert (about["architecture"], about["scene"]) == (architecture, opened.scene_id)
    given = [name_inputs(frame, TrainedRun.load(run).settings) for frame in frames]
    asked = {each.name: each.shape for each in session.get_inputs()}
    assert all(shape[0] == "batch" for shape in asked.values())
    images = np.stack([frame.radiance.numpy() for frame in frames]) * about["exposure"]
    for count in (1, 2):
        batch = {name: np.concatenate([each[name] for each in given[:count]]) for name in asked}
        (made,) = session.run(["radiance"], batch)
        assert np.abs(made - images[:count]).max() <= 1e-5 * np.abs(images).max()
