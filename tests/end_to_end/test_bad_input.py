"""Every fault that a user can cause gives one sentence on stderr and its exit code, and nothing stored is lost."""

import contextlib
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from photonfarm.cli.main import main
from photonfarm.core.errors import SpecError
from photonfarm.farm.submission import check_hold_out, choose_hold_out, submit
from photonfarm.plan.hold_out import HOLD_OUT, rows_held_out
from photonfarm.plan.request import Request
from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.scene.spec_loading import NamedSpec, load_spec
from photonfarm.store import SceneReader, Store

Ended = subprocess.CompletedProcess[str]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Callable[..., Ended]:
    """The command line in an empty folder, as `photonfarm` is, but in this process: a start costs a second each."""

    def run(*args: str, **environment: str) -> Ended:
        capfd.readouterr()
        with monkeypatch.context() as patch:
            patch.chdir(tmp_path)
            for name, value in {"PHOTONFARM_REDIS_URL": "redis://127.0.0.1:1/0", **environment}.items():
                patch.setenv(name, value)
            with pytest.raises(SystemExit) as ended:  # an error that is not ours comes through
                main([*args])
        code = ended.value.code
        assert code is None or isinstance(code, int)
        return Ended([*args], code or 0, *capfd.readouterr())

    return run


def test_an_unknown_spec_is_exit_code_3(photonfarm) -> None:
    result = photonfarm("scene", "show", "castle")
    assert result.returncode == 3
    assert "castle: " in result.stderr
    assert "Traceback" not in result.stderr


def test_an_inverted_box_is_exit_code_3_and_names_key_value_and_rule(here, tmp_path: Path) -> None:
    (tmp_path / "bad.toml").write_text(
        'name = "bad"\nscene.builtin = "room"\n'
        "[view]\norigin = { min = [0, 2, 0], max = [1, 1, 1] }\nlook_at = { min = [0, 0, 0], max = [1, 1, 1] }\n"
    )
    result = here("submit", "bad.toml", "--no-queue")
    assert result.returncode == 3
    assert "view.origin: is inverted along y: min 2.0 is above max 1.0; min ≤ max is required" in result.stderr
    assert not (tmp_path / "store").exists()


