"""Mistakes of tired users: each gives one sentence that names what and what to do, its exit code, and loses nothing.

`pytest -s` prints what each of them says.
"""

import contextlib
import importlib
import io
import json
import os
import re
import resource
import shlex
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

import photonfarm.shared
from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.shared.cli.main import main
from photonfarm.shared.farm.submission import submit
from photonfarm.shared.plan.request import Request
from photonfarm.shared.scene.spec_loading import NamedSpec
from photonfarm.shared.store import Store

MOST_S = 20.0
"""The longest that any of them may take to be told, on a busy machine."""

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

HEAD = 'name = "attic"\nscene.builtin = "room"\n'
VIEW = "[view]\norigin = { min = [0, 0, 3], max = [1, 1, 4] }\nlook_at = { min = [0, 0, 0], max = [1, 1, 1] }\n"
TABLE = '[[objects]]\nname = "table"\nshapes = ["TableTop"]\nat = [0, 0, 0]\n'

Doing = Callable[[Path], object]


def said(command: str) -> tuple[int, str, str]:
    """What a command line ends with, and says on stdout and on stderr; anything but an exit is raised."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), pytest.raises(SystemExit) as ended:
        main(shlex.split(command))
    code = ended.value.code
    assert code is None or isinstance(code, int)
    print(f"$ photonfarm {command}\n{err.getvalue()}{out.getvalue()}[exit code {code or 0}]\n")
    return code or 0, out.getvalue(), err.getvalue()


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory, analytic: ModuleType) -> Path:
    """A folder with the spec den.toml, a store with its samples, another store, and two trained runs."""
    folder = tmp_path_factory.mktemp("mistakes")
    text = (Path(photonfarm.shared.__file__).parent / "scene/specs/room.toml").read_text()
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


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder: an empty one, without a Redis, and with modules of its own."""
    monkeypatch.setenv("PHOTONFARM_REDIS_URL", "redis://127.0.0.1:1/0")
    monkeypatch.delenv("PHOTONFARM_SCENES", raising=False)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    sys.modules.pop("mine", None)
    importlib.invalidate_caches()
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path / "here"


def contents(folder: Path) -> dict[str, bytes]:
    """The bytes of all files of the stores there."""
    files = [file for store in ("store", "other") for file in (folder / store).rglob("*") if file.is_file()]
    return {str(file): file.read_bytes() for file in files}


def refused(command: str, code: int, *names: str, keeps: dict[str, bytes] | None = None) -> None:
    """Assert that a command is refused with this code, in a sentence that names all of it, soon, and takes nothing."""
    began = time.monotonic()
    found, _, err = said(command)
    assert found == code
    assert time.monotonic() - began < MOST_S
    for name in names:
        assert name in " ".join(err.replace("│", " ").split())
    assert "Traceback" not in err
    if code not in (0, 2):  # else click's own sentence, with the usage above
        assert err.splitlines()[-1].startswith("photonfarm: ")
    for file, before in (keeps or {}).items():
        assert Path(file).read_bytes() == before


# ------------------------------------------------------------------------------------- in a folder with nothing in it


