"""Mistakes of tired users in a folder with nothing in it: each gives one sentence, its exit code, and loses nothing.

`pytest -s` prints what each of them says.
"""

import contextlib
import json
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from refusals import refused, said

HEAD = 'name = "attic"\nscene.builtin = "room"\n'
VIEW = "[view]\norigin = { min = [0, 0, 3], max = [1, 1, 4] }\nlook_at = { min = [0, 0, 0], max = [1, 1, 1] }\n"
TABLE = '[[objects]]\nname = "table"\nshapes = ["TableTop"]\nat = [0, 0, 0]\n'


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
        ("store find --store typo", 4, ["typo: there is no store"]),
        ("top-up room --spp 8 --store typo", 4, ["typo: there is no store"]),
        ("buffers --scene room --orbit 2 --store typo", 4, ["typo: there is no store"]),
        ("train --seconds 0.2 --store typo", 7, ["typo: no scene to train on"]),
        ("status --store s3:/bucket", 2, ["'--store'", "s3://BUCKET"]),
        ("submit room --no-queue --store /proc/store", 4, ["/proc/store: cannot make a store"]),
        ("preview room --out p.png", 2, ["--out: 'p.png'", "preview.html"]),
        ("work --job 3", 2, ["--scene"]),
        ("redis --port 70000", 2, ["'--port'"]),
        ("up room --also guided 9 --also guided 8", 2, ["--also names a network twice"]),
        ("up room --also guided 9 --train-steps 0", 2, ["--train-steps 0 trains none"]),
        ("up room --modifications 1", 3, ["1 configuration is planned", "--modifications 2 plans enough"]),
        ("up room --hold-out 0.1 --modifications 3", 3, ["hold_out = 0.1: of the 3", "--hold-out 0.16", "tions 4"]),
        ("up cornell --modifications 3 --views 2 --hold-out 0.9999", 3, ["6 views planned all"]),
        ("--config none.toml status", 3, ["none.toml"]),
        ("infer --row 0", 4, ["run: there is no such run; `photonfarm train` makes one"]),
        ("infer --run none.photonfarm", 4, ["none.photonfarm: there is no such file; `photonfarm pack` writes one"]),
        ("infer --run none.onnx", 4, ["none.onnx: there is no such file; `photonfarm pack` writes one"]),
        ("pack --out net.onxx", 2, ["--out: 'net.onxx'", ".photonfarm", ".onnx"]),
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
    ("there", "names"),
    [
        ([], ["rooms: is a folder, and holds no scene"]),
        (["a.obj", "b.glb", "c.png"], ["rooms: is a folder; name the scene's file in it: a.obj, b.glb"]),
        (
            ["a.xml", "b.xml", "c.xml", "d.obj", "e.obj"],
            ["name the scene's file in it: a.xml, b.xml, c.xml, d.obj and 1 more"],
        ),
    ],
)
def test_a_folder_in_the_place_of_a_scene(here: Path, there: list[str], names: list[str]) -> None:
    (here / "rooms").mkdir()
    for name in there:
        (here / "rooms" / name).write_text("")
    refused("scene import rooms", 3, *names)
    assert not (here / "rooms.toml").exists()


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


@pytest.mark.parametrize(
    ("settings", "command", "code", "names"),
    [
        ("[train\n", "status", 3, ["photonfarm.toml", "line 1"]),
        ("[trian]\nsteps = 1\n", "status", 3, ["trian"]),
        ("[train]\nstep = 1\n", "status", 3, ["train.step = 1", "steps"]),
        ('[train]\nsteps = "many"\n', "train", 2, ["'--steps'", "'many'"]),
        ("[submit]\nviews = 1.5\n", "submit room", 2, ["'--views'", "1.5 is not a whole number"]),
        ("[train]\nthreads = 0\n", "up room", 2, ["'--threads'"]),
        ('[work]\nreserve = "much"\n', "up room --train-steps 0", 2, ["'--reserve'"]),
    ],
)
def test_in_the_configuration_file(here: Path, settings: str, command: str, code: int, names: list[str]) -> None:
    (here / "photonfarm.toml").write_text(settings)
    refused(command, code, *names)
    assert [file.name for file in here.iterdir()] == ["photonfarm.toml"]


