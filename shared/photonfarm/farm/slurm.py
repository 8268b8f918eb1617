"""`photonfarm slurm`: render workers as an array of SLURM, and the trainer as a job beside it.

The batch scripts are made as text, written, and submitted.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from photonfarm.core.errors import SchedulerError, SpecError, store_errors
from photonfarm.core.processes import command
from photonfarm.farm.devices import CUDA, DEVICE_VARIABLE, VISIBLE_VARIABLE
from photonfarm.scene.spec_loading import SCENES_VARIABLE, NamedSpec

SIGNAL_S = 60
"""The seconds before the time limit at which SLURM sends TERM, or up to a minute earlier, as it may."""

WORKER_TASK = '"${SLURM_ARRAY_JOB_ID}_$SLURM_ARRAY_TASK_ID"'
"""A worker's task as the shell writes it. Its SLURM_JOB_ID may be the array's own, which for SLURM is all the tasks."""

TRAINER_TASK = '"$SLURM_JOB_ID"'
"""The trainer's job, for the shell."""

REQUEUES = 50
"""How often a task that its time limit ends puts itself back: a job longer than the limit would otherwise never end."""


WORKERS, TRAINER = "workers", "trainer"
"""The names of the two scripts."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """What SLURM is asked for; None: whatever the cluster gives by default."""

    workers: int  # tasks of the array
    partition: str | None
    time: str | None  # the limit, as sbatch takes it
    gpus: bool  # one for each worker
    further: tuple[str, ...]  # options of sbatch, which come last and so overrule
    logs: Path
    train: bool
    run: Path  # the trainer's folder
    train_steps: int | None
    train_gpus: bool
    train_further: tuple[str, ...]  # further options for the trainer's job alone


def make_scripts(named: Sequence[NamedSpec], store: str | Path, redis_url: str | None, asked: Asked) -> dict[str, str]:
    """The script of the array of workers, and of the trainer if one is asked for, by WORKERS and TRAINER.

    Without Redis, workers share the jobs by the store alone. A URL that holds a password is in no script: tasks find it
    where this process did.
    """
    variables = {"PHOTONFARM_STORE": shlex.quote(str(store.absolute()) if isinstance(store, Path) else store)}
    if scenes := dict.fromkeys(spec.scenes for spec in named if spec.scenes):
        folders = shlex.quote(":".join(scenes))
        variables[SCENES_VARIABLE] = f'{folders}"${{{SCENES_VARIABLE}:+:${SCENES_VARIABLE}}}"'
    if redis_url is not None:
        from photonfarm.queue.connection import has_password

        if not has_password(redis_url):
            variables["PHOTONFARM_REDIS_URL"] = shlex.quote(redis_url)
    for name in ("PHOTONFARM_CONFIG", "PHOTONFARM_REDIS_PASSWORD_FILE"):
        if path := os.environ.get(name):
            variables[name] = shlex.quote(str(Path(path).absolute()))
    specs = [_name_spec(spec.name) for spec in named]
    if redis_url is None:
        which = f'--share "$SLURM_ARRAY_TASK_ID/{asked.workers}" {shlex.join(specs)}'
    else:
        which = f"--scene {named[0].spec.scene_id}" if len(named) == 1 else ""
    name = '--name "slurm-$SLURM_ARRAY_JOB_ID-$SLURM_ARRAY_TASK_ID"'
    verb = f"{shlex.join(command('work'))} --until-complete {name} {which}".rstrip()
    options = [f"--array=0-{asked.workers - 1}", *asked.further]
    device = {DEVICE_VARIABLE: CUDA} if asked.gpus else {}
    log = "worker-%A_%a.log"
    scripts = {
        WORKERS: _make_script(asked, "photonfarm", log, options, verb, WORKER_TASK, variables | device, asked.gpus)
    }
    if asked.train:
        steps = ["--steps", str(asked.train_steps)] if asked.train_steps else []
        verb = shlex.join(command("train", specs[0], "--run", asked.run.absolute(), *steps))
        options, gpu = [*asked.further, *asked.train_further], asked.train_gpus
        log = "trainer-%j.log"
        scripts[TRAINER] = _make_script(asked, "photonfarm-train", log, options, verb, TRAINER_TASK, variables, gpu)
    return scripts


def _make_script(
    asked: Asked,
    name: str,
    log: str,
    options: Sequence[str],
    verb: str,
    task: str,
    variables: Mapping[str, str],
    gpu: bool,
) -> str:
    """A script that runs a verb; without a `gpu`, cards that SLURM has not given to its task are hidden."""
    logs = str(asked.logs.absolute()).replace("%", "%%")  # SLURM replaces what follows a %
    directives = [
        f"--job-name={name}",
        f"--output={logs}/{log}",
        "--open-mode=append",
        "--requeue",
        f"--signal=B:TERM@{SIGNAL_S}",
        "--ntasks=1",
        "--cpus-per-task=1",
        f"--chdir={Path.cwd()}",
        *([f"--partition={asked.partition}"] if asked.partition else []),
        *([f"--time={asked.time}"] if asked.time else []),
        *(["--gres=gpu:1"] if gpu else []),
        *options,
    ]
    cards = {} if gpu else {VISIBLE_VARIABLE: f"${{{VISIBLE_VARIABLE}-}}"}
    return _TEMPLATE.format(
        directives="\n".join(f"#SBATCH {_format_directive(option)}" for option in directives),
        variables="\n".join(f"export {name}={value}" for name, value in {**variables, **cards}.items()),
        task=task,
        verb=verb,
        requeues=REQUEUES,
    )


def _name_spec(name: str) -> str:
    """A spec as a script names it: absolute, if it is a file."""
    path = Path(name)
    return str(path.absolute()) if path.suffix == ".toml" or path.is_file() else name


def _format_directive(option: str) -> str:
    """An option as sbatch reads it in a script; raises SpecError for one that is no line."""
    if not option.startswith("-") or not option.isprintable():
        raise SpecError(f"{option!r}: is no option of sbatch; write it like --account=lab")
    name, equals, value = option.partition("=")
    return f"{name}={shlex.quote(value)}" if equals else option


_TEMPLATE = """\
#!/usr/bin/env bash
{directives}