@pytest.mark.parametrize(
    ("command", "code", "names"),
    [
        ("trian", 2, ["'train'"]),
        ("check", 2, ["'store check'"]),
        ("scene plna room", 2, ["'plan'"]),
        ("submit room --modifcations 3", 2, ["'--modifications'"]),
        ("--versoin", 2, ["'--version'"]),
        ("submit room --modifications 1.5", 2, ["'--modifications'", "'1.5' is not a whole number"]),
        ("submit room --modifications -3", 2, ["'--modifications'", "-3"]),
        ("submit room --modifications 1e9 --no-queue", 3, ["modifications = 1000000000"]),
        ("submit", 2, ["'SPEC'"]),
        ("train room run", 2, ["(run)"]),
        ("submit castle --no-queue", 3, ["castle: no such spec", "cornell, room"]),
        ("submit castle.toml --no-queue", 3, ["castle.toml: cannot be read: No such file"]),
        ("submit . --no-queue", 3, [".: no such spec, as it is a folder"]),
        ("submit '' --no-queue", 3, ["an empty name"]),
        ("status --store typo", 4, ["typo: there is no store", "photonfarm submit"]),
        ("store check --store typo", 4, ["typo: there is no store"]),
        ("store find --store typo", 4, ["typo: there is no store"]),
        ("store merge --out o --store typo", 4, ["typo: there is no store"]),
        ("store upgrade --store typo", 4, ["typo: there is no store"]),
        ("preview room --store typo", 4, ["typo: there is no store"]),
        ("top-up room --spp 8 --store typo", 4, ["typo: there is no store"]),
        ("buffers --scene room --orbit 2 --store typo", 4, ["typo: there is no store"]),
        ("work --until-complete --store typo", 4, ["typo: there is no store"]),
        ("train --seconds 0.2 --store typo", 7, ["typo: no scene to train on"]),
        ("status --store s3:/bucket", 2, ["'--store'", "s3://BUCKET"]),
        ("submit room --no-queue --store /proc/store", 4, ["/proc/store: cannot make a store"]),
        ("preview room --out p.png", 2, ["--out: 'p.png'", "preview.html"]),
        ("work --job 3", 2, ["--scene"]),
        ("redis --port 70000", 2, ["'--port'"]),
        ("up room --modifications 1", 3, ["1 configuration is planned", "--modifications 2 plans enough"]),
        ("up room --hold-out 0.1 --modifications 20", 3, ["hold_out = 0.1: of the 20", "--hold-out 0.218", "tions 41"]),
        ("--config none.toml status", 3, ["none.toml"]),
        ("infer --row 0", 4, ["run: there is no such folder"]),
    ],
)
def test_in_an_empty_folder(here: Path, command: str, code: int, names: list[str]) -> None:
    refused(command, code, *names)
    assert [file.name for file in here.iterdir()] in ([], ["run"]), (
        "verbs that only read, and refused ones, make no store"
    )


@pytest.mark.parametrize("name", ["room.glb", "scene.xml"])
def test_a_scene_in_the_place_of_a_spec(here: Path, name: str) -> None:
    (here / name).write_bytes(b"glTF\xff")
    refused(f"submit {name} --no-queue", 3, f"{name}: is a scene", f"photonfarm scene import {name}")


@pytest.mark.parametrize(
    ("spec", "names"),
    [
        ('name = "a\n', ["is not valid TOML", "line 1"]),
        (HEAD + VIEW + '[film]\nwidth = "wide"\n', ["film.width = 'wide': a whole number is required"]),
        (HEAD + VIEW + TABLE + "box = { min = [1, 0, 0], max = [0, 0, 0] }\n", ['objects "table".box: is inverted']),
        (HEAD + VIEW + TABLE + "box = 3\n", ['objects "table".box = 3: a table is required']),
        (HEAD.replace("attic", "Küche") + VIEW, ["name: 'Küche' is no name", "'Kuche'"]),
        (HEAD.replace("attic", "my room") + VIEW, ["name: 'my room' is no name", "'my-room'"]),
        (HEAD.partition("\n")[2] + VIEW, ["name: is missing"]),
        (HEAD + "objects = 3\n" + VIEW, ["objects = 3: a list is required"]),
        (HEAD + "exposur = 3\n" + VIEW, ["exposur: unknown key; nearest: exposure"]),
        ('name = "a"\nscene.file = "none.xml"\n' + VIEW, ["scene.file = 'none.xml' is not there", "PHOTONFARM_SCENES"]),
        ('name = "a"\nscene.file = "cut.xml"\n' + VIEW, ["cut.xml: is not a readable Mitsuba scene", "line 1"]),
        ('name = "a"\nscene.file = "bare.xml"\n' + VIEW, ["bare.xml: filename = 'wood.png' is not there"]),
    ],
)
def test_in_a_spec(here: Path, spec: str, names: list[str]) -> None:
    texture = '<texture type="bitmap" name="reflectance"><string name="filename" value="wood.png"/></texture>'
    shape = f'<shape type="sphere" id="Ball"><bsdf type="diffuse">{texture}</bsdf></shape>'
    (here / "bare.xml").write_text(f'<scene version="3.0.0">{shape}</scene>')
    (here / "cut.xml").write_text('<scene version="3.0.0"><shape')
    (here / "my.toml").write_text(spec)
    refused("submit my.toml --no-queue", 3, *names)
    assert not (here / "store").exists()


