"""The scripts for SLURM, as text and as bash runs them; tests/end_to_end/test_slurm.py submits them."""

import os
import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from photonfarm.cli.main import umbrella
from photonfarm.core.errors import SchedulerError, SpecError, StoreError
from photonfarm.farm.slurm import check_slurm

Launcher = Callable[..., Result]


@pytest.fixture
def slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Launcher:
    """Runs `photonfarm slurm` in an empty folder."""
    monkeypatch.chdir(tmp_path)
    for name in ("PHOTONFARM_REDIS_URL", "PHOTONFARM_REDIS_PASSWORD_FILE", "PHOTONFARM_CONFIG"):
        monkeypatch.delenv(name, raising=False)
    return lambda *arguments: CliRunner().invoke(umbrella, ["slurm", *arguments], prog_name="photonfarm")


def directives(script: str) -> list[str]:
    return re.findall(r"^#SBATCH (.*)$", script, re.MULTILINE)


def test_a_dry_run_prints_an_array_of_shares_and_writes_nothing(slurm: Launcher, tmp_path: Path) -> None:
    done = slurm("cornell", "room", "--workers", "6", "--partition", "low", "--time", "10", "--dry-run")
    assert done.exit_code == 0, done.output
    asked = directives(done.stdout)
    assert {"--array=0-5", "--requeue", "--signal=B:TERM@60", "--partition=low", "--time=10"} <= set(asked)
    assert f"--output={tmp_path}/slurm/worker-%A_%a.log" in asked
    assert not [option for option in asked if option.startswith("--gres")]
    assert '--share "$SLURM_ARRAY_TASK_ID/6" cornell room &' in done.stdout
    assert f"export PHOTONFARM_STORE={tmp_path}/store" in done.stdout
    for spec, comment in zip(("cornell", "room"), done.stdout.splitlines()[1:], strict=False):
        assert re.fullmatch(rf"# {spec}: 256 samples, .* at most [0-9.]+ MB .* about .* on 6 workers, .*", comment)
    assert list(tmp_path.iterdir()) == []
    assert subprocess.run(["bash", "-n"], input=done.stdout, text=True, check=False).returncode == 0