{variables}

task={task}

# Near the time limit SLURM tells this script alone. A cancelled or preempted job is told as a whole: then the process
# below has its TERM already, and a second one would end it at once.
near_limit=
on_term() {{
    case $(squeue --noheader --jobs "$task" --format %T 2>/dev/null) in
        RUNNING | SIGNALING) near_limit=yes; kill -TERM "$process" ;; # SIGNALING: SLURM has just sent this TERM
        '') kill -TERM "$process" ;; # SLURM does not answer
    esac
}}

{verb} &
process=$!
trap on_term TERM
wait "$process"
while kill -0 "$process" 2>/dev/null; do wait "$process"; done # a signal ends `wait`, not the process
wait "$process"
code=$?

if [[ $near_limit ]]; then
    if ((${{SLURM_RESTART_COUNT:-0}} < {requeues})) && scontrol requeue "$task"; then
        echo "photonfarm: the time limit is near; the task is back in the queue, and goes on from what is stored" >&2
    else
        echo "photonfarm: the time limit is near; the same photonfarm slurm goes on from what is stored" >&2
        code=7
    fi
fi
exit "$code"
"""


@dataclass(frozen=True, slots=True)
class Launch:
    """The jobs of a launch."""

    workers: str  # the id of the array
    trainer: str | None  # the id of the trainer's job, if there is one
    scripts: dict[str, str]  # the files of both, by WORKERS and TRAINER
    logs: str  # the folder of their logs


def check_slurm() -> None:
    """Return if SLURM's commands are here; raises SchedulerError."""
    if shutil.which("sbatch") is None:
        raise SchedulerError(
            "sbatch is not here: photonfarm slurm runs where SLURM's commands are, such as a login node; --dry-run "
            "prints the scripts without them"
        )


def launch(scripts: Mapping[str, str], logs: Path) -> Launch:
    """Write scripts, by WORKERS and TRAINER, into the folder of the logs and submit them.

    The trainer's job starts once the first worker has: it trains on samples while they arrive. Raises StoreError if the
    folder cannot be written, SchedulerError if SLURM refuses.
    """
    files = {name: logs / f"{name}.sh" for name in scripts}
    with store_errors("write the scripts here", logs):
        logs.mkdir(parents=True, exist_ok=True)
        for name, file in files.items():
            file.write_text(scripts[name])
            file.chmod(0o755)
    workers, trainer = _submit(files[WORKERS]), None
    if TRAINER in files:
        try:
            array = workers.partition(";")[0]  # without its cluster, which a dependency does not name
            trainer = _submit(files[TRAINER], f"--dependency=after:{array}_0")
        except SchedulerError as error:
            raise SchedulerError(f"{error}. The workers are submitted, as job {workers}") from error
    return Launch(workers, trainer, {name: str(file) for name, file in files.items()}, str(logs))


def _submit(script: Path, *options: str) -> str:
    """The id of a submitted job, with its cluster behind a semicolon if SLURM names one."""
    words = ["sbatch", "--parsable", *options, str(script)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        said = " ".join(done.stderr.split()) or f"exit code {done.returncode}"
        raise SchedulerError(f"sbatch refused {script}: {said}")
    return done.stdout.strip()
