"""Mistakes of tired users beside a store and a run: each gives one sentence, its exit code, and loses nothing.

`pytest -s` prints what each of them says.
"""

import contextlib
import io
import json
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
from refusals import refused, said

import photonfarm.scene
from photonfarm.cli.main import main
from photonfarm.farm.submission import submit
from photonfarm.plan.request import Request
from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.scene.spec_loading import NamedSpec
from photonfarm.store import Store

NET = """
from torch import nn


class Net(nn.Module):
    def __init__(self, settings, frame):
        super().__init__()
        self.layer = nn.Linear(3, 3)

    def forward(self, inputs):
        return self.layer(inputs.albedo)
"""

TRAIN = "--steps 2 --batch 2 --hold-out 0.4 --set width=2"

Doing = Callable[[Path], object]


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory, analytic: ModuleType) -> Path:
    """A folder with the spec den.toml, a store with its samples, another store, and two trained runs."""
    folder = tmp_path_factory.mktemp("mistakes")
    text = (Path(photonfarm.scene.__file__).parent / "specs/room.toml").read_text()
    text = re.sub(r"(?m)^(width|height) = .*$", r"\1 = 16", re.sub(r"(?m)^points = .*$", "points = 64", text))
    (folder / "den.toml").write_text(text.replace('name = "room"', 'name = "den"'))
    request = Request(modifications=12, views_per_modification=1)
    scene_id = submit(NamedSpec.load(str(folder / "den.toml")), folder / "store", None, request, shard_rows=6).scene_id
    submit(NamedSpec.load("cornell"), folder / "other", None, Request())
    renderer = ShardRenderer(Store(folder / "store"), worker="test", load=analytic.AnalyticScene.load)
    for job in Store(folder / "store").scene(scene_id).missing_jobs():
        renderer.render(scene_id, job)
    (folder / "mine.py").write_text(NET)
    with contextlib.chdir(folder), pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", [*sys.path])
        for run, architecture in (("run", "cnn"), ("own", "mine:Net")):
            assert said(f"train den.toml --run {run} --architecture {architecture} {TRAIN}")[0] == 0
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    """The bytes of all files of the stores there."""
    files = [file for store in ("store", "other") for file in (folder / store).rglob("*") if file.is_file()]
    return {str(file): file.read_bytes() for file in files}