def test_a_number_may_be_written_as_people_write_it(here: Path) -> None:
    code, out, _ = said("submit room --modifications 1e3 --views 1_0 --dry-run --no-measure --json")
    assert (code, json.loads(out)["planned"]) == (0, 10_000)


def test_submit_says_so_if_training_will_refuse_what_it_plans(here: Path) -> None:
    for option in ("--dry-run --no-measure", "--no-queue"):
        code, _, err = said(f"submit room --modifications 3 {option}")
        (line,) = err.splitlines()
        assert (code, line.startswith("warning: `photonfarm train` will refuse this: hold_out = 0.125")) == (0, True)
        assert "--hold-out 0.16 holds out one of these, and --modifications 4 plans enough" in line
    for enough in (4, 2):  # the second time the store has the others
        assert said(f"submit room --modifications {enough} --no-queue")[2] == ""


def test_a_folder_that_is_gone(here: Path) -> None:
    here.rmdir()
    refused("status", 4, "store: there is no store")


@pytest.mark.parametrize("url", ["localhost", "redis://h:port/0", "http://localhost:80", "redis://127.0.0.1:1/0"])
def test_a_wrong_redis(here: Path, url: str) -> None:
    refused(
        f"submit room --redis {url}",
        5,
        "256 samples planned, ",
        f"no Redis at {url}",
        "The plan is stored; `photonfarm work --share 0/1` renders it",
    )
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


@pytest.mark.parametrize(
    ("package", "command", "said"),
    [
        (
            "torch",
            ["up", "room"],
            "the package torch: pip install -c constraints.txt '.[train]' in the checkout; --train",
        ),
        (
            "mitsuba",
            ["up", "room"],
            "`photonfarm work` needs the package mitsuba: pip install -c constraints.txt '.[render]'",
        ),
        ("torch", ["evaluate"], "pip install -c constraints.txt '.[train]'"),
    ],
)
def test_a_verb_that_lacks_a_package_names_the_extra_that_brings_it(
    here: Path, package: str, command: list[str], said: str
) -> None:
    code = f"""
import sys
from photonfarm.cli import farm_verbs, main
sys.modules[{package!r}] = None
farm_verbs.find_spec = lambda name: None if name == {package!r} else name
main.main({command})
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert said in " ".join(done.stderr.replace("│", " ").split())
    assert not (here / "store").exists()


def test_no_llvm_is_exit_code_6_and_says_what_to_install(photonfarm, tmp_path: Path) -> None:
    result = photonfarm("doctor", DRJIT_LIBLLVM_PATH=str(tmp_path / "none.so"))
    assert result.returncode == 6
    assert "libllvm19" in result.stdout + result.stderr
    assert "Traceback" not in result.stderr


def test_whoever_submits_a_spec_with_its_scene_beside_it_is_told_how_workers_find_that(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (here / "mine").mkdir()
    ball = '<shape type="sphere" id="Ball"><emitter type="area"/></shape>'
    (here / "mine/ball.xml").write_text(f'<scene version="3.0.0">{ball}</scene>')
    (here / "mine/ball.toml").write_text('name = "ball"\nscene.file = "ball.xml"\n' + VIEW)
    found = here / "mine"
    warning, told = said("submit mine/ball.toml --no-queue")[2].splitlines()
    assert warning.startswith("warning: mine/ball.toml line 4: cameras may stand inside furniture")
    assert told == f"workers find its scene file with PHOTONFARM_SCENES={found}"
    monkeypatch.setenv("PHOTONFARM_SCENES", str(found))
    assert said("submit mine/ball.toml --no-queue")[2] == f"{warning}\n"