@pytest.mark.parametrize(("name", "content"), [("photo.toml", bytes(range(256))), ("a.json", b"[1]"), ("b.json", b"{")])
def test_files_that_are_no_specs(here: Path, name: str, content: bytes) -> None:
    (here / name).write_bytes(content)
    refused(f"scene show {name}", 3, name)


@pytest.mark.parametrize(
    ("settings", "command", "code", "names"),
    [
        ("[train\n", "status", 3, ["photonfarm.toml", "line 1"]),
        ("[trian]\nsteps = 1\n", "status", 3, ["trian"]),
        ("[train]\nstep = 1\n", "status", 3, ["train.step = 1", "steps"]),
        ('[train]\nsteps = "many"\n', "train", 2, ["'--steps'", "'many'"]),
        ("[submit]\nviews = 1.5\n", "submit room", 2, ["'--views'", "1.5 is not a whole number"]),
    ],
)
def test_in_the_configuration_file(here: Path, settings: str, command: str, code: int, names: list[str]) -> None:
    (here / "photonfarm.toml").write_text(settings)
    refused(command, code, *names)


def test_a_number_may_be_written_as_people_write_it(here: Path) -> None:
    code, out, _ = said("submit room --modifications 1e3 --views 1_0 --dry-run --no-measure --json")
    assert (code, json.loads(out)["planned"]) == (0, 10_000)


def test_submit_says_so_if_training_will_refuse_what_it_plans(here: Path) -> None:
    for option in ("--dry-run --no-measure", "--no-queue"):
        code, _, err = said(f"submit room --modifications 40 {option}")
        (line,) = err.splitlines()
        assert (code, line.startswith("warning: `photonfarm train` will refuse this: hold_out = 0.125")) == (0, True)
        assert "--hold-out 0.135 holds out one of these, and --modifications 41 plans enough" in line
    for enough in (41, 3):  # the second time the store has the others
        assert said(f"submit room --modifications {enough} --no-queue")[2] == ""


def test_a_full_disk_is_told(here: Path) -> None:
    command = [sys.executable, "-m", "photonfarm.shared.cli", "submit", "room", "--no-queue"]
    full = subprocess.run(
        command, capture_output=True, text=True, check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0)),
    )  # fmt: skip
    assert (full.returncode, full.stderr) == (
        4,
        "photonfarm: store: cannot make a store here: File too large (store)\n",
    )
    assert said("submit room --no-queue")[0] == 0


def test_links(here: Path, prepared: Path) -> None:
    (here / "nowhere").symlink_to("gone")
    refused("submit room --no-queue --store nowhere", 4, "nowhere: is a link to what is not there")
    (here / "linked").symlink_to(prepared / "store")
    assert said("status --store linked")[0] == 0


def test_a_folder_that_is_gone(here: Path) -> None:
    here.rmdir()
    refused("status", 4, "store: there is no store")


@pytest.mark.parametrize("url", ["localhost", "redis://h:port/0", "http://localhost:80", "redis://127.0.0.1:1/0"])
def test_a_wrong_redis(here: Path, url: str) -> None:
    refused(f"submit room --redis {url}", 5, f"no Redis at {url}", "The plan is stored")
    assert json.loads(said("submit room --no-queue --json")[1])["planned_before"] == 256