def test_with_redis_workers_take_their_jobs_from_it_and_no_script_holds_its_password(
    slurm: Launcher, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = slurm("cornell", "--redis", "redis://farm/1", "--dry-run")
    assert "export PHOTONFARM_REDIS_URL=redis://farm/1\n" in done.stdout
    assert "--share" not in done.stdout
    assert "--share" in slurm("cornell", "--redis", "redis://farm/1", "--no-queue", "--dry-run").stdout
    assert slurm("cornell", "--redis", "redis://:hunter2@farm/1", "--dry-run").exit_code == 2
    monkeypatch.setenv("PHOTONFARM_REDIS_URL", "redis://:hunter2@farm/1")
    done = slurm("cornell", "--dry-run")
    assert done.exit_code == 0
    assert "--share" not in done.stdout
    assert "hunter2" not in done.stdout


def test_gpus_are_asked_for_where_they_are_used(slurm: Launcher) -> None:
    workers, trainer = slurm("cornell", "--gpus", "--train", "--dry-run").stdout.split("#!/usr/bin/env bash\n")[1:]
    assert "--gres=gpu:1" in directives(workers)
    assert "export PHOTONFARM_DEVICE=cuda\n" in workers
    assert "--gres=gpu:1" not in directives(trainer)
    *_, trainer = slurm("cornell", "--train", "--train-gpus", "--dry-run").stdout.split("#!/usr/bin/env bash\n")
    assert "--gres=gpu:1" in directives(trainer)
    assert "PHOTONFARM_DEVICE" not in trainer


@pytest.mark.parametrize(("given", "seen"), [(None, ""), ("2,3", "2,3")])
def test_cards_of_a_node_that_slurm_has_not_given_to_a_task_are_hidden_from_it(
    slurm: Launcher, given: str | None, seen: str
) -> None:
    """Workers take any card that they see, and so does torch."""
    for script in slurm("cornell", "--train", "--dry-run").stdout.split("#!/usr/bin/env bash\n")[1:]:
        (line,) = re.findall(r"(?m)^export CUDA_VISIBLE_DEVICES=.*$", script)
        here = {"PATH": os.environ["PATH"], **({} if given is None else {"CUDA_VISIBLE_DEVICES": given})}
        command = f'{line}\necho "<$CUDA_VISIBLE_DEVICES>"'
        said = subprocess.run(["bash", "-c", command], env=here, capture_output=True, text=True, check=True).stdout
        assert said == f"<{seen}>\n"
    scripts = slurm("cornell", "--gpus", "--train", "--train-gpus", "--dry-run").stdout
    assert "CUDA_VISIBLE_DEVICES" not in scripts


def test_the_trainer_has_options_of_its_own_which_come_last(slurm: Launcher, tmp_path: Path) -> None:
    asked = ("--train", "--train-steps", "20", "--sbatch=--account=lab", "--train-sbatch=--partition=big one")
    workers, trainer = slurm("cornell", *asked, "--partition", "low", "--dry-run").stdout.split("#!/usr/bin")[1:]
    assert directives(workers)[-1] == "--account=lab"
    assert directives(trainer)[-2:] == ["--account=lab", "--partition='big one'"]
    assert f"train cornell --run {tmp_path}/run --steps 20 &" in trainer
    assert slurm("cornell", "room", "--train", "--dry-run").exit_code == 2


@pytest.mark.parametrize("option", ["account=lab", "--comment=a\nb", ""])
def test_what_is_no_option_of_sbatch_is_refused(slurm: Launcher, option: str) -> None:
    done = slurm("cornell", f"--sbatch={option}", "--dry-run")
    assert isinstance(done.exception, SpecError)


def test_without_sbatch_nothing_is_written(slurm: Launcher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert isinstance(slurm("cornell").exception, SchedulerError)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(SchedulerError, match="sbatch is not here: photonfarm slurm runs where SLURM's commands are"):
        check_slurm()


def test_a_script_ends_with_the_exit_code_of_its_worker(slurm: Launcher, tmp_path: Path) -> None:
    """As there is no store, the worker ends at once."""
    (tmp_path / "worker.sh").write_text(slurm("cornell", "--dry-run").stdout)
    here = os.environ | {"SLURM_ARRAY_JOB_ID": "1", "SLURM_ARRAY_TASK_ID": "2"}
    done = subprocess.run(["bash", tmp_path / "worker.sh"], env=here, capture_output=True, text=True, check=False)
    assert done.returncode == StoreError.exit_code
    assert "there is no store" in done.stderr


@pytest.mark.parametrize("is_array", [True, False], ids=["array", "trainer"])
def test_near_its_limit_a_task_asks_for_itself_alone_and_puts_itself_alone_back(
    slurm: Launcher, tmp_path: Path, is_array: bool
) -> None:
    """One task of an array has the array's id as its job id, which means all tasks to SLURM's commands.

    SLURM's two commands are stood in for, as bash functions that say what they were asked; test_slurm.py has the real
    ones.
    """
    workers, trainer = slurm("cornell", "--train", "--dry-run").stdout.split("#!/usr/bin/env bash\n")[1:]
    script, replaced = re.subn(
        r"(?m)^.*photonfarm.* &$",
        "(trap 'exit 0' TERM; while :; do sleep 0.05; done) &",
        workers if is_array else trainer,
    )
    assert replaced == 1
    asked = f"""
squeue() {{ echo "squeue $*" >> {tmp_path}/asked; echo RUNNING; }}
scontrol() {{ echo "scontrol $*" >> {tmp_path}/asked; }}
(sleep 0.3; kill -TERM $$) &
"""
    here = os.environ | {"SLURM_JOB_ID": "7"}
    array = "7" if is_array else "5"  # of a task that submitted it, which a trainer may have in its environment
    here |= {"SLURM_ARRAY_JOB_ID": array, "SLURM_ARRAY_TASK_ID": "3"}
    done = subprocess.run(["bash", "-c", asked + script], env=here, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "the task is back in the queue" in done.stderr
    task = "7_3" if is_array else "7"
    assert (tmp_path / "asked").read_text().splitlines() == [
        f"squeue --noheader --jobs {task} --format %T",
        f"scontrol requeue {task}",
    ]