@pytest.fixture
def beside(here: Path, prepared: Path) -> Path:
    """The current folder, with a copy of all that is prepared."""
    shutil.copytree(prepared, here, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__"))
    text = (here / "den.toml").read_text()
    (here / "edited.toml").write_text(text.replace("max_depth = 8", "max_depth = 6"))
    return here


def shard(folder: Path, array: str) -> Path:
    """The first stored shard of an array."""
    return min((folder / "store/scenes").glob(f"*/plans/000000/{array}/c.*"))


def flip(file: Path) -> None:
    """Change one byte of a file."""
    content = bytearray(file.read_bytes())
    content[-5] ^= 255
    file.write_bytes(content)


def cut(file: Path) -> None:
    """Leave the first bytes of a file."""
    file.write_bytes(file.read_bytes()[:100])


def edit(file: Path, **values: object) -> None:
    """Change keys of a JSON document."""
    file.write_text(json.dumps({**json.loads(file.read_text()), **values}))


def in_module(before: str, after: str) -> Doing:
    """What changes a user's own network."""
    return lambda folder: (folder / "mine.py").write_text(NET.replace(before, after))


def path(content: str) -> Doing:
    """What writes a camera path."""
    return lambda folder: (folder / "path.json").write_text(content)


NOTHING: Doing = lambda _: None  # noqa: E731 - a constant of this type
STARES = '{"frames": 1, "views": [{"origin": [0, 1, 0], "look_at": [0, 1, 0]}]}'
OWN = f"--architecture mine:Net {TRAIN}"
FEW = "--steps 2 --batch 2 --hold-out 0.001 --set width=2"
DEPTH = "differs in transport.max_depth (8 in the store, 6 asked for)"


@pytest.mark.parametrize(
    ("doing", "command", "code", "names"),
    [
        (NOTHING, "preview edited.toml", 4, ["holds no samples of edited.toml", DEPTH]),
        (NOTHING, "top-up edited.toml --spp 8 --no-queue", 3, ["edited.toml", DEPTH]),
        (NOTHING, "train edited.toml --seconds 0.2 --run new", 7, ["which store does not hold yet", DEPTH]),
        (NOTHING, "preview cornell", 4, ["no scene has the id or name 'cornell'", "(den)"]),
        (NOTHING, "store find --scene castle", 4, ["'castle'", "(den)"]),
        (NOTHING, "work --scene castle --job 0", 4, ["'castle'", "(den)"]),
        (NOTHING, "work --scene den --job 77", 4, ["there is no job 77"]),
        (NOTHING, "work --until-complete", 5, ["no Redis at"]),
        (NOTHING, "store find den", 2, ["store find [--scene ID] [OPTIONS]"]),
        (NOTHING, "store find --like 12", 3, ["--like '12': a key of 32"]),
        (NOTHING, "store merge --out o --row 99", 4, ["no sample that is planned fits"]),
        (NOTHING, "top-up den.toml --spp many --no-queue", 3, ["spp = 'many'"]),
        (NOTHING, "top-up den.toml --spp +8 --where color=red --no-queue", 3, ["where 'color=red'"]),
        (NOTHING, "submit den.toml --shard-rows 3 --modifications 40 --no-queue", 3, ["shard_rows = 3"]),
        (NOTHING, "submit den.toml --store . --no-queue", 4, [".: is neither empty nor a store"]),
        (NOTHING, "preview den.toml --out den.toml/a.html", 4, ["den.toml/a.html: cannot write the page"]),
        (lambda f: edit(f / "store/photonfarm.json", version=2), "status", 4, ["version 2", "version 5"]),
        (lambda f: (f / "store/photonfarm.json").write_text("{"), "status", 4, ["is not the document of a store"]),
        (lambda f: (f / "store/photonfarm.json").unlink(), "status", 4, ["is missing, and scenes are there"]),
        (lambda f: shard(f, "radiance").unlink(), "preview den.toml", 4, ["/radiance/c.", "store check --repair"]),
        (lambda f: flip(shard(f, "albedo")), "preview den.toml", 4, ["/albedo/c.", "store check --repair"]),
        (lambda f: cut(shard(f, "sample_key")), "status", 4, ["sample_key", "store check --repair"]),
        (NOTHING, "infer --row 0 --store other", 4, ["other: holds no scene", "it holds cornell"]),
        (NOTHING, "infer --modification 0,1,0", 2, ["'--modification'; --place does"]),
        (NOTHING, "infer --without piano", 3, ["'piano' is no movable group of den; its groups: table, "]),
        (NOTHING, "infer --orbit 3 --camera 0,1,0", 2, ["--orbit and --camera exclude each other"]),
        (NOTHING, "infer --run den.toml", 4, ["den.toml: is neither a run's folder nor a whole network"]),
        (NOTHING, "infer --row 999", 4, ["there is no row 999"]),
        (NOTHING, "infer --row 0 --device gpu", 2, ["'--device'", "'gpu' is none of auto"]),
        (NOTHING, "infer --row 0 --out den.toml/x", 4, ["den.toml/x"]),
        (NOTHING, "infer --row 0 --out store", 2, ["--out: store: is a sample store, as it holds photonfarm.json"]),
        (NOTHING, "infer --orbit 2 --out run", 2, ["--out: run: is a training run, as it holds settings.json"]),
        (NOTHING, "render den.toml --spp 2 --out store/a.png", 2, ["--out: store: is a sample store"]),
        (NOTHING, "infer --buffers den.toml", 4, ["den.toml: holds no buffers"]),
        (NOTHING, "infer --camera-path none.json", 2, ["'none.json'"]),
        (NOTHING, "infer --camera-path .", 2, ["'--camera-path'", "is a directory"]),
        (NOTHING, "infer --camera-path den.toml", 3, ["den.toml: is not valid JSON", 'looks like {"frames": 48']),
        (path('{"frames": 2, "views": []}'), "infer --camera-path path.json", 3, ["views = []: 1 or more"]),
        (path(STARES), "infer --camera-path path.json", 3, ["in frame 0 the camera stands where it looks at"]),
        (NOTHING, "evaluate --run store", 4, ["store: is not a training run"]),
        (NOTHING, "evaluate --references none", 4, ["none: there is no such folder"]),
        (NOTHING, "evaluate --kept 4", 2, ["--denoiser"]),
        (NOTHING, "train cornell", 3, ["run: was trained on scene"]),
        (NOTHING, "up den.toml --set width=no --run new", 3, ["training: width = 'no': a whole number"]),
        (NOTHING, "up den.toml --architecture nope --run new", 2, ["'nope' is not one of", "guided_transport"]),
        (NOTHING, f"train den.toml --architecture guided {TRAIN}", 3, ["with architecture = 'cnn'"]),
        (NOTHING, f"train den.toml --run new --architecture cnn {FEW}", 3, ["none is held out", "hold_out = 0.0"]),
        (NOTHING, "train den.toml --run new --set widht=3", 3, ["widht: unknown key; nearest: width"]),
        (NOTHING, "train den.toml --run new --set width=many", 3, ["training: width = 'many': a whole number"]),
        (NOTHING, "train den.toml --run new --loss huber", 3, ["loss = 'huber': is refused"]),
        (NOTHING, "train den.toml --run den.toml", 2, ["'--run'", "is a file", "`infer`, `live`"]),
        (NOTHING, "train den.toml --run new --start-from den.toml", 2, ["'--start-from'", "is a file"]),
        (NOTHING, "train den.toml --run new --set start_from=den.toml", 4, ["den.toml: is a file", "`infer`, `live`"]),
        (NOTHING, "evaluate --run den.toml", 2, ["'--run'", "is a file"]),
        (
            lambda f: cut(f / "run/checkpoint.safetensors"),
            "evaluate",
            4,
            ["run/checkpoint.safetensors", "good.safetensors"],
        ),
        (lambda f: flip(f / "run/checkpoint.safetensors"), "infer --row 0", 4, ["is damaged", "mv "]),
        (lambda f: (f / "run/settings.json").write_text("{"), "report", 4, ["run/settings.json: is not the JSON"]),
        (lambda f: edit(f / "run/settings.json", batch="x"), "evaluate", 4, ["batch = 'x': a whole number"]),
        (in_module("3, 3", "3, 4"), "evaluate --run own", 3, ["own: its weights do not fit", "'mine:Net'"]),
        (in_module("3, 3", "3, 4"), f"train den.toml --run own {OWN}", 3, ["own: its weights do not fit"]),
        (in_module(".albedo", ".albdo"), "evaluate --run own", 3, ["'mine:Net'", "line 11, in forward", "albdo"]),
        (in_module("class Net", "1 / 0\nclass Net"), "evaluate --run own", 3, ["line 5: ZeroDivisionError"]),
        (in_module("class Net", "class Net Net"), "infer --run own --row 0", 3, ["SyntaxError", "mine.py"]),
        (in_module("Net", "Other"), "evaluate --run own", 3, ["has no 'Net'", "Other"]),
        (lambda f: (f / "mine.py").unlink(), "report --run own", 3, ["finds no module 'mine'"]),
    ],
)
def test_beside_a_store_and_a_run(beside: Path, doing: Doing, command: str, code: int, names: list[str]) -> None:
    doing(beside)
    refused(command, code, *names, keeps=contents(beside))


@pytest.mark.parametrize("left", ["initial", "checkpoint"])
def test_up_with_a_run_of_another_scene_plans_nothing(beside: Path, left: str) -> None:
    gone = {"initial": "checkpoint", "checkpoint": "initial"}[left]
    (beside / f"run/{gone}.safetensors").unlink()
    before = sorted(map(str, beside.rglob("*")))
    (den,) = (file.name for file in (beside / "store/scenes").iterdir())
    refused("up cornell", 3, f"--run run: was trained on den (scene {den})", "cornell (scene ", "--run")
    refused("up cornell --store new", 3, f"--run run: was trained on scene {den}, and cornell (scene ")
    assert sorted(map(str, beside.rglob("*"))) == before


def test_two_trainers_in_one_folder(beside: Path) -> None:
    from photonfarm.trainer.runs.run_folder import lock_run

    with lock_run(beside / "run"):
        refused(f"train den.toml --architecture cnn {TRAIN}", 4, "run: another trainer is at work on this run")


def test_a_terminal_that_lacks_letters_gets_others(beside: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, io.TextIOWrapper(io.BytesIO(), encoding="ascii"))
    with pytest.raises(SystemExit) as ended:
        main(["scene", "show", "den.toml"])
    assert not ended.value.code
    sys.stdout.flush()
    assert b"16 ? 16" in sys.stdout.buffer.getvalue()  # type: ignore[attr-defined]


def test_a_preview_takes_a_scene_by_its_spec_its_name_or_its_id(beside: Path) -> None:
    (den,) = (file.name for file in (beside / "store/scenes").iterdir())
    for scene in ("den.toml", "den", den, den[:6]):
        assert said(f"preview {scene} --count 1 --out {scene}.html") == (0, f"{scene}.html\n", "")


def test_links(here: Path, prepared: Path) -> None:
    (here / "nowhere").symlink_to("gone")
    refused("submit room --no-queue --store nowhere", 4, "nowhere: is a link to what is not there")
    (here / "linked").symlink_to(prepared / "store")
    assert said("status --store linked")[0] == 0