def test_a_port_that_is_no_redis(here: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            with contextlib.suppress(OSError):
                while True:
                    with server.accept()[0] as client:
                        client.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

        threading.Thread(target=serve, daemon=True).start()
        port = server.getsockname()[1]
        refused(f"submit room --redis redis://127.0.0.1:{port}/0", 5, f"no Redis at redis://127.0.0.1:{port}/0", "HTTP")
        refused(f"redis --port {port}", 5, f"port {port}: cannot be used")
        server.shutdown(socket.SHUT_RDWR)


def test_up_finds_a_place_that_it_cannot_write_before_it_renders(here: Path) -> None:
    (here / "file").write_text("")
    refused("up room --out file", 2, "'--out'")
    refused("up room --run file/run", 4, "file/run: cannot keep the logs of a run here")
    refused("up room --out file/out", 4, "file/out: cannot keep preview and report here")
    assert not (here / "store").exists()


# -------------------------------------------------------------------------------------------- beside a store and a run


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


NOTHING: Doing = lambda _: None  # noqa: E731 - a constant of this type
DEPTH = "differs in transport.max_depth (8 there, 6 here)"


@pytest.mark.parametrize(
    ("doing", "command", "code", "names"),
    [
        (NOTHING, "preview edited.toml", 4, ["holds no samples of edited.toml", DEPTH]),
        (NOTHING, "top-up edited.toml --spp 8 --no-queue", 3, ["edited.toml", DEPTH]),
        (NOTHING, "train edited.toml --seconds 0.2 --run new", 7, ["which store does not hold yet", DEPTH]),
        (NOTHING, "train edited.toml --grid --run new", 3, ["holds no scene edited.toml (it holds den"]),
        (NOTHING, "preview cornell", 4, ["holds no samples of cornell", "it holds den ("]),
        (NOTHING, "store find --scene castle", 4, ["'castle'", "(den)"]),
        (NOTHING, "work --scene castle --job 0", 4, ["'castle'", "(den)"]),
        (NOTHING, "work --scene den --job 77", 4, ["there is no job 77"]),
        (NOTHING, "store find --modification 1,2", 3, ["--modification: has 2 numbers"]),
        (NOTHING, "store find --view 1,x", 3, ["--view '1,x'"]),
        (NOTHING, "store merge --out o --row 99", 4, ["no sample that is planned fits"]),
        (NOTHING, "top-up den.toml --spp many --no-queue", 3, ["spp = 'many'"]),
        (NOTHING, "top-up den.toml --spp +8 --where color=red --no-queue", 3, ["where 'color=red'"]),
        (NOTHING, "submit den.toml --shard-rows 3 --modifications 40 --no-queue", 3, ["shard_rows = 3"]),
        (NOTHING, "submit den.toml --store . --no-queue", 4, [".: is neither empty nor a store"]),
        (NOTHING, "preview den.toml --out den.toml/a.html", 4, ["den.toml/a.html: cannot write the sheet"]),
        (lambda f: edit(f / "store/photonfarm.json", version=2), "status", 4, ["version 2", "version 4"]),
        (lambda f: (f / "store/photonfarm.json").write_text("{"), "status", 4, ["is not the document of a store"]),
        (lambda f: (f / "store/photonfarm.json").unlink(), "status", 4, ["is missing, and scenes are there"]),
        (lambda f: shard(f, "radiance").unlink(), "preview den.toml", 4, ["/radiance/c.", "store check --repair"]),
        (lambda f: shard(f, "depth").unlink(), "preview den.toml", 4, ["/depth/c.", "store check --repair"]),
        (lambda f: flip(shard(f, "albedo")), "preview den.toml", 4, ["/albedo/c.", "store check --repair"]),
        (lambda f: cut(shard(f, "sample_key")), "status", 4, ["sample_key", "store check --repair"]),
        (NOTHING, "infer --row 0 --store other", 4, ["other: holds no scene", "it holds cornell"]),
        (NOTHING, "evaluate --store other", 4, ["other: holds no scene", "it holds cornell"]),
        (NOTHING, "report --store other", 4, ["other: holds no scene", "it holds cornell"]),
        (NOTHING, "infer", 2, ["--row"]),
        (NOTHING, "infer --row 0 --orbit 3", 2, ["exclude each other"]),
        (NOTHING, "infer --row 999", 4, ["there is no row 999"]),
        (NOTHING, "infer --row 0 --device gpu", 3, ["device = 'gpu': must be auto, cpu"]),
        (NOTHING, "infer --row 0 --out den.toml/x", 4, ["den.toml/x"]),
        (NOTHING, "infer --buffers den.toml", 4, ["den.toml: holds no buffers"]),
        (NOTHING, "infer --camera-path none.json", 2, ["'none.json'"]),
        (NOTHING, "evaluate --run store", 4, ["store: is not a training run"]),
        (NOTHING, "evaluate --references none", 4, ["none: there is no such folder"]),
        (NOTHING, "evaluate --kept 4", 2, ["--denoiser"]),
        (NOTHING, "train cornell", 3, ["run: was trained on scene"]),
        (NOTHING, f"train den.toml --architecture guided {TRAIN}", 3, ["network.architecture = 'cnn'"]),
        (NOTHING, "train den.toml --run new --set widht=3", 3, ["widht: unknown key; nearest: width"]),
        (NOTHING, "train den.toml --run new --set width=many", 3, ["network.width = 'many': a whole number"]),
        (NOTHING, "train den.toml --run new --set width", 2, ["'width' is not KEY=VALUE"]),
        (NOTHING, "train den.toml --run new --loss huber", 3, ["loss = 'huber': is refused"]),
        (NOTHING, "train den.toml --run den.toml", 2, ["'--run'"]),
        (lambda f: cut(f / "run/checkpoint.safetensors"), "evaluate", 4, ["run/checkpoint.safetensors", "remove it"]),
        (lambda f: flip(f / "run/checkpoint.safetensors"), "infer --row 0", 4, ["is damaged", "remove it"]),
        (lambda f: (f / "run/settings.json").write_text("{"), "report", 4, ["run/settings.json: is not the JSON"]),
        (lambda f: edit(f / "run/settings.json", batch="x"), "evaluate", 4, ["batch = 'x': a whole number"]),
        (in_module("3, 3", "3, 4"), "evaluate --run own", 3, ["own: its weights do not fit", "'mine:Net'"]),
        (in_module("3, 3", "3, 4"), "infer --run own --row 0", 3, ["own: its weights do not fit", "'mine:Net'"]),
        (in_module(".albedo", ".albdo"), "evaluate --run own", 3, ["'mine:Net'", "line 11, in forward", "albdo"]),
        (in_module(".albedo", ".albdo"), "infer --run own --row 0", 3, ["line 11, in forward", "albdo"]),
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
    from photonfarm.trainer.runs.run_folder import held

    with held(beside / "run"):
        refused(f"train den.toml --architecture cnn {TRAIN}", 4, "run: another trainer is at work on this run")


def test_a_terminal_that_lacks_letters_gets_others(beside: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, io.TextIOWrapper(io.BytesIO(), encoding="ascii"))
    with pytest.raises(SystemExit) as ended:
        main(["scene", "show", "den.toml"])
    assert not ended.value.code
    sys.stdout.flush()
    assert b"16 ? 16" in sys.stdout.buffer.getvalue()  # type: ignore[attr-defined]


def test_a_verb_says_where_the_scene_of_a_run_lies(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from photonfarm.trainer.runs.run_folder import note_scene_folder, with_scenes

    monkeypatch.setenv("PHOTONFARM_SCENES", "/first")
    note_scene_folder(here, here / "scenes")
    assert with_scenes(here)["PHOTONFARM_SCENES"] == f"/first{os.pathsep}{here / 'scenes'}"