def test_an_unwritable_store_is_exit_code_4(here, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    result = here("submit", "cornell", "--no-queue", "--store", "file/store")
    assert result.returncode == 4
    assert "file/store" in result.stderr
    assert "Traceback" not in result.stderr


def test_a_folder_that_is_no_store_is_exit_code_4_and_left_alone(here, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/diary.txt").write_text("dear diary")
    result = here("submit", "cornell", "--no-queue", "--store", "mine")
    assert result.returncode == 4
    assert [p.name for p in (tmp_path / "mine").iterdir()] == ["diary.txt"]


def test_no_redis_is_exit_code_5_and_the_plan_is_kept(photonfarm, tmp_path: Path) -> None:
    result = photonfarm("submit", "cornell", "--modifications", "1", "--views", "4")
    assert result.returncode == 5
    assert "Redis" in result.stderr
    assert "Traceback" not in result.stderr
    again = photonfarm("submit", "cornell", "--modifications", "1", "--views", "4", "--no-queue", "--json")
    assert again.returncode == 0
    assert '"planned_before": 4' in again.stdout


def test_a_worker_without_redis_is_exit_code_5(here) -> None:
    assert here("submit", "cornell", "--no-queue").returncode == 0
    result = here("work", "--until-complete")
    assert result.returncode == 5
    assert "Traceback" not in result.stderr


def test_no_llvm_is_exit_code_6_and_says_what_to_install(photonfarm, tmp_path: Path) -> None:
    result = photonfarm("doctor", DRJIT_LIBLLVM_PATH=str(tmp_path / "none.so"))
    assert result.returncode == 6
    assert "libllvm19" in result.stdout + result.stderr
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize("verb", [("evaluate",), ("report",), ("infer", "--row", "0")])
def test_a_run_that_is_not_there_is_exit_code_4(here, verb: tuple[str, ...]) -> None:
    result = here(*verb, "--run", "none")
    assert result.returncode == 4
    assert "none: there is no such folder" in result.stderr


def test_training_that_waits_for_a_scene_in_vain_is_exit_code_7(here) -> None:
    result = here("train", "--seconds", "0.3")
    assert result.returncode == 7
    assert "nothing was trained" in result.stderr


def test_wrong_usage_is_exit_code_2(here) -> None:
    assert here("submit", "cornell", "--views", "0").returncode == 2
    assert here("fly").returncode == 2


@pytest.mark.parametrize(
    ("options", "side"),
    [
        (("room", "--modifications", "2", "--hold-out", "0.125"), "2 configurations planned none"),
        (("room", "--modifications", "2", "--hold-out", "0.999"), "2 configurations planned all"),
        (("cornell", "--modifications", "3", "--views", "2", "--hold-out", "0.9999"), "6 views planned all"),
    ],
)
def test_up_refuses_a_hold_out_that_leaves_one_side_empty_before_it_writes_anything(
    here, tmp_path: Path, options: tuple[str, ...], side: str
) -> None:
    result = here("up", *options)
    assert result.returncode == 3
    assert side in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_up_refuses_settings_that_the_trainer_would_refuse_before_it_writes_anything(here, tmp_path: Path) -> None:
    (tmp_path / "photonfarm.toml").write_text("[train]\nthreads = 0\n")
    result = here("up", "room")
    assert result.returncode == 2
    assert "'--threads'" in result.stderr
    assert [file.name for file in tmp_path.iterdir()] == ["photonfarm.toml"]


@pytest.mark.parametrize("options", [(), ("--train-steps", "0")])
def test_up_refuses_settings_that_its_workers_would_refuse_before_it_writes_anything(
    here, tmp_path: Path, options: tuple[str, ...]
) -> None:
    (tmp_path / "photonfarm.toml").write_text('[work]\nreserve = "much"\n')
    result = here("up", "room", *options)
    assert result.returncode == 2
    assert "'--reserve'" in result.stderr
    assert [file.name for file in tmp_path.iterdir()] == ["photonfarm.toml"]


def test_whoever_submits_a_spec_with_its_scene_beside_it_is_told_how_workers_find_that(here, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    ball = '<shape type="sphere" id="Ball"><emitter type="area"/></shape>'
    (tmp_path / "mine/ball.xml").write_text(f'<scene version="3.0.0">{ball}</scene>')
    (tmp_path / "mine/ball.toml").write_text(
        'name = "ball"\nscene.file = "ball.xml"\n'
        "[view]\norigin = { min = [0, 0, 3], max = [1, 1, 4] }\nlook_at = { min = [0, 0, 0], max = [1, 1, 1] }\n"
    )
    found = {"PHOTONFARM_SCENES": str(tmp_path / "mine")}
    told = here("submit", "mine/ball.toml", "--no-queue", PHOTONFARM_SCENES="")
    assert told.stderr == f"workers find its scene file with PHOTONFARM_SCENES={found['PHOTONFARM_SCENES']}\n"
    assert here("submit", "mine/ball.toml", "--no-queue", **found).stderr == ""


def test_up_counts_what_is_planned_already_when_it_checks_the_hold_out(here, tmp_path: Path) -> None:
    """If 64 configurations are planned and some of them are held out, one more may be of either side."""
    assert here("submit", "room", "--modifications", "64", "--no-queue").returncode == 0
    wanted = Request(seed=1)
    check_hold_out(load_spec("room"), tmp_path / "store", 0.125, wanted)
    with pytest.raises(SpecError):
        check_hold_out(load_spec("room"), tmp_path / "none", 0.125, wanted)


@pytest.mark.parametrize("spec", ["room", "cornell"])
@pytest.mark.parametrize("count", range(2, 14))
def test_up_holds_out_enough_of_a_small_plan(tmp_path: Path, spec: str, count: int) -> None:
    loaded, wanted = load_spec(spec), Request(modifications=count)
    share = choose_hold_out(loaded, tmp_path / "none", wanted)
    check_hold_out(loaded, tmp_path / "none", share, wanted)
    with contextlib.suppress(SpecError):
        check_hold_out(loaded, tmp_path / "none", HOLD_OUT, wanted)
        assert share == HOLD_OUT, "the default stays where it does"


def test_numbers_that_a_refused_hold_out_names_are_enough(tmp_path: Path) -> None:
    with pytest.raises(SpecError) as refused:
        check_hold_out(load_spec("room"), tmp_path / "none", HOLD_OUT, Request(modifications=3))
    share, count = re.findall(r"--hold-out (\S+) .* --modifications (\d+)", str(refused.value))[0]
    check_hold_out(load_spec("room"), tmp_path / "none", float(share), Request(modifications=3))
    check_hold_out(load_spec("room"), tmp_path / "none", HOLD_OUT, Request(modifications=int(count)))
    with pytest.raises(SpecError):
        check_hold_out(load_spec("room"), tmp_path / "none", HOLD_OUT, Request(modifications=int(count) - 1))


@pytest.mark.parametrize("spec", ["room", "cornell"])
def test_up_checks_the_hold_out_that_the_trainer_makes(analytic: ModuleType, tmp_path: Path, spec: str) -> None:
    """Configurations of `room`, views of the static `cornell`; three of them, so that one side is empty often."""
    request = Request(modifications=3, passes=2)
    root = tmp_path / "store"
    scene = Store(root, create=True).scene(submit(NamedSpec.load(spec), root, None, request).scene_id)
    renderer = ShardRenderer(Store(root), worker="test", load=analytic.AnalyticScene.load)
    for job in scene.missing_jobs():
        renderer.render(scene.scene_id, job)
    source = SceneReader(root, scene.scene_id)
    rows = source.refresh()
    assert len(rows) == 6
    found = set()
    for share in np.linspace(0.02, 0.998, 49):
        sides = set(rows_held_out(source, rows.tolist(), share))
        for store in (root, tmp_path / "none"):
            if len(sides) == 2:
                check_hold_out(load_spec(spec), store, share, request)
            else:
                with pytest.raises(SpecError, match="all are" if sides == {True} else "none is"):
                    check_hold_out(load_spec(spec), store, share, request)
        found.add(frozenset(sides))
    assert len(found) == 3, "each way of splitting was met"


@pytest.mark.parametrize(
    ("package", "said"),
    [
        (
            "torch",
            "`photonfarm train` needs the package torch: pip install 'photonfarm[train]'; --train-steps 0 renders",
        ),
        ("mitsuba", "`photonfarm work` needs the package mitsuba: pip install 'photonfarm[render]'"),
    ],
)
def test_up_without_a_trainer_or_a_worker_says_so_before_it_writes_anything(
    tmp_path: Path, package: str, said: str
) -> None:
    code = (
        "from photonfarm.cli import farm_verbs, main; "
        f"farm_verbs.find_spec = lambda name: None if name == '{package}' else name; main.main(['up', 'room'])"
    )
    result = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert said in " ".join(result.stderr.replace("│", " ").split())
    assert list(tmp_path.iterdir()) == []


def test_a_verb_that_lacks_a_package_names_the_extra_that_brings_it(tmp_path: Path) -> None:
    code = "import sys; sys.modules['torch'] = None; from photonfarm.cli import main; main.main(['evaluate'])"
    (tmp_path / "run").mkdir()
    result = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (result.returncode, "pip install 'photonfarm[train]'" in result.stderr) == (2, True)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_folder_is_exit_code_4(here, tmp_path: Path) -> None:
    (tmp_path / "locked").mkdir(mode=0o500)
    assert here("submit", "cornell", "--no-queue", "--store", "locked/store").returncode == 4
