"""`photonfarm slurm`: render workers as an array of SLURM, and the trainer as a job beside it.

The batch scripts are made as text, written, and submitted.
"""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from photonfarm.core.errors import SchedulerError, SpecError, store_errors
from photonfarm.core.processes import command
from photonfarm.farm.devices import CUDA, DEVICE_VARIABLE, VISIBLE_VARIABLE
from photonfarm.scene.spec_loading import SCENES_VARIABLE

SIGNAL_S = 60
"""The seconds before the time limit at which SLURM sends TERM, or up to a minute earlier, as it may."""

LEAST_LIMIT_S = 180
"""The shortest time limit: below it, TERM may come before the first job is rendered."""

WORKER_TASK = '"${SLURM_ARRAY_JOB_ID}_$SLURM_ARRAY_TASK_ID"'
"""A worker's task, for the shell. One of an array's has the array's own SLURM_JOB_ID, by which SLURM means them all."""

TRAINER_TASK = '"$SLURM_JOB_ID"'
"""The trainer's job, for the shell."""

REQUEUES = 50
"""How often a task that its time limit ends puts itself back: a job longer than the limit would otherwise never end."""


@dataclass(frozen=True, slots=True)
class Resources:
    """What a job asks SLURM for; None: whatever the cluster gives by default."""

    partition: str | None = None
    time: str | None = None  # the limit, as sbatch takes it
    gpu: bool = False  # one for each task
    further: tuple[str, ...] = ()  # options of sbatch, which come last and so overrule


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What all scripts of a launch have in common."""

    folder: Path  # in which they run; absolute, as the next two
    logs: Path
    store: str
    has_redis: bool = False  # otherwise workers share the jobs by the store alone
    redis_url: str | None = None  # None: it holds a password, and tasks find it where this process did
    scenes: tuple[str, ...] = ()  # folders of scene files
    variables: tuple[tuple[str, str], ...] = ()  # further ones


def limit_s(text: str) -> int:
    """The seconds of a time limit as sbatch takes it: M, M:S, H:M:S, D-H, D-H:M or D-H:M:S; raises SpecError."""
    if not (found := re.fullmatch(r"(?:(\d+)-)?(\d+)(?::(\d+))?(?::(\d+))?", text, re.ASCII)):
        raise SpecError(f"time limit {text!r}: minutes, H:M:S or D-H:M:S are required")
    days, *parts = found.groups()
    numbers = [int(part) for part in parts if part is not None]
    if days is not None or len(numbers) == 3:
        hours, minutes, seconds = [*numbers, 0, 0][:3]
    else:
        hours, minutes, seconds = 0, numbers[0], sum(numbers[1:])
    return ((int(days or 0) * 24 + hours) * 60 + minutes) * 60 + seconds


def worker_script(at: Surroundings, resources: Resources, workers: int, specs: Sequence[str], scene_id: str) -> str:
    """The script of the array of workers; `scene_id` is that of the spec if there is one alone, otherwise empty."""
    name = '--name "slurm-$SLURM_ARRAY_JOB_ID-$SLURM_ARRAY_TASK_ID"'
    if not at.has_redis:
        which = f'--share "$SLURM_ARRAY_TASK_ID/{workers}" {shlex.join(specs)}'
    else:
        which = f"--scene {scene_id}" if scene_id else ""
    verb = f"{shlex.join(command('work'))} --until-complete {name} {which}".rstrip()
    options = (f"--array=0-{workers - 1}", f"--output={_pattern(at.logs)}/worker-%A_%a.log")
    device = [(DEVICE_VARIABLE, CUDA)] if resources.gpu else []
    return _script(at, resources, "photonfarm", options, verb, WORKER_TASK, device)


def trainer_script(at: Surroundings, resources: Resources, arguments: Sequence[str]) -> str:
    """The script of the trainer, whose verb has these arguments."""
    options = (f"--output={_pattern(at.logs)}/trainer-%j.log",)
    return _script(at, resources, "photonfarm-train", options, shlex.join(command(*arguments)), TRAINER_TASK)


def _script(
    at: Surroundings,
    resources: Resources,
    name: str,
    options: Sequence[str],
    verb: str,
    task: str,
    further: Sequence[tuple[str, str]] = (),
) -> str:
    asked = [
        f"--job-name={name}",
        *options,
        "--open-mode=append",
        "--requeue",
        f"--signal=B:TERM@{SIGNAL_S}",
        "--ntasks=1",
        "--cpus-per-task=1",
        f"--chdir={at.folder}",
    ]
    asked += [f"--partition={resources.partition}"] if resources.partition else []
    asked += [f"--time={resources.time}"] if resources.time else []
    asked += ["--gres=gpu:1"] if resources.gpu else []
    directives = "\n".join(f"#SBATCH {_directive(option)}" for option in (*asked, *resources.further))
    cards = (
        [] if resources.gpu else [(VISIBLE_VARIABLE, f"${{{VISIBLE_VARIABLE}-}}")]
    )  # those that SLURM gives, or none
    variables = "\n".join(f"export {name}={value}" for name, value in (*_variables(at), *further, *cards))
    return _TEMPLATE.format(directives=directives, variables=variables, task=task, verb=verb, requeues=REQUEUES)


def _variables(at: Surroundings) -> list[tuple[str, str]]:
    """The variables, quoted for the shell."""
    found = [("PHOTONFARM_STORE", shlex.quote(at.store))]
    if at.scenes:
        folders = shlex.quote(":".join(at.scenes))
        found.append((SCENES_VARIABLE, f'{folders}"${{{SCENES_VARIABLE}:+:${SCENES_VARIABLE}}}"'))
    if at.redis_url:
        found.append(("PHOTONFARM_REDIS_URL", shlex.quote(at.redis_url)))
    return found + [(name, shlex.quote(value)) for name, value in at.variables]


def _pattern(folder: Path) -> str:
    """A folder in the name of a log, in which SLURM replaces what follows a %."""
    return str(folder).replace("%", "%%")


def _directive(option: str) -> str:
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
        RUNNING | SIGNALING) near_limit=yes; kill -TERM "$process" ;;
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


TRAINER = "trainer"
WORKERS = "workers"


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
    workers = _submitted(files[WORKERS])
    trainer = None
    if TRAINER in files:
        try:
            trainer = _submitted(files[TRAINER], f"--dependency=after:{workers.partition(';')[0]}_0")
        except SchedulerError as error:
            raise SchedulerError(f"{error}. The workers are submitted, as job {workers}") from error
    return Launch(workers, trainer, {name: str(file) for name, file in files.items()}, str(logs))


def _submitted(script: Path, *options: str) -> str:
    """The id of a submitted job, with its cluster behind a semicolon if SLURM names one."""
    words = ["sbatch", "--parsable", *options, str(script)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        said = " ".join(done.stderr.split()) or f"exit code {done.returncode}"
        raise SchedulerError(f"sbatch refused {script}: {said}")
    return done.stdout.strip()
